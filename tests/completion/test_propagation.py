from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pnpdepth_cli.choices import PROPAGATIONS
from pnpdepth_cli.completion.propagation import propagate, propagate_at
from pnpdepth_cli.errors import NoPointsError, UsageError
from pnpdepth_cli.points import SparsePoints

SIZE = (48, 64)
KINDS = ("none", *PROPAGATIONS)


def scene() -> tuple[Tensor, Tensor, Tensor]:
    """Depth (H, W) of a floor, a wall and a box, its picture, and a prediction that drifts."""
    y, x = torch.meshgrid(*(torch.arange(float(n)) for n in SIZE), indexing="ij")
    depth = torch.minimum(60 / (y - 10).clamp_min(1), 4 + 0.02 * x)
    depth[20:40, 10:30] = 1.4
    rgb = torch.stack([0.3 + 0.4 * (depth < 1.5), 0.5 + 0.2 * y / 48, 0.4 + 0 * x])
    return depth, rgb, depth * (0.7 + 0.5 * x / 64) * torch.where(depth < 1.5, 1.3, 1.0)


def seen(depth: Tensor, count: int, seed: int = 0) -> SparsePoints:
    chosen = torch.randperm(depth.numel(), generator=torch.Generator().manual_seed(seed))[:count]
    xy = torch.stack([chosen % SIZE[1], chosen // SIZE[1]], dim=1).float()
    return SparsePoints(xy=xy, depth=depth.flatten()[chosen], size=SIZE)


def spoiled(points: SparsePoints) -> SparsePoints:
    """A fifth of the points replaced by a depth 2 to 20 times too near or too far."""
    random = torch.rand(2, len(points), generator=torch.Generator().manual_seed(3))
    off = (0.7 + 2.3 * random[0]) * torch.where(random[1] < 0.5, -1, 1)
    wrong = torch.arange(len(points)) % 5 == 0
    depth = torch.where(wrong, points.depth * off.exp(), points.depth)
    return SparsePoints(xy=points.xy, depth=depth, size=SIZE)


def mean_error(depth: Tensor, truth: Tensor) -> float:
    return float((depth.log() - truth.log()).abs().mean())


@pytest.mark.parametrize("kind", PROPAGATIONS)
@pytest.mark.parametrize("count", [30, 400])
@pytest.mark.parametrize("coloured", [True, False])
def test_a_prediction_that_drifts_is_put_right(kind: str, count: int, coloured: bool) -> None:
    truth, rgb, prediction = scene()
    made = propagate(prediction, seen(truth, count), rgb if coloured else None, kind=kind)
    assert made.depth.dtype == torch.float32
    assert mean_error(made.depth, truth) < 0.5 * mean_error(prediction, truth)


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_left_leaves_the_prediction(kind: str) -> None:
    truth, rgb, _ = scene()
    assert torch.allclose(propagate(truth, seen(truth, 50), rgb, kind=kind).depth, truth, rtol=1e-6)


def test_without_propagation_the_prediction_is_the_result() -> None:
    truth, rgb, prediction = scene()
    assert torch.equal(propagate(prediction, seen(truth, 9), rgb, kind="none").depth, prediction)


@pytest.mark.parametrize("kind", PROPAGATIONS)
def test_one_point_moves_all_by_its_factor(kind: str) -> None:
    truth, rgb, _ = scene()
    made = propagate(truth / 1.5, seen(truth, 1), rgb, kind=kind)
    assert torch.allclose(made.depth, truth, rtol=0.01)


@pytest.mark.parametrize("kind", PROPAGATIONS)
@pytest.mark.parametrize("count", [2, 3, 4, 5, 6])
def test_few_points_bring_no_depth_beyond_what_they_say(kind: str, count: int) -> None:
    truth, rgb, prediction = scene()
    points = seen(truth, count)
    made = propagate(prediction, points, rgb, kind=kind)
    factor, said = made.depth / prediction, points.depth / points.sample(prediction)
    assert float(factor.min()) >= float(said.min()) * (1 - 1e-5)
    assert float(factor.max()) <= float(said.max()) * (1 + 1e-5)


@pytest.mark.parametrize("count", [60, 400])
def test_the_points_keep_their_depth(count: int) -> None:
    truth, rgb, prediction = scene()
    points = seen(truth, count)
    made = propagate(prediction, points, rgb).depth
    assert mean_error(points.sample(made), points.depth) < 0.01


@pytest.mark.parametrize("kind", PROPAGATIONS)
@pytest.mark.parametrize("count", [60, 400])
def test_wrong_points_do_not_spread(kind: str, count: int) -> None:
    truth, rgb, prediction = scene()
    points = seen(truth, count)
    clean, made = (
        mean_error(propagate(prediction, p, rgb, kind=kind).depth, truth)
        for p in (points, spoiled(points))
    )
    assert made < 1.5 * clean + 0.01


@pytest.mark.parametrize("kind", PROPAGATIONS)
@pytest.mark.parametrize("count", [7, 300])
def test_the_order_of_the_points_does_not_matter(kind: str, count: int) -> None:
    truth, rgb, prediction = scene()
    points = seen(truth, count)
    other = torch.randperm(count, generator=torch.Generator().manual_seed(1))
    turned = SparsePoints(xy=points.xy[other], depth=points.depth[other], size=SIZE)
    made, again = (propagate(prediction, p, rgb, kind=kind).depth for p in (points, turned))
    assert torch.equal(made, again)


@pytest.mark.parametrize("kind", KINDS)
def test_an_unknown_prediction_stays_unknown_and_its_points_tell_nothing(kind: str) -> None:
    truth, rgb, prediction = scene()
    points = seen(truth, 40)
    unknown = prediction.clone()
    unknown[:, :20] = 0
    unknown[0, 30], unknown[0, 31] = torch.inf, torch.nan
    made = propagate(unknown, points, rgb, kind=kind).depth
    known = unknown.isfinite() & (unknown > 0)
    assert torch.equal(made > 0, known)
    lying = SparsePoints(
        xy=points.xy, depth=torch.where(points.xy[:, 0] < 20, 99.0, points.depth), size=SIZE
    )
    assert torch.equal(propagate(unknown, lying, rgb, kind=kind).depth, made)


@pytest.mark.parametrize("kind", PROPAGATIONS)
def test_points_beyond_the_frame_and_farther_ones_at_one_place_tell_nothing(kind: str) -> None:
    truth, rgb, prediction = scene()
    points = seen(truth, 30)
    xy = torch.cat([points.xy, torch.tensor([[-9.0, 5.0], [70.0, 5.0]]), points.xy[:3]])
    depth = torch.cat([points.depth, torch.tensor([30.0, 0.1]), 2 * points.depth[:3]])
    more = SparsePoints(xy=xy, depth=depth, size=SIZE)
    made, again = (propagate(prediction, p, rgb, kind=kind).depth for p in (points, more))
    assert torch.equal(made, again)


@pytest.mark.parametrize("kind", PROPAGATIONS)
def test_a_flat_prediction_and_picture_become_a_surface_through_the_points(kind: str) -> None:
    truth = scene()[0]
    points = seen(truth, 100)
    made = propagate(torch.full(SIZE, 2.0), points, torch.full((3, *SIZE), 0.5), kind=kind).depth
    assert bool((made > 0).all())
    assert mean_error(made, truth) < 0.5 * mean_error(torch.full(SIZE, 2.0), truth)


@pytest.mark.parametrize("kind", KINDS)
def test_places_have_the_depth_of_the_picture(kind: str) -> None:
    truth, rgb, prediction = scene()
    points = seen(truth, 40)
    places = torch.tensor([[3.0, 4.0], [63.0, 47.0], [20.0, 30.0]])
    asked = SparsePoints(xy=places, depth=torch.ones(3), size=SIZE)
    made = propagate(prediction, points, rgb, kind=kind).depth
    found = propagate_at(prediction, points, rgb, places, kind=kind)
    assert torch.allclose(found, asked.sample(made), rtol=1e-4)


def test_sigma_has_two_thirds_of_the_truth_within_it() -> None:
    truth, rgb, prediction = scene()
    made = propagate(prediction, seen(truth, 150), rgb, sigma=True)
    assert made.sigma is not None
    within = ((made.depth - truth).abs() <= made.sigma).double().mean()
    assert 0.5 < float(within) < 0.9


def test_what_cannot_be_done_is_said() -> None:
    truth, rgb, prediction = scene()
    points = seen(truth, 9)
    with pytest.raises(UsageError, match="unknown propagation 'magic'"):
        propagate(prediction, points, rgb, kind="magic")
    with pytest.raises(UsageError, match="no standard deviation"):
        propagate(prediction, points, rgb, kind="diffusion", sigma=True)
    with pytest.raises(NoPointsError):
        propagate(torch.zeros(SIZE), points, rgb)
