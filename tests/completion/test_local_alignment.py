from __future__ import annotations

import numpy as np
import pytest
import torch

from pnpdepth_cli.choices import SPACES
from pnpdepth_cli.completion.alignment import BEYOND, align_prediction, from_space, to_space
from pnpdepth_cli.completion.baselines import align_locally
from pnpdepth_cli.completion.outliers import inlier_weights
from pnpdepth_cli.completion.propagation import RIDGE
from pnpdepth_cli.points import SparsePoints
from tests.completion.scenes import SIZE, random_points, scene_depth


def spoiled(points: SparsePoints, fraction: float = 0.2) -> SparsePoints:
    """Some points replaced by a depth 2 to 20 times too near or too far."""
    generator = torch.Generator().manual_seed(3)
    random = torch.rand(3, len(points), generator=generator)
    off = (0.7 + 2.3 * random[1]) * torch.where(random[2] < 0.5, -1, 1)
    depth = torch.where(random[0] < fraction, points.depth * off.exp(), points.depth)
    return SparsePoints(xy=points.xy, depth=depth, size=points.size)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("count", [1, 2, 3, 30, 400])
def test_a_prediction_that_is_a_line_away_everywhere_is_restored(space: str, count: int) -> None:
    gt = scene_depth()
    prediction = from_space((to_space(gt, space) + 0.3) / 0.7, space)
    if count < 3:  # a factor is all that one and two points show
        prediction = gt / 3
    dense = align_locally(prediction, random_points(gt, count), space=space)
    assert torch.allclose(dense, gt, rtol=1e-3)


def test_the_line_around_a_pixel_is_the_weighted_least_squares_fit_to_its_twelve_points() -> None:
    gt = scene_depth()
    points = spoiled(random_points(gt, 40), 0.1)
    prediction = gt * torch.linspace(0.6, 1.5, SIZE[1])
    x = align_prediction(prediction, points, kind="auto", space="depth").double()
    at_points, y = points.sample(x).numpy(), points.depth.double().numpy()
    mean, std = at_points.mean(), at_points.std()
    inlier = inlier_weights(points, torch.from_numpy(np.log(y / at_points))).numpy()
    assert inlier.min() == 0 < inlier.max()
    dense = align_locally(prediction, points)
    for row, column in ((5, 5), (47, 0), (30, 15), (20, 60)):
        distance = np.hypot(*(points.xy.numpy() - (column, row)).T)
        near = np.argsort(distance)[:12]
        weight = np.maximum(distance[near], 0.5) ** -3.0 * (inlier[near] + 1e-6)
        root = np.sqrt(weight / weight.sum())
        z = (at_points[near] - mean) / std
        lines = np.vstack([np.column_stack([root, root * z]), [0, RIDGE**0.5]])
        values = np.append(root * (y - at_points)[near], 0)
        shift, slope = np.linalg.lstsq(lines, values)[0]
        here = float(x[row, column])
        expected = here + shift + slope * (here - mean) / std
        assert float(dense[row, column]) == pytest.approx(expected, rel=1e-5)


def test_depth_stays_within_the_bounds_of_a_global_alignment() -> None:
    gt = scene_depth()
    points = random_points(gt, 100)
    prediction = gt.clone()
    prediction[0, 0], prediction[0, 1] = 1e6, 1e-6
    dense = align_locally(prediction, points, space="inverse")
    assert float(dense.max()) <= float(points.depth.max()) * BEYOND * (1 + 1e-5)
    assert float(dense.min()) >= float(points.depth.min()) / BEYOND * (1 - 1e-5)
