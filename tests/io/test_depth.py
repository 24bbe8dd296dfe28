"""Depth files are read back as they were written, and their range and scale are told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from pnpdepth_cli.errors import InputError, NoPointsError, OutputError, PnpDepthError, UsageError
from pnpdepth_cli.io.depth import (
    DEPTH_SUFFIXES,
    describe_range,
    holds_scan,
    read_depth,
    read_sparse,
    scale_warning,
    write_depth,
)
from pnpdepth_cli.io.formats import Reading

SPECIAL = [[np.nan, np.inf, -np.inf, -1], [0, -0.0, 1e-45, 3.4e38], [1 / 3, 80.25, 2, 1e-3]]


def as_others_read(path: Path) -> np.ndarray:
    """The depth in a file, read without this program."""
    if path.suffix == ".EXR":
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return file.channels()["Z"].pixels
    if path.suffix in (".NPY", ".NPZ"):
        content = np.load(path)
        return content if path.suffix == ".NPY" else content["depth"]
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("suffix", [s for s in DEPTH_SUFFIXES if s != ".png"])
@pytest.mark.parametrize("layout", [np.array, np.transpose, np.flipud])
def test_float_formats_give_back_every_known_depth_exactly_also_to_other_programs(
    suffix: str, layout: Callable[[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    path, depth = tmp_path / f"d{suffix.upper()}", layout(np.array(SPECIAL, np.float32))
    write_depth(path, depth)
    known = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    assert (again := read_depth(path).values).dtype == np.float32
    assert np.array_equal(again, known)
    assert np.array_equal(as_others_read(path), known)


@pytest.mark.parametrize("scale", [256.0, 1000.0, 5000.0, 1.0, 0.1, 1000 / 3])
def test_png_gives_back_every_code_and_its_scale(scale: float, tmp_path: Path) -> None:
    path, codes = tmp_path / "d.png", np.arange(65535, dtype=np.uint16).reshape(257, 255)
    depth = (codes / scale).astype(np.float32)
    write_depth(path, depth, scale=scale)
    assert np.array_equal(as_others_read(path), codes)
    again = read_depth(path)
    assert np.array_equal(again.values, depth)
    assert (again.reading.scale, again.reading.assumed) == (scale, False)


ONE = [[1.0]]


@pytest.mark.parametrize(
    ("name", "depth", "scale", "error"),
    [
        *(("d.png", [[1, large]], 1000, OutputError) for large in (65.535, 1e30)),
        ("d.png", [[1, 1e-3, 1e-4]], 256, OutputError),
        *(("d.png", ONE, s, UsageError) for s in (0, np.nan)),
        *((name, ONE, 256, OutputError) for name in ("d.jpg", "d")),
        ("d.npy", np.ones((0, 4)), 256, InputError),
    ],
)
def test_what_a_format_cannot_hold_is_refused_and_nothing_is_written(
    tmp_path: Path, name: str, depth: list, scale: float, error: type[PnpDepthError]
) -> None:
    with pytest.raises(error):
        write_depth(tmp_path / name, np.array(depth, np.float32), scale=scale)
    assert list(tmp_path.iterdir()) == []


FLOAT = Reading("PFM", None, False)
BY_256, BY_1000 = (Reading("PNG", scale, False) for scale in (256.0, 1000.0))


@pytest.mark.parametrize(
    ("ratio", "depth", "truth", "advice"),
    [
        *((r, BY_256, BY_256, "None") for r in (np.nan, 0, 1, 2, 3.906 * 1.11, 3.906 / 1.11)),
        (4.2, BY_256, FLOAT, "--scale 1000 (now 256)"),
        (0.256, FLOAT, BY_256, "--gt-scale 1000 (now 256)"),
        (0.001, BY_1000, None, "--scale 1 (now 1000)"),
        (3.9, FLOAT, FLOAT, "metres"),
    ],
)
def test_a_ratio_that_a_wrong_scale_explains_names_the_scale_that_removes_it(
    ratio: float, depth: Reading, truth: Reading | None, advice: str
) -> None:
    assert advice in str(scale_warning("depths", ratio, {"--scale": depth, "--gt-scale": truth}))
    kinds = {"--scale": depth._replace(assumed=True), "--gt-scale": truth}
    if depth.scale and advice != "None":
        with pytest.raises(InputError):
            scale_warning("depths", ratio, kinds)


def test_the_range_has_count_and_ends_and_says_how_to_change_an_assumed_scale() -> None:
    assert describe_range(np.array([0, np.nan, 5.0]), FLOAT).startswith("1 point, 5.0 m")
    assert describe_range(np.array([0.034, 0.97]), FLOAT).startswith("2 points, 0.034–1.0 m")
    assert describe_range(np.zeros(2), FLOAT).startswith("no points")
    assumed = BY_256._replace(source="16-bit PNG ÷ 256", assumed=True)
    assert "--depth-scale 1000" in describe_range(np.array([3.125, 13.28]), assumed)


SIZE, ROWS = (10, 20), [[10.5, 3.25, 4.0], [0.0, 0.0, 0.5], [7.0, 2.0, 80.0]]
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
def test_a_header_says_whether_rows_are_of_a_scan(
    tmp_path: Path, header: str, of_scan: bool
) -> None:
    (tmp_path / "rows.csv").write_text(f"{header}\n" + "5 6 7\n" * 20)
    assert holds_scan(tmp_path / "rows.csv") is of_scan


@pytest.mark.parametrize(
    ("content", "error"),
    [
        *((text, InputError) for text in ("1 2 3\n4 5\n", "1 2 3 4\n", "1 2\n3 4\n")),
        *((text, InputError) for text in ("u v w\n1 2 3\n", "1,5;2,5;3,5\n")),
        ("1 2 3\n", InputError),
        *((text, NoPointsError) for text in ("0 0 0\n" * 5, "# nothing\n")),
    ],
)
def test_what_is_no_sparse_depth_is_refused_by_its_name(
    tmp_path: Path, content: str, error: type[PnpDepthError]
) -> None:
    (tmp_path / "s.csv").write_text(content)
    with pytest.raises(error, match=r"s\.csv"):
        read_sparse(tmp_path / "s.csv")
