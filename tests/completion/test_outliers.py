"""Which points are outliers, and how much each point weighs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pnpdepth_cli.completion.outliers import FAR, far_points, inlier_mask, inlier_weights, outliers
from pnpdepth_cli.points import SparsePoints
from tests.completion.scenes import random_points, scene
from tests.completion.test_gaussian_process import field


@pytest.mark.parametrize("count", [40, 600])
def test_outliers_are_left_out_and_inliers_kept(count: int) -> None:
    residuals = field(count, size=(60, 80))
    assert bool(inlier_mask(residuals).all())
    outlier = torch.arange(count) % 7 == 0
    jump = 1 + torch.rand(count, generator=torch.Generator().manual_seed(1)).double()
    jump = torch.where(torch.arange(count) % 2 == 0, jump, -jump)
    spoiled = replace(
        residuals, residual=torch.where(outlier, residuals.residual + jump, residuals.residual)
    )
    kept = spoiled.select(inlier_mask(spoiled))
    recall = 1 - float(((kept.residual - 0.2).abs() > 0.35).sum()) / int(outlier.sum())
    assert recall == 1 if count == 40 else recall > 0.9
    assert len(kept.points) > 0.9 * int((~outlier).sum())


@pytest.mark.parametrize("count", [120, 250])
def test_points_far_from_the_prediction_are_inliers_where_they_agree(count: int) -> None:
    residuals = field(count, size=(60, 80))
    x, y = residuals.points.xy.unbind(1)
    corridor = (x < 30) & (y < 30)
    assert 10 < int(corridor.sum()) < count // 4
    deep = torch.where(corridor, 2.0 + x / 30, 0.0).double()
    kept = inlier_mask(replace(residuals, residual=residuals.residual + deep))
    assert int((~kept).sum()) <= int(corridor.sum()) // 3  # those at its edge have other neighbours


def test_outliers_are_marked_in_the_order_of_the_points() -> None:
    ground_truth, rgb, prediction = scene()
    points = random_points(ground_truth, 150)
    assert not bool(outliers(prediction, points, rgb).any())
    bad = torch.arange(150) % 6 == 0
    outside = replace(points, xy=torch.tensor([[-9.0, 3.0]]), depth=torch.tensor([50.0]))
    far = replace(points, depth=torch.where(bad, 3 * points.depth, points.depth))
    spoiled = far.joined(outside)
    suspected = outliers(prediction, spoiled, rgb)
    assert int(suspected[:150][bad].sum()) > 0.9 * int(bad.sum())
    assert int(suspected.sum()) < 2 * int(bad.sum())
    assert not bool(suspected[150])  # nothing is known there


def test_points_far_from_a_prediction_are_those_beyond_the_limit_unless_they_are_half() -> None:
    prediction = torch.tensor([[2.0, 2.0, 2.0], [2.0, 2.0, 0.0]])
    factor = torch.tensor([-1.01, -0.99, 0.99, 1.01, 0.0, 9.0]).mul(FAR).exp()
    xy = torch.tensor([[x, y] for y in (0.0, 1.0) for x in (0.0, 1.0, 2.0)])
    points = SparsePoints(xy=xy, depth=2 * factor, size=(2, 3))
    assert far_points(prediction, points).tolist() == [True, False, False, True, False, False]
    assert far_points(prediction, points.select(torch.arange(6) < 4)).tolist() == [False] * 4


def test_a_point_alone_among_its_neighbours_has_no_weight() -> None:
    points = random_points(scene()[0], 50)
    residual = 0.01 * torch.randn(50, generator=torch.Generator().manual_seed(2)).double()
    residual[7] = 1.0
    weights = inlier_weights(points, residual)
    assert float(weights[7]) == 0
    assert float(weights[torch.arange(50) != 7].min()) > 0.5
    assert torch.equal(
        inlier_weights(points.select(torch.arange(50) < 2), residual[:2]), torch.ones(2).double()
    )
