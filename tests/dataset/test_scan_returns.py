"""The returns of a scan, on arrays."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.dataset.scan_returns import scan_returns
from pnpdepth_cli.errors import InputError, NoPointsError

RNG = np.random.default_rng(0)
SCAN = RNG.normal(0, 20, (1000, 3)).astype(np.float32)
SPHERE = 250 * SCAN[:200] / np.linalg.norm(SCAN[:200], axis=1, keepdims=True)


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
