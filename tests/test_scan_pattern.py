"""Scan lines, recognised in the pattern of sparse points."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pnpdepth_cli.scan_pattern import scan_lines, scan_pattern

SIZE = (120, 300)


def lines_of_points(gap: int, slope: float = 0.03) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Coordinates of points on tilted lines, and the line of each."""
    x, line = np.meshgrid(np.arange(1, 299, 2.0), np.arange(100 // gap), indexing="ij")
    y = 5 + gap * line + slope * x
    inside = y < SIZE[0] - 1
    return np.column_stack([x[inside], y[inside]]), line[inside]


def test_spacings_are_those_to_the_next_point_in_a_row_or_beside_it() -> None:
    y, x = np.mgrid[:120:5, :300:3]
    assert scan_pattern(np.column_stack([x.ravel(), y.ravel()]), SIZE) == (3.0, 5.0)
    assert scan_pattern(np.column_stack([y.ravel(), x.ravel()]), SIZE[::-1]) is None


@pytest.mark.parametrize("gap", [4, 7])
def test_each_point_has_its_own_line_from_the_top(gap: int) -> None:
    xy, line = lines_of_points(gap)
    order = np.random.default_rng(0).permutation(len(xy))
    np.testing.assert_array_equal(scan_lines(xy[order], SIZE), line[order])


def test_random_points_and_a_few_lines_are_no_scan() -> None:
    for count in (10, 400, 9000):
        xy = np.random.default_rng(0).uniform(0, 1, (count, 2)) * [299, 119]
        assert scan_lines(xy, SIZE) is None
    xy, line = lines_of_points(4)
    assert scan_lines(xy[line < 8], SIZE) is None


@pytest.mark.parametrize("seed", range(5))
def test_random_points_of_a_wide_area_are_no_scan(seed: int) -> None:
    """In a band of an image, most points have no other in their column."""
    xy = np.random.default_rng(seed).uniform((0, 200), (640, 300), (500, 2))
    assert scan_pattern(xy, (480, 640)) is None


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_a_scan_stays_one_when_it_is_thinned(share: float) -> None:
    xy, _ = lines_of_points(7)
    chosen = np.random.default_rng(0).uniform(size=len(xy)) < share
    repeated = np.concatenate([xy[chosen], xy[chosen] + [0, 120], xy[chosen] + [300, 0]])
    assert len(repeated) > 500
    assert scan_pattern(repeated, (240, 600)) is not None
