"""Depth files are read back as they were written, and their range and scale are told."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from pnpdepth_cli.errors import (
    FileFormatError,
    InputError,
    NoPointsError,
    OutputError,
    PnpDepthError,
    SizeError,
    UsageError,
)
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

FLOAT_SUFFIXES = [suffix for suffix in DEPTH_SUFFIXES if suffix != ".png"]
images = array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12)


@pytest.mark.parametrize("suffix", FLOAT_SUFFIXES)
@settings(max_examples=30, deadline=None)
@given(depth=arrays(np.float32, images, elements=st.floats(width=32)))
def test_float_formats_give_back_every_known_depth_exactly(
    suffix: str, depth: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / f"round{suffix}"
    given_depth = depth.copy()
    write_depth(path, depth)
    assert np.array_equal(depth, given_depth, equal_nan=True)
    with np.errstate(invalid="ignore"):
        known = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    again = read_depth(path)
    assert again.values.dtype == np.float32
    assert np.array_equal(again.values, known)


@settings(max_examples=60, deadline=None)
@given(
    codes=arrays(np.uint16, images, elements=st.integers(0, 65534)),
    scale=st.sampled_from([256.0, 1000.0, 5000.0, 1.0, 0.1, 333.3333333333333]),
)
def test_png_gives_back_every_code_and_its_scale(
    codes: np.ndarray, scale: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "round.png"
    depth = (codes / scale).astype(np.float32)
    write_depth(path, depth, scale=scale)
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), codes)
    again = read_depth(path)
    assert np.array_equal(again.values, depth)
    assert (again.reading.scale, again.reading.assumed) == (scale, False)


def test_other_programs_read_what_is_written_of_any_memory_layout(tmp_path: Path) -> None:
    depth = np.arange(1, 13, dtype=np.float32).reshape(3, 4)[::-1].T
    for suffix in FLOAT_SUFFIXES:
        write_depth(tmp_path / f"d{suffix.upper()}", depth)
    for suffix in (".TIF", ".PFM"):
        other = cv2.imread(str(tmp_path / f"d{suffix}"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(other, depth)
    assert np.array_equal(np.load(tmp_path / "d.NPZ")["depth"], depth)
    with OpenEXR.File(str(tmp_path / "d.EXR"), separate_channels=True) as file:
        assert np.array_equal(file.channels()["Z"].pixels, depth)
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION


ONE = [[1.0]]


@pytest.mark.parametrize(
    ("name", "depth", "scale", "error"),
    [
        *(("d.png", [[1, large]], 1000, OutputError) for large in (65.535, 1e30)),
        ("d.png", [[1, 1e-3, 1e-4]], 256, OutputError),
        *(("d.png", ONE, s, UsageError) for s in (0, np.nan)),
        *((name, ONE, 256, OutputError) for name in ("d.jpg", "d")),
        ("d.npy", np.ones((0, 4)), 256, SizeError),
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


def rows_of(path: Path) -> list[list[float]]:
    points = read_sparse(path, size=SIZE)[0]
    assert (points.xy.dtype, points.depth.dtype) == (np.float32, np.float32)
    return [*np.column_stack([points.xy, points.depth]).tolist(), list(points.size)]


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_an_image_gives_its_known_pixels_row_by_row(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"s{suffix}"
    write_depth(path, np.array([[0, 2, 0, 0], [3, 0, 0, 4]], np.float32))
    assert rows_of(path) == [[1, 0, 2], [0, 1, 3], [3, 1, 4], [2, 4]]


WRONG = [[np.nan, 2, 3], [1, np.inf, 3], [1, 1, np.nan], [1, 1, -2], [1, 1, 0]]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *((f"s.{suffix}", np.array([*ROWS, *WRONG])) for suffix in ("npy", "npz", "txt")),
        ("s.csv", "x,y,depth\n10.5,3.25,4\n0,0,0.5\n7,2,80\n"),
        ("s.txt", "# from a laser\n10.5;3.25;4\r\n\r\n0; 0; 0.5 # near\r\n7\t2\t8e1\r\n"),
        ("s.csv", '\ufeff"x", "y", "depth"\n10.5, 3.25, 4\n 0, 0, 0.5\n7, 2, 80\n'),
    ],
)
def test_rows_are_a_list_however_they_are_written_and_those_without_depth_are_counted(
    tmp_path: Path, name: str, content: str | np.ndarray
) -> None:
    path = tmp_path / name
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8", newline="")
    else:
        {".npy": np.save, ".npz": np.savez, ".txt": np.savetxt}[path.suffix](path, content)
    assert rows_of(path) == [*ROWS, list(SIZE)]
    source = read_sparse(path, size=SIZE)[1].source
    assert ("without 5 rows" in source) == isinstance(content, np.ndarray)


@pytest.mark.parametrize("suffix", [".npy", ".csv"])
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
        *(("s.csv", text, FileFormatError) for text in ("1 2 3\n4 5\n", "1 2 3 4\n", "1 2\n3 4\n")),
        *(("s.csv", text, FileFormatError) for text in ("u v w\n1 2 3\n", "1,5;2,5;3,5\n")),
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
