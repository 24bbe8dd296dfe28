from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.choices import PATTERNS
from pnpdepth_cli.errors import NoPointsError, SizeError, UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.sensors.samplers import sample_points

DEPTH = np.random.default_rng(7).uniform(1, 9, (60, 80)).astype(np.float32)
HOLES = np.where(np.random.default_rng(8).random((60, 80)) < 0.3, 0, DEPTH).astype(np.float32)


def checkerboard() -> np.ndarray:
    y, x = np.mgrid[:60, :80]
    board = (((y // 12) + (x // 12)) % 2).astype(np.float32)
    return np.repeat(board[:, :, None], 3, axis=2)


def pattern(kind: str) -> SamplePattern:
    return SamplePattern(kind=kind, count=9 if kind == "lines" else 40)


@pytest.mark.parametrize("kind", PATTERNS)
def test_every_pattern_gives_known_pixels_once_with_their_own_depth(kind: str) -> None:
    got = sample_points(HOLES, pattern(kind), 1, image=checkerboard())
    column, row = got.xy.astype(int).T
    assert np.array_equal(got.xy, np.column_stack([column, row]))
    assert np.array_equal(got.depth, HOLES[row, column])
    assert (got.depth > 0).all()
    assert len({*zip(row, column, strict=True)}) == len(row)


@pytest.mark.parametrize("count", [1, 40, 3000])
def test_uniform_returns_exactly_the_requested_number(count: int) -> None:
    known = np.count_nonzero(HOLES)
    assert len(sample_points(HOLES, SamplePattern(count=count), 1)) == count
    some = sample_points(HOLES, SamplePattern(fraction=count / 4000), 1)
    assert len(some) == round(count / 4000 * known)


def test_grid_gives_evenly_spaced_points_of_about_the_number() -> None:
    got = sample_points(DEPTH, SamplePattern(kind="grid", count=48), 0)
    assert len(got.depth) == 48  # 6 × 8 at a spacing of 10
    assert set(np.diff(np.unique(got.xy[:, 0]))) == {10}
    assert set(np.diff(np.unique(got.xy[:, 1]))) == {10}
    ones = np.ones((6, 6), np.float32)
    for fraction, (a, b) in ((1 / 9, (1, 4)), (1 / 16, (2, 5))):
        few = sample_points(ones, SamplePattern(kind="grid", fraction=fraction), 0)
        assert few.xy.tolist() == [[a, a], [b, a], [a, b], [b, b]]


def test_lines_keeps_whole_rows() -> None:
    got = sample_points(DEPTH, SamplePattern(kind="lines", count=4), 0)
    assert np.unique(got.xy[:, 1]).tolist() == [7, 22, 37, 52]
    assert len(got.depth) == 4 * 80
    every = sample_points(DEPTH, SamplePattern(kind="lines", count=60), 0)
    assert np.array_equal(every.depth, DEPTH.ravel())
    with pytest.raises(UsageError):
        sample_points(DEPTH, SamplePattern(kind="lines", count=61), 0)


def test_features_lie_at_the_corners_of_the_image() -> None:
    image = np.full((160, 200, 3), 0.2, np.float32)
    image[40:120, 20:150] = 0.9
    image[10:30, 170:190] = 0.3  # its corners are weaker
    depth = np.full((160, 200), 3, np.float32)
    got = sample_points(depth, SamplePattern(kind="features", count=8), 0, image=image)
    corners = np.array([[20, 40], [149, 40], [20, 119], [149, 119]])
    away = np.abs(got.xy[:, None] - corners).max(axis=2)
    assert away.min(axis=1).max() <= 6
    assert len(got.depth) == 8
    assert (away.min(axis=0) <= 6).all()


def test_what_the_depth_map_cannot_give_is_refused() -> None:
    with pytest.raises(NoPointsError):
        sample_points(np.zeros((5, 5), np.float32), SamplePattern(count=1), 0)
    plain = np.full((60, 80, 3), 0.5, np.float32)
    with pytest.raises(NoPointsError):
        sample_points(DEPTH, SamplePattern(kind="features", count=3), 0, image=plain)
    with pytest.raises(UsageError):
        sample_points(DEPTH, SamplePattern(kind="features", count=3), 0)
    with pytest.raises(UsageError):
        sample_points(DEPTH, SamplePattern(count=4801), 0)
    image = np.zeros((30, 40, 3), np.float32)
    with pytest.raises(SizeError, match=r"\b40×30"):
        sample_points(DEPTH, SamplePattern(kind="features", count=3), 0, image=image)
