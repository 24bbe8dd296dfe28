from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pnpdepth_cli.choices import PROPAGATIONS
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.points import SparsePoints
from tests.completion.scenes import SIZE, mean_log_error, random_points, scene


@pytest.mark.parametrize("kind", PROPAGATIONS)
@pytest.mark.parametrize("count", [30, 400])
@pytest.mark.parametrize("flat", [None, "image", "prediction"])
def test_a_drifting_prediction_is_put_right(kind: str, count: int, flat: str | None) -> None:
    gt, rgb, prediction = scene()
    if flat == "prediction":
        prediction = torch.full(SIZE, 2.0)
        rgb = torch.full((3, *SIZE), 0.5)
    points = random_points(gt, max(count, 100) if flat == "prediction" else count)
    depth = ResidualField(prediction, points, None if flat == "image" else rgb).depth(kind=kind)
    assert depth.dtype == torch.float32
    assert bool((depth > 0).all())
    assert mean_log_error(depth, gt) < 0.5 * mean_log_error(prediction, gt)
    if kind == "gp" and count == 400 and flat is None:  # the points keep their depth
        assert mean_log_error(points.sample(depth), points.depth) < 0.01


@pytest.mark.parametrize("kind", PROPAGATIONS)
def test_one_point_moves_all_by_its_factor_and_nothing_left_moves_nothing(kind: str) -> None:
    gt, rgb, prediction = scene()
    exact = ResidualField(gt, random_points(gt, 50), rgb).depth(kind=kind)
    assert torch.allclose(exact, gt, rtol=1e-6)
    moved = ResidualField(gt / 1.5, random_points(gt, 1), rgb).depth(kind=kind)
    assert torch.allclose(moved, gt, rtol=0.01)
    as_it_is = ResidualField(prediction, random_points(gt, 9), rgb).depth(kind="none")
    assert torch.equal(as_it_is, prediction)


@pytest.mark.parametrize("kind", PROPAGATIONS)
@pytest.mark.parametrize("count", [2, 5])
def test_few_points_bring_no_depth_beyond_what_they_say(kind: str, count: int) -> None:
    gt, rgb, prediction = scene()
    points = random_points(gt, count)
    factor = ResidualField(prediction, points, rgb).depth(kind=kind) / prediction
    ratio = points.depth / points.sample(prediction)
    assert float(ratio.min()) * (1 - 1e-5) <= float(factor.min())
    assert float(factor.max()) <= float(ratio.max()) * (1 + 1e-5)


@pytest.mark.parametrize("kind", PROPAGATIONS)
@pytest.mark.parametrize("count", [60, 400])
def test_outliers_do_not_propagate(kind: str, count: int) -> None:
    gt, rgb, prediction = scene()
    points = random_points(gt, count)
    # a fifth are 2 to 20 times too near or too far
    random, side = torch.rand(2, count, generator=torch.Generator().manual_seed(3))
    off = ((0.7 + 2.3 * random) * torch.where(side < 0.5, -1, 1)).exp()
    off[torch.arange(count) % 5 > 0] = 1
    clean, disturbed = (
        mean_log_error(ResidualField(prediction, p, rgb).depth(kind=kind), gt)
        for p in (points, replace(points, depth=points.depth * off))
    )
    assert disturbed < 1.5 * clean + 0.01


@pytest.mark.parametrize("kind", PROPAGATIONS)
def test_an_unknown_prediction_stays_unknown_and_its_points_have_no_effect(kind: str) -> None:
    gt, rgb, prediction = scene()
    points = random_points(gt, 40)
    unknown = prediction.clone()
    unknown[:, :20] = 0
    unknown[0, 30], unknown[0, 31] = torch.inf, torch.nan
    depth = ResidualField(unknown, points, rgb).depth(kind=kind)
    known = unknown.isfinite() & (unknown > 0)
    assert torch.equal(depth != 0, known)
    as_it_is = ResidualField(unknown, points, rgb).depth(kind="none")
    assert torch.equal(as_it_is, torch.where(known, unknown, 0))
    beside, inside = torch.tensor([[[19.5, 9.0], [20.0, 9.0]], [[20.5, 9.0], [63.0, 9.0]]])
    assert not bool((ResidualField(unknown, points, rgb).depth(beside, kind=kind) > 0)[0])
    assert bool((ResidualField(unknown, points, rgb).depth(inside, kind=kind) > 0).all())
    lying = replace(points, depth=torch.where(points.xy[:, 0] < 20, 99.0, points.depth))
    assert torch.equal(ResidualField(unknown, lying, rgb).depth(kind=kind), depth)


@pytest.mark.parametrize("kind", PROPAGATIONS)
def test_points_outside_the_frame_and_farther_ones_at_one_pixel_have_no_effect(kind: str) -> None:
    gt, rgb, prediction = scene()
    points = random_points(gt, 30)
    xy = torch.cat([torch.tensor([[-9.0, 5.0], [70.0, 5.0]]), points.xy[:3]])
    depth = torch.cat([torch.tensor([30.0, 0.1]), 2 * points.depth[:3]])
    more = points.joined(SparsePoints(xy=xy, depth=depth, size=SIZE))
    result, again = (ResidualField(prediction, p, rgb).depth(kind=kind) for p in (points, more))
    assert torch.equal(result, again)


@pytest.mark.parametrize(("kind", "rtol"), [("gp", 0.01), ("local", 1e-5)])
def test_every_second_pixel_of_a_large_image_is_as_of_it_alone(kind: str, rtol: float) -> None:
    y, x = torch.meshgrid(torch.arange(641.0), torch.arange(801.0), indexing="ij")
    prediction = 2 + x / 801 + (y / 641).square()
    points = random_points(prediction * (1 + 0.3 * torch.sin(x / 200)), 30)
    random = torch.rand(200, 2, generator=torch.Generator().manual_seed(6))
    pixels = 2 * (random * torch.tensor([400.0, 320.0])).round()
    depth = ResidualField(prediction, points, None).depth(kind=kind)
    alone = ResidualField(prediction, points, None).depth(pixels, kind=kind)
    column, row = pixels.long().unbind(1)
    assert torch.allclose(depth[row, column], alone, rtol=rtol)
