"""The gate of every number from a sensor, on arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.dataset.plausible import (
    SCANS,
    check_pixels,
    check_same_scale,
    divisor_to_metres,
    far_values,
    plausible_map,
    scan_returns,
)
from pnpdepth_cli.errors import FileFormatError, InputError, NoPointsError, SizeError
from pnpdepth_cli.io.formats import Reading

RNG = np.random.default_rng(0)
SCAN = RNG.normal(0, 20, (1000, 3)).astype(np.float32)
MAP = RNG.uniform(1, 60, (40, 50)).astype(np.float32)
FLOAT = Reading("PFM", None, False)


def with_rows(at: slice, value: float | list[float]) -> np.ndarray:
    scan = SCAN.copy()
    scan[at] = value
    return scan


@pytest.mark.parametrize(
    "silent",
    [0.0, [1e-4, -5e-4, 0], np.nan, [np.inf, np.nan, -np.inf], [1.5, 0.25, 0.5], 1e10, 1e4],
)
def test_beams_without_return_are_dropped_and_counted(silent: float | list[float]) -> None:
    points, dropped, notes = scan_returns("a.npy", with_rows(slice(100, 300), silent))
    np.testing.assert_array_equal(points, np.delete(SCAN, slice(100, 300), axis=0))
    assert list(dropped.values()) == [200]
    assert "200 of 1,000 points" in notes[0]


def test_a_far_plane_of_a_sphere_has_one_range_and_is_no_return() -> None:
    rays = SCAN[:200] / np.linalg.norm(SCAN[:200], axis=1, keepdims=True)
    points, dropped, _ = scan_returns("a.npy", np.concatenate([SCAN, 250 * rays]))
    np.testing.assert_array_equal(points, SCAN)
    assert list(dropped.values()) == [200]


def test_few_points_that_are_no_numbers_are_dropped_and_many_are_refused() -> None:
    broken = with_rows(slice(10, 12), [1, np.nan, 1])
    assert len(scan_returns("a.npy", broken)[0]) == 998
    with pytest.raises(FileFormatError, match=r"200 of 1,000 points .*number 11: 1 nan 1"):
        scan_returns("a.npy", with_rows(slice(10, 210), [1, np.nan, 1]))
    with pytest.raises(FileFormatError, match="none of a scan"):
        scan_returns("a.npy", SCAN * [1, 1e9, 1])
    for nothing in (SCAN[:0], np.zeros((5, 3), np.float32)):
        with pytest.raises(NoPointsError):
            scan_returns("a.npy", nothing)


def test_a_scan_in_millimetres_names_the_option_that_reads_it() -> None:
    with pytest.raises(InputError, match=r"--depth-scale 1000 \(now 1\) would make it"):
        scan_returns("a.pcd", 1000 * SCAN)
    points, _, notes = scan_returns("a.pcd", 1000 * SCAN, 1000.0)
    np.testing.assert_allclose(points, SCAN, rtol=1e-6)
    assert "÷ 1000" in notes[0]
    assert len(scan_returns("a.pcd", 1000 * SCAN, 1.0)[2]) == 1  # kept, with a warning
    np.testing.assert_array_equal(scan_returns("a.pcd", SCAN, 256.0)[0], SCAN)  # of the other files


@pytest.mark.parametrize("far", [1e10, 65504, 10000, 1000, 255])
def test_a_far_plane_is_unknown_and_what_is_mixed_with_it_too(far: float) -> None:
    depth = MAP.copy()
    depth[:4] = far
    values, notes = plausible_map(depth, FLOAT, "gt", "--gt-scale", None)
    assert not values[:4].any()
    np.testing.assert_array_equal(values[4:], MAP[4:])
    assert len(notes) == 1
    if far >= 10000:
        depth[4, :10] = 0.4 * far + 0.6 * 20  # edges that a renderer mixed
        values, _ = plausible_map(depth, FLOAT, "gt", "--gt-scale", None)
        np.testing.assert_array_equal(values[5:], MAP[5:])
        assert not values[4, :10].any()


@pytest.mark.parametrize(
    "depth",
    [
        np.minimum(MAP, 50),  # a range that is cut where surfaces are
        np.where(np.arange(50) < 10, 4.0, 1.5) * np.ones((40, 1)),  # a wall behind a box
        np.round(MAP / 10, 2),  # a room in whole centimetres
        np.where(MAP > 59.9, 90, MAP),  # few far points, all alike
    ],
)
def test_surfaces_of_one_depth_are_no_far_plane(depth: np.ndarray) -> None:
    values, notes = plausible_map(depth.astype(np.float32), FLOAT, "gt", "--gt-scale", None)
    assert notes == []
    np.testing.assert_array_equal(values, depth.astype(np.float32))


def test_a_depth_beyond_everything_is_dropped() -> None:
    far, lines = far_values(np.array([2.0] * 50 + [1e30]))
    assert np.flatnonzero(far).tolist() == [50]
    assert "dropped 1 of 51 points" in lines[0]
    assert not far_values(np.array([2.0, 1e30]))[0].any()


@pytest.mark.parametrize("median", [0.02, 0.5, 80, 1000])
def test_plausible_metres_need_no_word(median: float) -> None:
    some_far = np.array([median] * 5 + [1e6] * 2)
    assert divisor_to_metres(some_far, Reading("PNG", 256.0), "x", "--depth-scale", None) == (1, [])
    assert divisor_to_metres(np.array([]), FLOAT, "x", "--depth-scale", None) == (1, [])


@pytest.mark.parametrize(
    ("median", "scale", "advice"),
    [
        (2000.0, 1.0, "--depth-scale 1000 (now 1) would make it 2.0 m"),
        (0.01, 100_000.0, "--depth-scale 1000 (now 100000) would make it 1.0 m"),
        (0.002, 1000.0, "--depth-scale 10 (now 1000) would make it 0.2 m"),
        (4e9, 1.0, "give numbers per metre with --depth-scale (now 1)"),
    ],
)
def test_a_scale_that_would_be_plausible_is_proposed(
    median: float, scale: float, advice: str
) -> None:
    depth, option = np.full(3, median), "--depth-scale"
    _, (warning,) = divisor_to_metres(depth, Reading("PNG", scale), "x", option, None)
    assert warning.startswith("warning: x: median ")
    assert advice in warning
    with pytest.raises(InputError, match="keeps it"):
        divisor_to_metres(depth, Reading("PNG", scale, assumed=True), "x", option, None)


@pytest.mark.parametrize(
    "millimetres", [np.full(3, 2500.0), np.arange(200.0, 900.0)], ids=["far", "whole"]
)
def test_a_float_file_in_millimetres_stops_and_the_option_reads_it(millimetres: np.ndarray) -> None:
    with pytest.raises(InputError, match="--depth-scale 1000"):
        divisor_to_metres(millimetres, FLOAT, "x", "--depth-scale", None)
    assert divisor_to_metres(millimetres, FLOAT, "x", "--depth-scale", 1000.0)[0] == 1000
    kept, (warning,) = divisor_to_metres(millimetres, FLOAT, "x", "--depth-scale", 1.0)
    assert (kept, warning.startswith("warning: ")) == (1, True)


def test_a_range_of_a_scan_is_nearer_than_a_depth_may_be() -> None:
    far = np.full(20, 700.5)
    assert divisor_to_metres(far, FLOAT, "x", "--depth-scale", None) == (1, [])
    with pytest.raises(InputError):
        divisor_to_metres(far, FLOAT, "x", "--depth-scale", None, SCANS)


LIST = RNG.uniform(0, 1, (100, 2)) * (639, 479)


@pytest.mark.parametrize(
    "xy", [LIST / (640, 480), 2 * LIST / (640, 480) - 1, LIST - np.array([320, 240])]
)
def test_coordinates_that_are_no_pixels_are_refused(xy: np.ndarray) -> None:
    with pytest.raises(FileFormatError):
        check_pixels(Path("a.csv"), xy, (480, 640))


def test_pixels_are_in_the_image_swapped_outside_or_of_a_smaller_one() -> None:
    inside, notes = check_pixels(Path("a.csv"), LIST, (480, 640))
    assert inside.all()
    assert notes == []
    inside, notes = check_pixels(Path("a.csv"), LIST + np.array([20, 0]), (480, 640))
    assert np.count_nonzero(~inside) == np.count_nonzero(LIST[:, 0] + 20 > 639.5)
    assert "points outside the image" in notes[0]
    with pytest.raises(SizeError, match="swap x and y"):
        check_pixels(Path("a.csv"), LIST[:, ::-1], (480, 640))
    _, (warning,) = check_pixels(Path("a.csv"), LIST / 2, (480, 640))
    assert warning.startswith("warning: ")
    lower_left = LIST / 2 + np.array([0, 240])
    assert check_pixels(Path("a.csv"), lower_left, (480, 640))[1] == []
    with pytest.raises(NoPointsError):
        check_pixels(Path("a.csv"), LIST[:5] + 1000, (480, 640))


def test_single_wild_values_do_not_make_two_files_differ() -> None:
    sparse = np.full((5, 5), 2, np.float32)
    wild = np.where(np.eye(5) > 0, np.float32(1e5), sparse)
    assert check_same_scale(sparse, wild, {}) == []


def shared(count: int, total: int) -> np.ndarray:
    """A scan of which so many points are at one place."""
    return np.where(np.arange(total)[:, None] < count, 3.0, SCAN[:total])


@pytest.mark.parametrize(
    ("scan", "dropped"),
    [
        (shared(5, 1000), 5),
        (shared(4, 1000), 0),  # less than 0.5 %
        (shared(3, 100), 3),
        (shared(2, 100), 0),
        (shared(3, 10), 3),
        (shared(3, 9), 0),  # too few to tell
        (np.vstack([SCAN, [[1e-3, 0, 0]]]), 0),
        (np.vstack([SCAN, [[0.99e-3, 0, 0]]]), 1),
        (np.vstack([SCAN, [[1e5, 0, 0]]]), 0),
        (np.vstack([SCAN, [[0, -1.01e5, 0]]]), 1),
        (np.where(np.arange(3000).reshape(-1, 3) % 30 < 1, np.nan, SCAN), 100),
    ],
)
def test_a_point_is_no_return_from_each_limit_on(scan: np.ndarray, dropped: int) -> None:
    points, counts, _ = scan_returns("a.npy", scan)
    assert (len(scan) - len(points), sum(counts.values())) == (dropped, dropped)


@pytest.mark.parametrize(
    ("rest", "far", "count", "unknown"),
    [
        (20.0, 40.1, 10, 10),
        (20.0, 39.9, 10, 0),  # a hall
        (30.0, 45.1, 10, 10),
        (30.0, 44.9, 10, 0),  # less than 1.5 times the rest
        (30.0, 45.1, 4, 0),  # of 1,000, less than 0.5 %
        (20.0, 10_100.0, 1, 1),
        (20.0, 9_900.0, 1, 0),  # less than 1000 times the median
    ],
)
def test_depths_are_unknown_from_each_limit_on(
    rest: float, far: float, count: int, unknown: int
) -> None:
    depth = np.append(np.linspace(0, rest, 1001 - count)[1:], [far] * count)
    assert np.flatnonzero(far_values(depth)[0]).tolist() == list(range(1000 - unknown, 1000))


@pytest.mark.parametrize("factor", [0.3, 0.66, 0.67, 1.49, 1.51, 7])
@pytest.mark.parametrize("known", [9, 10])
def test_two_files_differ_by_a_factor_of_more_than_one_and_a_half(
    factor: float, known: int
) -> None:
    sparse = np.where(np.arange(2000).reshape(40, 50) < known, MAP, np.float32(0))
    differs = known == 10 and not 1 / 1.5 <= factor <= 1.5
    assert len(check_same_scale(sparse, np.float32(factor) * MAP, {})) == differs


@pytest.mark.parametrize("median", [99, 100])
def test_whole_numbers_of_a_float_file_are_codes_from_a_median_of_100_on(median: int) -> None:
    depth = np.arange(2.0 * median + 1)
    if median < 100:
        assert divisor_to_metres(depth, FLOAT, "x", "--depth-scale", None) == (1, [])
    else:
        with pytest.raises(InputError):
            divisor_to_metres(depth, FLOAT, "x", "--depth-scale", None)
