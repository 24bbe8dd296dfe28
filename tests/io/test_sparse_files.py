"""Sparse depth as an image and as a list of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError, InputError, NoPointsError, PnpDepthError, SizeError
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.sparse_files import holds_scan, read_sparse

SIZE = (10, 20)
ROWS = [[10.5, 3.25, 4.0], [0.0, 0.0, 0.5], [7.0, 2.0, 80.0]]
IMAGE = np.array([[0, 2, 0, 0], [3, 0, 0, 4]], dtype=np.float32)


def rows_of(path: Path) -> list[list[float]]:
    points = read_sparse(path, size=SIZE)[0]
    assert points.size == SIZE
    return np.column_stack([points.xy, points.depth]).tolist()


def test_an_image_gives_its_known_pixels_row_by_row(tmp_path: Path) -> None:
    write_depth(tmp_path / "s.png", IMAGE)
    write_depth(tmp_path / "s.exr", IMAGE)
    for name in ("s.png", "s.exr"):
        sparse, reading = read_sparse(tmp_path / name)
        assert sparse.xy.tolist() == [[1, 0], [0, 1], [3, 1]]
        assert sparse.depth.tolist() == [2, 3, 4]
        assert (sparse.xy.dtype, sparse.depth.dtype) == (np.float32, np.float32)
        assert sparse.size == (2, 4)
        assert not reading.assumed


def test_an_array_of_rows_is_a_list_and_rows_that_are_no_numbers_are_counted(
    tmp_path: Path,
) -> None:
    wrong = [[np.nan, 2, 3], [1, np.inf, 3], [1, 1, np.nan], [1, 1, -2], [1, 1, 0]]
    rows = np.array([*ROWS, *wrong], np.float32)
    np.save(tmp_path / "s.npy", rows)
    np.savez(tmp_path / "s.npz", rows.astype(np.float64))
    np.savetxt(tmp_path / "s.txt", rows)
    for name in ("s.npy", "s.npz", "s.txt"):
        assert rows_of(tmp_path / name) == ROWS
        reading = read_sparse(tmp_path / name, size=SIZE)[1]
        assert reading.source.startswith("point list")
        assert "without 5 rows" in reading.source


@pytest.mark.parametrize(
    "text",
    [
        "x,y,depth\n10.5,3.25,4\n0,0,0.5\n7,2,80\n",
        "# from a laser\n10.5;3.25;4\r\n\r\n0; 0; 0.5 # near\r\n7\t2\t8e1\r\n",
        '\ufeff"x", "y", "depth"\n10.5, 3.25, 4\n 0, 0, 0.5\n7, 2, 80\n',
        "1 1 0\n10.5 3.25 4\n2 2 nan\n3 3 inf\n0 0 .5\n4 4 -1\n7 2 80",
    ],
)
def test_common_ways_of_writing_rows_are_read_and_unknown_depth_is_dropped(
    tmp_path: Path, text: str
) -> None:
    (tmp_path / "s.csv").write_text(text, encoding="utf-8", newline="")
    assert rows_of(tmp_path / "s.csv") == ROWS


@pytest.mark.parametrize("suffix", [".npy", ".txt", ".csv"])
def test_rows_are_of_a_scan_or_of_pixels_by_their_content_whatever_the_format(
    tmp_path: Path, suffix: str
) -> None:
    scan = np.random.default_rng(0).normal(0, 9, (50, 4))
    pixels = np.column_stack([np.abs(scan[:, :2]), 1 + np.abs(scan[:, 2])])
    cases = {"xyz": scan[:, :3], "xyzi": scan, "pixels": pixels, "map": np.abs(scan).repeat(9, 1)}
    for name, rows in cases.items():
        path = tmp_path / f"{name}{suffix}"
        np.save(path, rows) if suffix == ".npy" else np.savetxt(path, rows)
        assert holds_scan(path) == name.startswith("xyz")
    for header, of_scan in (("x,y,z", True), ("x y z intensity", True), ("x,y,depth", False)):
        (tmp_path / "rows.csv").write_text(f"{header}\n" + "5 6 7\n" * 20)
        assert holds_scan(tmp_path / "rows.csv") is of_scan


@pytest.mark.parametrize(
    ("name", "content", "error"),
    [
        ("s.csv", "1 2 3\n4 5\n", FileFormatError),
        ("s.csv", "1 2 3 4\n", FileFormatError),
        ("s.csv", "u v w\n1 2 3\n", FileFormatError),
        ("s.csv", "1,5;2,5;3,5\n", FileFormatError),
        ("s.csv", "1 2 3\n", SizeError),
        ("none.csv", None, InputError),
        ("s.npy", [[1, 1, 2]], FileFormatError),
        ("s.npy", [[0.0] * 3] * 5, NoPointsError),
        ("s.txt", "# nothing\n", NoPointsError),
    ],
)
def test_what_is_no_sparse_depth_is_refused_by_its_name(
    tmp_path: Path, name: str, content: object, error: type[PnpDepthError]
) -> None:
    path = tmp_path / name
    if isinstance(content, list):
        np.save(path, content)
    elif content is not None:
        path.write_text(str(content))
    with pytest.raises(error, match=name):
        read_sparse(path)


def test_an_image_is_one_whatever_its_suffix_or_width_and_has_its_scale(tmp_path: Path) -> None:
    write_depth(tmp_path / "s.npy", np.ones((4, 5), np.float32))
    (tmp_path / "s.npy").rename(tmp_path / "s.txt")
    assert read_sparse(tmp_path / "s.txt")[0].size == (4, 5)
    write_depth(tmp_path / "s.pfm", np.ones((4, 3), np.float32))
    assert read_sparse(tmp_path / "s.pfm")[0].size == (4, 3)
    np.savez(tmp_path / "s.npz", a=np.full((2, 2), 500, np.uint16))
    sparse, reading = read_sparse(tmp_path / "s.npz", scale=1000)
    assert sparse.depth.tolist() == [0.5] * 4
    assert reading.scale == 1000
