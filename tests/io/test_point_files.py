"""Sparse depth as the points of a depth image, or as a list of rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError, NoPointsError, PnpDepthError
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.point_files import holds_scan, load_numbers, read_sparse

SIZE = (10, 20)
ROWS = [[10.5, 3.25, 4.0], [0.0, 0.0, 0.5], [7.0, 2.0, 80.0]]
WRONG = [[np.nan, 2, 3], [1, np.inf, 3], [1, 1, np.nan], [1, 1, -2], [1, 1, 0]]
MAP = np.array([[0, 2, 0, 0], [3, 0, 0, 4]], np.float32)


@pytest.mark.parametrize(
    ("name", "content", "rows"),
    [
        *((f"s.{suffix}", MAP, [[1, 0, 2], [0, 1, 3], [3, 1, 4]]) for suffix in ("png", "exr")),
        *((f"s.{suffix}", np.array([*ROWS, *WRONG]), ROWS) for suffix in ("npy", "npz", "txt")),
        ("s.csv", "x,y,depth\n10.5,3.25,4\n0,0,0.5\n7,2,80\n", ROWS),
        ("s.txt", "# from a laser\n10.5;3.25;4\r\n\r\n0; 0; 0.5 # near\r\n7\t2\t8e1\r\n", ROWS),
        ("s.csv", '\ufeff"x", "y", "depth"\n10.5, 3.25, 4\n 0, 0, 0.5\n7, 2, 80\n', ROWS),
    ],
)
def test_points_are_known_pixels_row_by_row_or_a_list_however_it_is_written(
    tmp_path: Path, name: str, content: str | np.ndarray, rows: list[list[float]]
) -> None:
    path = tmp_path / name
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8", newline="")
    else:
        writers = {".npy": np.save, ".npz": np.savez, ".txt": np.savetxt}
        writers.get(path.suffix, write_depth)(path, content)
    points, reading = read_sparse(path, size=SIZE)
    assert (points.xy.dtype, points.depth.dtype) == (np.float32, np.float32)
    assert np.column_stack([points.xy, points.depth]).tolist() == rows
    assert tuple(points.size) == (MAP.shape if content is MAP else SIZE)
    has_wrong_rows = isinstance(content, np.ndarray) and content is not MAP
    assert ("without 5 rows" in reading.source) == has_wrong_rows


@pytest.mark.parametrize(
    ("header", "of_scan"), [("x,y,z", True), ("x y z intensity", True), ("x,y,depth", False)]
)
def test_a_header_says_if_rows_are_of_a_scan(tmp_path: Path, header: str, of_scan: bool) -> None:
    (tmp_path / "rows.csv").write_text(f"{header}\n" + "5 6 7\n" * 20)
    assert holds_scan(load_numbers(tmp_path / "rows.csv")) is of_scan


@pytest.mark.parametrize(
    ("content", "error"),
    [
        *((text, InputError) for text in ("1 2 3\n4 5\n", "1 2 3 4\n", "1 2\n3 4\n")),
        *((text, InputError) for text in ("u v w\n1 2 3\n", "1,5;2,5;3,5\n")),
        ("1 2 3\n", InputError),
        *((text, NoPointsError) for text in ("0 0 0\n" * 5, "# nothing\n")),
    ],
)
def test_other_content_is_refused(tmp_path: Path, content: str, error: type[PnpDepthError]) -> None:
    (tmp_path / "s.csv").write_text(content)
    with pytest.raises(error, match=r"s\.csv"):
        read_sparse(tmp_path / "s.csv")
