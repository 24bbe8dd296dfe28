from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.spatial import Delaunay

from pnpdepth_cli.completion.gaussian_process import cielab
from pnpdepth_cli.completion.registration_evidence import evidence
from pnpdepth_cli.points import SparsePoints
from tests.completion.unregistered import SIZE, UNREGISTERED, frame


def test_points_that_were_found_in_the_image_show_nothing() -> None:
    rgb, _ = frame(0)
    contrast = np.abs(np.diff(rgb.mean(-1), axis=1))[:, :-1] > 0.1
    rng = np.random.default_rng(0)
    found = rng.choice(np.argwhere(contrast)[:, ::-1].astype(np.float32), 300, replace=False)
    depth = torch.from_numpy(rng.uniform(1, 5, 300).astype(np.float32))
    assert evidence(rgb, SparsePoints(xy=torch.from_numpy(found), depth=depth, size=SIZE)) is None


@pytest.mark.parametrize(
    "choose",
    [
        pytest.param(lambda x, y: y % 8 == 0, id="scan lines"),
        pytest.param(lambda x, y: torch.arange(len(x)) < 9, id="few points"),
        pytest.param(lambda x, y: x < 100, id="points of one side"),
    ],
)
def test_scan_lines_and_few_points_and_points_of_one_side_show_nothing(
    choose: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
) -> None:
    rgb, points = frame(0, UNREGISTERED, count=4000)
    assert evidence(rgb, points.select(choose(*points.xy.unbind(1)))) is None


def points_beside_pixels(count: int) -> tuple[np.ndarray, SparsePoints]:
    """An image, and points that lie beside the centres of its pixels."""
    rgb, points = frame(1, count=count)
    moved = np.random.default_rng(3).uniform(-0.3, 0.3, (count, 2)).astype(np.float32)
    return rgb, replace(points, xy=points.xy + torch.from_numpy(moved))


class Pairs(NamedTuple):
    """Pairs of neighbouring points without the 5 % that are farthest apart."""

    ends: np.ndarray
    """Positions (N, 2, 2) of both points."""
    length: np.ndarray
    """Pixels (N,) between them."""
    change: np.ndarray
    """How much (N,) the logarithm of their depths differs."""


def pairs_of_neighbours(points: SparsePoints) -> Pairs:
    at = points.xy.double().numpy() + 0.5
    depth = points.depth.double().numpy()
    first, near = Delaunay(at).vertex_neighbor_vertices
    pairs = np.column_stack([np.repeat(np.arange(len(points)), np.diff(first)), near])
    pairs = np.array(sorted(map(tuple, pairs[pairs[:, 0] < pairs[:, 1]])))
    length = np.hypot(*(at[pairs[:, 0]] - at[pairs[:, 1]]).T)
    is_near = length <= np.quantile(length, 0.95)
    pairs = pairs[is_near]
    change = np.abs(np.log(depth[pairs[:, 0]] / depth[pairs[:, 1]]))
    return Pairs(ends=at[pairs], length=length[is_near], change=change)


@pytest.mark.parametrize("count", [200, 1500])
def test_edges_are_those_over_the_edges_within_8_pixels_less_those_within_6(count: int) -> None:
    rgb, points = points_beside_pixels(count)
    lab = cielab(torch.from_numpy(rgb).permute(2, 0, 1)).double().numpy() / 100
    smooth = [ndimage.gaussian_filter(channel, 1.0, mode="mirror") for channel in lab]
    slopes = [
        ndimage.sobel(channel, axis, mode="reflect") / 8 for channel in smooth for axis in (0, 1)
    ]
    strength = np.sqrt(np.square(slopes).sum(axis=0))
    relative = strength / (ndimage.gaussian_filter(strength, 8.0, mode="mirror") + 0.01)
    edges = relative - ndimage.gaussian_filter(relative, 6.0, mode="mirror")
    assert np.allclose(evidence(rgb, points).edges, edges / edges.std(), atol=2e-3)


@pytest.mark.parametrize("count", [200, 1500])
def test_twelve_samples_lie_evenly_between_the_points_of_a_pair(count: int) -> None:
    rgb, points = points_beside_pixels(count)
    ends = pairs_of_neighbours(points).ends
    between = evidence(rgb, points).between.reshape(len(ends), 12, 2)
    assert np.allclose(between.mean(axis=1), ends.mean(axis=1))
    assert np.allclose(np.ptp(between, axis=1), np.ptp(ends, axis=1) * 11 / 12)


@pytest.mark.parametrize("count", [200, 1500])
def test_a_pair_weighs_what_its_change_of_depth_is_beyond_that_of_its_length(count: int) -> None:
    rgb, points = points_beside_pixels(count)
    _, length, change = pairs_of_neighbours(points)
    of_length = np.polyfit(np.log(length + 0.1), np.log(change + 0.03), 1)
    rest = np.log(change + 0.03) - np.polyval(of_length, np.log(length + 0.1))
    weight = (rest / rest.std()).clip(-2.5, 2.5)
    weight -= weight.mean()
    weight *= 0.1 * min(1, 37 / np.linalg.norm(weight))
    assert np.allclose(evidence(rgb, points).weight, np.repeat(weight, 12) / 12)


@pytest.mark.parametrize("count", [200, 1500])
def test_jumps_are_counted_and_those_among_the_shorter_half_of_all_lengths(count: int) -> None:
    rgb, points = points_beside_pixels(count)
    _, length, change = pairs_of_neighbours(points)
    ordered = np.sort(length)
    half = ordered[ordered.cumsum() >= ordered.sum() / 2][0]
    jump = change > 0.15
    shown = evidence(rgb, points)
    assert (shown.jumps, shown.short_jumps) == (jump.sum(), (jump & (length < half)).sum())


@pytest.mark.parametrize("count", [200, 1500])
def test_a_frame_of_twice_the_size_is_reduced_to_the_same(count: int) -> None:
    rgb, points = points_beside_pixels(count)
    twice = SparsePoints(xy=2 * points.xy + 0.5, depth=points.depth, size=(480, 640))
    larger = evidence(rgb.repeat(2, axis=0).repeat(2, axis=1), twice)
    shown = evidence(rgb, points)
    assert np.allclose(larger.between, shown.between, atol=1e-3)
    assert np.allclose(larger.edges, shown.edges, atol=1e-3)


def test_a_gain_is_that_of_the_samples_in_each_part_of_the_image() -> None:
    known = evidence(*frame(0, UNREGISTERED))
    gains = known.gain(0.9, -5, 3)
    assert gains.shape == (24 * 32,)
    half = (known.edges.shape[0] // 2, known.edges.shape[1] // 2)
    middle = (12, 16)  # of the shifts that are searched
    more = known.log_likelihood(0.9)[middle[0] + 3, middle[1] - 5]
    assert gains.sum() == pytest.approx(more - known.log_likelihood(1.0)[middle], abs=0.02)
    # Without the samples of the left half, nothing is gained there.
    x = known.between[:, 0]
    right = replace(known, between=known.between[x >= half[1]], weight=known.weight[x >= half[1]])
    rows = right.gain(0.9, -5, 3).reshape(24, 32)
    assert not rows[:, :16].any()
    assert np.allclose(rows[:, 16:], gains.reshape(24, 32)[:, 16:])
