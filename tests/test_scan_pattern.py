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
