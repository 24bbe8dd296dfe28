from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.completion.alignment import BEYOND, align_prediction
from pnpdepth_cli.completion.baselines import align_locally
from pnpdepth_cli.completion.outliers import inlier_weights
from tests.completion.scenes import mean_log_error, random_points, scene_depth

MODELLED = {
    "median": lambda d: d / 7,
    "scale": lambda d: d / 7,
    "affine": lambda d: (d + 2) / 7,
    "scale-disparity": lambda d: 7 * d,
    "affine-disparity": lambda d: 1 / (3 / d + 0.5),
    "local": lambda d: (d + 2) / 7,
}
"""The predictions that alignments restore."""


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_is_near_the_ground_truth_and_does_not_change_its_arguments(name: str) -> None:
    depth = scene_depth()
    points = random_points(depth, 200)
    prediction = MODELLED.get(name, lambda d: d / 3)(depth)
    given = (points.xy, points.depth, prediction)
    before = [tensor.clone() for tensor in given]
    dense = BASELINES[name](points, prediction)
    assert (dense.shape, dense.dtype) == (depth.shape, torch.float32)
    assert mean_log_error(dense, depth) < 0.1
    assert name not in MODELLED or torch.allclose(dense, depth, rtol=1e-3)
    assert all(torch.equal(tensor, changed) for tensor, changed in zip(before, given, strict=True))


def test_the_line_around_a_pixel_is_the_weighted_least_squares_fit_to_its_twelve_points() -> None:
    gt = scene_depth()
    points = random_points(gt, 40)
    outlier = torch.arange(40) % 10 == 3
    points = replace(points, depth=torch.where(outlier, 5 * points.depth, points.depth))
    prediction = gt * torch.linspace(0.6, 1.5, gt.shape[1])
    x = align_prediction(prediction, points, kind="affine").double()
    at_points = points.sample(x).numpy()
    y = points.depth.double().numpy()
    mean = at_points.mean()
    std = at_points.std()
    inlier = inlier_weights(points, torch.from_numpy(np.log(y / at_points))).numpy()
    assert inlier.min() == 0 < inlier.max()
    dense = align_locally(points, prediction)
    for row, column in ((5, 5), (47, 0), (30, 15), (20, 60)):
        distance = np.hypot(*(points.xy.numpy() - (column, row)).T)
        near = np.argsort(distance)[:12]
        weight = np.maximum(distance[near], 0.5) ** -3.0 * (inlier[near] + 1e-6)
        root = np.sqrt(weight / weight.sum())
        z = (at_points[near] - mean) / std
        lines = np.vstack([np.column_stack([root, root * z]), [0, 0.03**0.5]])
        values = np.append(root * (y - at_points)[near], 0)
        shift, slope = np.linalg.lstsq(lines, values)[0]
        here = float(x[row, column])
        expected = here + shift + slope * (here - mean) / std
        assert float(dense[row, column]) == pytest.approx(expected, rel=1e-5)


def test_few_points_show_a_factor_and_depth_stays_within_the_bounds_of_a_global_alignment() -> None:
    prediction = scene_depth()
    for count in (1, 2):
        dense = align_locally(random_points(prediction, count), prediction / 3)
        assert torch.allclose(dense, prediction, rtol=1e-3)
    points = random_points(prediction, 100)
    prediction[0, 0], prediction[0, 1] = 1e6, 1e-6
    dense = align_locally(points, prediction)
    factor = BEYOND * (1 + 1 / 100) * (1 + 1e-5)
    assert float(dense.max()) <= float(points.depth.max()) * factor
    assert float(dense.min()) >= float(points.depth.min()) / factor
