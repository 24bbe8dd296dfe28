from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from pnpdepth_cli.completion.gaussian_process import Residuals, leave_one_out
from pnpdepth_cli.completion.outliers import FAR, far_points, inlier_mask, inlier_weights
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.points import SparsePoints
from tests.completion.residuals import field
from tests.completion.scenes import random_points, scene


def test_outliers_are_left_out_and_inliers_kept() -> None:
    residuals = field(600, size=(60, 80))
    assert bool(inlier_mask(residuals).all())
    outlier = torch.arange(600) % 7 == 0
    jump = 1 + torch.rand(600, generator=torch.Generator().manual_seed(1)).double()
    jump[::2] *= -1
    spoiled = replace(residuals, residual=residuals.residual + outlier * jump)
    kept = inlier_mask(spoiled)
    assert int((~kept & outlier).sum()) > 0.9 * int(outlier.sum())
    assert int((kept & ~outlier).sum()) > 0.9 * int((~outlier).sum())


def inliers_in_numpy(residuals: Residuals) -> np.ndarray:
    """The inliers among up to 256 points, from their description; one of few that are exact."""
    xy = residuals.points.xy.double().numpy()
    count = len(residuals.points)
    everyone = torch.arange(count)[None]
    weight = inlier_weights(residuals.points, residuals.residual).numpy()
    for cutoff in (4, 4, 5, 6, 8):
        error, variance = leave_one_out(residuals, everyone, torch.from_numpy(weight))
        ratio = (error.abs() / variance.sqrt()).numpy()[0]
        typical = 1.4826 * np.sort(ratio)[(count - 1) // 2]
        weight = np.clip(1 - (ratio / (cutoff * typical)) ** 2, 0, None) ** 2
    suspected = weight <= 0.05
    around = np.hypot(*(xy[:, None] - xy).transpose(2, 0, 1)).argsort(axis=1)[:, 1:7]
    together = suspected & (suspected[around].sum(axis=1) >= 4)
    for _ in range(count):  # those beside them, too
        together |= suspected & (together[around].sum(axis=1) >= 3)
    inlier = ~suspected | together
    weight = np.where(inlier, np.maximum(weight, 0.05), weight)
    alone, beside = (
        np.abs(leave_one_out(residuals, everyone, weights)[0].numpy()[0]) @ weight
        for weights in (None, torch.from_numpy(weight))
    )
    return inlier if beside < 0.5 * alone and inlier.any() else np.ones(count, bool)


def test_inliers_are_those_of_the_description() -> None:
    shares = []
    for seed in (*range(12), 62, 74):  # in the last two, each cut-off decides
        rng = np.random.default_rng(seed)
        residuals = field(90, size=(60, 80), seed=seed)
        xy = residuals.points.xy.numpy() + rng.uniform(-0.4, 0.4, (90, 2)).astype(np.float32)
        corridor = np.hypot(*(xy - rng.uniform(10, 50, 2)).T) < rng.uniform(5, 14)
        lone = rng.uniform(size=90) < rng.choice([0.0, 0.05, 0.2])
        off = 2.0 * corridor + rng.uniform(0.2, 1.5, 90) * lone
        points = replace(residuals.points, xy=torch.from_numpy(xy))  # no two at one distance
        residual = residuals.residual + torch.from_numpy(off)
        spoiled = replace(residuals, points=points, residual=residual)
        found = inlier_mask(spoiled).numpy()
        assert np.array_equal(found, inliers_in_numpy(spoiled)), seed
        shares += [found.mean(), (found & (corridor | lone)).mean()]
    assert min(shares[::2]) < 0.9 < max(shares[::2]) == 1
    assert max(shares[1::2]) > 0.05


def test_outliers_are_marked_in_the_order_of_the_points() -> None:
    ground_truth, rgb, prediction = scene()
    points = random_points(ground_truth, 150)
    assert not bool(ResidualField(prediction, points, rgb).outliers.any())
    bad = torch.arange(150) % 6 == 0
    outside = replace(points, xy=torch.tensor([[-9.0, 3.0]]), depth=torch.tensor([50.0]))
    far = replace(points, depth=torch.where(bad, 3 * points.depth, points.depth))
    spoiled = far.joined(outside)
    suspected = ResidualField(prediction, spoiled, rgb).outliers
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


def test_a_weight_is_the_biweight_of_the_second_best_agreement_with_eight_neighbours() -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 60, (51, 2))
    residual = 0.02 * rng.standard_t(1.5, 51)
    apart = np.hypot(*(xy[:, None] - xy).transpose(2, 0, 1))
    near = apart.argsort(axis=1)[:, 1:9]
    second = np.sort(np.abs(residual[near] - residual[:, None]), axis=1)[:, 1]
    ratio = second / (10 * 1.4826 * np.median(second))  # 10 robust standard deviations
    points = SparsePoints(xy=torch.from_numpy(xy), depth=torch.ones(51), size=(60, 60))
    weights = inlier_weights(points, torch.from_numpy(residual)).numpy()
    assert np.allclose(weights, np.clip(1 - ratio**2, 0, None) ** 2)
    assert weights.min() == 0 < weights.max() < 1 + 1e-9
    few = inlier_weights(points.select(torch.arange(51) < 2), torch.tensor([0.0, 9.0]))
    assert few.tolist() == [1, 1]
