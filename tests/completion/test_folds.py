from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pnpdepth_cli.completion.folds import spatial_folds, under_holes
from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.points import SparsePoints


def points_at(xy: torch.Tensor, size: tuple[int, int] = (160, 300)) -> SparsePoints:
    return SparsePoints(xy=xy.float(), depth=torch.ones(len(xy)), size=size)


def on_lines(gap: int, step: int) -> SparsePoints:
    y, x = torch.meshgrid(torch.arange(10, 150, gap), torch.arange(0, 300, step), indexing="ij")
    return points_at(torch.stack([x.flatten(), y.flatten()], dim=1))


@settings(deadline=None, max_examples=40)
@given(count=st.integers(1, 300), folds=st.integers(2, 6), seed=st.integers(0, 99))
def test_all_points_have_folds_of_about_one_size(count: int, folds: int, seed: int) -> None:
    xy = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed)) * 89
    fold = spatial_folds(points_at(xy, (90, 90)), folds, seed=seed)
    sizes = torch.bincount(fold, minlength=folds)
    assert (len(sizes), int(sizes.sum())) == (folds, count)
    assert int(sizes.max()) <= count // folds + max(2, count // 5)


@pytest.mark.parametrize("gap", [4, 8])
def test_points_on_lines_are_held_out_as_far_off_as_pixels_are(gap: int) -> None:
    points = on_lines(gap, 1)  # a neighbour on the line would be 1 pixel off
    held = spatial_folds(points, 4) == 0
    kept = points.select(~held)
    apart = nearest_points(kept, points.xy[held].double(), 1)[0].median()
    assert float(apart) >= gap / 4  # the median distance of pixels between lines


def test_neighbouring_scan_lines_are_in_different_folds() -> None:
    fold = spatial_folds(on_lines(5, 2), 4, seed=3).reshape(28, 150)
    assert bool((fold == fold[:, :1]).all())
    assert bool((fold[1:, 0] != fold[:-1, 0]).all())
    assert len(fold[:, 0].unique()) == 4


@pytest.mark.parametrize("seed", range(4))
def test_of_clustered_points_whole_cells_are_held_out_as_far_off_as_pixels_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy = rng.uniform((10, 10), (290, 150), (60, 1, 2)) + rng.normal(0, 1.5, (60, 15, 2))
    xy = xy.reshape(-1, 2).astype(np.float32)
    held = spatial_folds(points_at(torch.from_numpy(xy)), 5, seed=seed).numpy() == 0
    pixels = rng.uniform(*np.quantile(xy, (0.02, 0.98), axis=0), (9000, 2))
    of_pixels, apart = (
        np.median(cKDTree(support).query(asked)[0])
        for support, asked in ((xy, pixels), (xy[~held], xy[held]))
    )
    assert 0.85 * of_pixels < apart < 2.8 * of_pixels
    assert held.sum() == pytest.approx(180, abs=20)


def map_with_holes(radius: int, *, size: tuple[int, int] = (120, 160), seed: int = 0) -> np.ndarray:
    """Which pixels of a depth map are known: all but some discs."""
    rng = np.random.default_rng(seed)
    row, column = np.indices(size)
    known = np.ones(size, np.bool_)
    while known.mean() > 0.85:
        y, x = rng.uniform((0, 0), size)
        known &= np.hypot(row - y, column - x) > radius
    return known


def points_of(known: np.ndarray) -> SparsePoints:
    row, column = known.nonzero()
    return points_at(torch.from_numpy(np.stack([column, row], axis=1)), known.shape)


@pytest.mark.parametrize("radius", [3, 8, 16])
@pytest.mark.parametrize("zoom", [1, 3])
def test_points_under_copies_of_holes_are_as_far_from_the_others_as_pixels_in_holes(
    radius: int, zoom: int
) -> None:
    known = map_with_holes(radius)
    height, width = known.shape
    points = points_of(known).resized(zoom * height, zoom * width)
    held = under_holes(points, 5, seed=1)
    assert held is not None
    held = held > 0
    apart = nearest_points(points.select(~held), points.xy[held].double(), 1)[0].median() / zoom
    unknown = torch.from_numpy(np.argwhere(~known)[:, ::-1].copy())
    in_holes = nearest_points(points_of(known), unknown.double(), 1)[0].median()
    assert 0.6 * float(in_holes) < float(apart) < 1.7 * float(in_holes)
    assert 0.1 * len(points) < int(held.sum()) <= len(points) // 5


def test_a_map_with_holes_has_points_under_copies_of_them() -> None:
    assert under_holes(points_of(map_with_holes(4)), 5) is not None


def test_a_full_map_has_no_holes_to_copy() -> None:
    assert under_holes(points_of(np.ones((90, 120), np.bool_)), 5) is None


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6])
def test_gaps_between_random_pixels_are_no_holes(share: float) -> None:
    pixels = np.random.default_rng(0).uniform(size=(90, 120)) < share
    assert under_holes(points_of(pixels), 5) is None


def test_gaps_between_points_beside_pixels_are_no_holes() -> None:
    between = torch.from_numpy(np.random.default_rng(0).uniform(0, 89, (8000, 2)))
    assert under_holes(points_at(between, (90, 90)), 5) is None


def test_gaps_between_lines_of_a_scan_are_no_holes() -> None:
    assert under_holes(on_lines(5, 1), 5) is None


def test_a_single_point_has_no_holes_beside_it() -> None:
    assert under_holes(points_at(torch.zeros(1, 2)), 5) is None


def test_copies_of_holes_follow_the_seed() -> None:
    points = points_of(map_with_holes(6))
    first, same, other = (under_holes(points, 5, seed=seed) for seed in (0, 0, 1))
    assert first is not None
    assert same is not None
    assert other is not None
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_a_copy_of_a_large_hole_hides_no_more_than_a_fold() -> None:
    known = np.ones((100, 100), np.bool_)
    known[20:80, 20:80] = False
    alone = under_holes(points_of(known), 5)
    assert alone is None or int((alone > 0).sum()) <= 6400 // 5


def test_beside_a_large_hole_copies_of_small_ones_hide_points() -> None:
    known = np.ones((100, 100), np.bool_)
    known[20:80, 20:80] = False
    known[2:6, 2:6] = False
    beside = under_holes(points_of(known), 5)
    assert beside is not None
    assert 0 < int((beside > 0).sum()) <= 6400 // 5
