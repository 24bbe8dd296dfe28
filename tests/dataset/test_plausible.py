"""The gate of every number from a sensor, on arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.dataset.plausible import (
    SCANS,
    check_pixels,
    divisor_to_metres,
    scan_returns,
)
from pnpdepth_cli.errors import InputError, NoPointsError
from pnpdepth_cli.io.formats import Reading

RNG = np.random.default_rng(0)
SCAN = RNG.normal(0, 20, (1000, 3)).astype(np.float32)
SPHERE = 250 * SCAN[:200] / np.linalg.norm(SCAN[:200], axis=1, keepdims=True)
MAP = RNG.uniform(1, 60, (40, 50)).astype(np.float32)
FLOAT = Reading("PFM", None, False)
PNG = Reading("PNG", 256.0)


def with_rows(at: slice, value: float | list[float], total: int = 1000) -> np.ndarray:
    scan = SCAN[:total].copy()
    scan[at] = value
    return scan


SILENT = (0.0, [1e-4, -5e-4, 0], np.nan, [np.inf, np.nan, -np.inf], [1.5, 0.25, 0.5], 1e10, 1e4)


@pytest.mark.parametrize(
    ("scan", "gone"),
    [
        *((with_rows(slice(100, 300), silent), slice(100, 300)) for silent in SILENT),
        (np.concatenate([SCAN, SPHERE]), slice(1000, 1200)),  # a far plane of one range
        (with_rows(slice(10, 12), [1, np.nan, 1]), slice(10, 12)),
        (with_rows(slice(0, 1000, 10), [np.nan, 1, 1]), slice(0, 1000, 10)),
        (with_rows(slice(5), 3), slice(5)),  # at one place
        (with_rows(slice(4), 3), slice(0)),  # less than 0.5 %
        (with_rows(slice(3), 3, 100), slice(3)),
        (with_rows(slice(2), 3, 100), slice(0)),
        (with_rows(slice(3), 3, 10), slice(3)),
        (with_rows(slice(3), 3, 9), slice(0)),  # too few to tell
        (with_rows(slice(1), [1e-3, 0, 0]), slice(0)),
        (with_rows(slice(1), [0.99e-3, 0, 0]), slice(1)),
        (with_rows(slice(1), [1e5, 0, 0]), slice(0)),
        (with_rows(slice(1), [0, -1.01e5, 0]), slice(1)),
    ],
)
def test_beams_without_return_are_dropped_and_counted(scan: np.ndarray, gone: slice) -> None:
    points, dropped, notes = scan_returns("a.npy", scan)
    np.testing.assert_array_equal(points, np.delete(scan, gone, axis=0))
    count = len(scan[gone])
    assert sum(dropped.values()) == count
    if count == 0:
        assert notes == []
    else:
        (note,) = notes
        assert f"{count:,} of {len(scan):,} points" in note


@pytest.mark.parametrize(
    ("scan", "error", "said"),
    [
        (with_rows(slice(10, 210), [1, np.nan, 1]), InputError, "200 of .*number 11: 1 nan 1"),
        (SCAN * [1, 1e9, 1], InputError, "none of a scan"),
        (SCAN[:0], NoPointsError, "a.npy"),
        (np.zeros((5, 3), np.float32), NoPointsError, "a.npy"),
        (1000 * SCAN, InputError, r"--depth-scale 1000 \(now 1\) would make it"),
    ],
)
def test_what_is_no_scan_is_refused(scan: np.ndarray, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        scan_returns("a.npy", scan)


def test_a_scan_in_millimetres_is_read_by_the_option() -> None:
    points, _, notes = scan_returns("a.pcd", 1000 * SCAN, 1000.0)
    np.testing.assert_allclose(points, SCAN, rtol=1e-6)
    assert "÷ 1000" in notes[0]
    assert len(scan_returns("a.pcd", 1000 * SCAN, 1.0)[2]) == 1  # kept, with a warning
    np.testing.assert_array_equal(scan_returns("a.pcd", SCAN, 256.0)[0], SCAN)  # of a data set


@pytest.mark.parametrize("scale", [3.28084, 10.0, 256.0])
def test_a_stated_scale_is_obeyed_unless_it_is_of_the_other_files_integers(scale: float) -> None:
    points, _, (note,) = scan_returns("a.pcd", SCAN, scale, of_integers="")
    np.testing.assert_allclose(points, SCAN / scale, rtol=1e-5)
    assert f"÷ {scale:g}" in note
    points, _, (note,) = scan_returns("a.pcd", SCAN, scale, of_integers="gt.png")
    np.testing.assert_array_equal(points, SCAN)
    assert "gt.png" in note
    points, _, _ = scan_returns("a.pcd", 1000 * SCAN, 1000.0, of_integers="gt.png")
    np.testing.assert_allclose(points, SCAN, rtol=1e-6)  # implausible without it


def divisor(depth: np.ndarray, reading: Reading, given: float | None = None, *more: Any) -> Any:
    return divisor_to_metres(depth, reading, "x", "--depth-scale", given, *more)


@pytest.mark.parametrize(
    ("depth", "reading"),
    [
        *((np.array([m] * 5 + [1e6] * 2), PNG) for m in (0.02, 0.5, 80, 1000)),
        (np.array([]), FLOAT),
        (np.full(20, 700.5), FLOAT),
        (np.arange(199.0), FLOAT),  # whole numbers of a median of 99
    ],
)
def test_plausible_metres_need_no_word(depth: np.ndarray, reading: Reading) -> None:
    assert divisor(depth, reading) == (1, [])


@pytest.mark.parametrize(
    ("median", "scale", "advice"),
    [
        (2000.0, 1.0, "--depth-scale 1000 (now 1) would make it 2.0 m"),
        (0.01, 100_000.0, "--depth-scale 1000 (now 100000) would make it 1.0 m"),
        (0.002, 1000.0, "--depth-scale 1 (now 1000) would make it 2.0 m"),  # whole metres
        (0.0002, 1000.0, "--depth-scale 1 (now 1000) would make it 0.2 m"),
        (4e9, 1.0, "give numbers per metre with --depth-scale (now 1)"),
    ],
)
def test_a_plausible_scale_is_proposed(median: float, scale: float, advice: str) -> None:
    _, (warning,) = divisor(np.full(3, median), Reading("PNG", scale))
    assert warning.startswith("warning: x: median ")
    assert advice in warning
    with pytest.raises(InputError, match="keeps it"):
        divisor(np.full(3, median), Reading("PNG", scale, assumed=True))


@pytest.mark.parametrize(
    ("depth", "kind"),
    [
        (np.full(3, 2500.0), []),
        (np.arange(200.0, 900.0), []),
        (np.arange(201.0), []),  # whole numbers of a median of 100
        (np.full(20, 700.5), [SCANS]),  # a scan's are nearer than a depth may be
    ],
)
def test_millimetres_stop_and_the_option_reads_them(depth: np.ndarray, kind: list[Any]) -> None:
    with pytest.raises(InputError, match=r"--depth-scale \d+ \(now 1\)"):
        divisor(depth, FLOAT, None, *kind)
    assert divisor(depth, FLOAT, 1000.0, *kind)[0] == 1000
    kept, (warning,) = divisor(depth, FLOAT, 1.0, *kind)
    assert (kept, warning.startswith("warning: ")) == (1, True)


def test_a_room_in_centimetres_is_warned_of_but_not_the_ground_below_an_aircraft() -> None:
    room = np.linspace(100.5, 500, 50)
    ground = np.linspace(250.5, 350, 50)
    kept, (warning,) = divisor(room, FLOAT)
    assert kept == 1
    assert "--depth-scale 100 (now 1) would make it 3.0 m" in warning
    assert divisor(room, FLOAT, 100.0)[0] == 100
    assert divisor(room, FLOAT, 1.0) == divisor(ground, FLOAT) == (1, [])


LIST = RNG.uniform(0, 1, (100, 2)) * (639, 479)


@pytest.mark.parametrize(
    ("xy", "error", "said"),
    [
        (LIST / (640, 480), InputError, "a.csv"),
        (2 * LIST / (640, 480) - 1, InputError, "a.csv"),
        (LIST - np.array([320, 240]), InputError, "a.csv"),
        (LIST[:, ::-1], InputError, "swap x and y"),
        (LIST[:5] + 1000, NoPointsError, "a.csv"),
    ],
)
def test_a_list_whose_coordinates_are_no_pixels_is_refused(
    xy: np.ndarray, error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        check_pixels(Path("a.csv"), xy, (480, 640))


@pytest.mark.parametrize(
    ("xy", "said"),
    [
        (LIST, []),
        (LIST + np.array([20, 0]), ["points outside the image"]),
        (LIST / 2, ["warning: "]),  # of a smaller image
        (LIST / 2 + np.array([0, 240]), []),
    ],
)
def test_pixels_are_in_the_image_or_said_to_be_outside(xy: np.ndarray, said: list[str]) -> None:
    inside, notes = check_pixels(Path("a.csv"), xy, (480, 640))
    np.testing.assert_array_equal(inside, xy[:, 0] < 639.5)
    assert [text in note for text, note in zip(said, notes, strict=True)] == [True] * len(said)
