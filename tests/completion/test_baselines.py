from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pnpdepth_cli.choices import BASELINES
from tests.completion.scenes import random_points

SIZE = (30, 40)


def ground_truth() -> Tensor:
    y, x = torch.meshgrid(*(torch.arange(float(n)) for n in SIZE), indexing="ij")
    return 1 + 0.05 * x + 0.1 * y + ((x - 20).square() + (y - 15).square() < 50) * 2.0


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_is_near_the_ground_truth_and_does_not_change_its_arguments(name: str) -> None:
    depth = ground_truth()
    points, prediction = random_points(depth, 80), depth / 3
    kept = (points.xy.clone(), points.depth.clone(), prediction.clone())
    dense = BASELINES[name].depth(points, prediction)
    assert dense.shape == SIZE
    assert dense.dtype == torch.float32
    assert float((dense.log() - depth.log()).abs().mean()) < 0.1
    assert all(
        torch.equal(a, b) for a, b in zip(kept, (points.xy, points.depth, prediction), strict=True)
    )


@pytest.mark.parametrize(
    ("name", "prediction"),
    [
        ("median", lambda d: d / 7),
        ("scale", lambda d: d / 7),
        ("affine", lambda d: (d + 2) / 7),
        ("scale-disparity", lambda d: 7 * d),
        ("affine-disparity", lambda d: 1 / (3 / d + 0.5)),
        ("local", lambda d: (d + 2) / 7),
    ],
)
def test_each_alignment_restores_the_prediction_it_models(name, prediction) -> None:  # type: ignore[no-untyped-def]
    depth = ground_truth()
    dense = BASELINES[name].depth(random_points(depth, 80), prediction(depth))
    assert torch.allclose(dense, depth, rtol=1e-3)


@pytest.mark.parametrize("name", BASELINES)
def test_depth_at_positions_equals_the_dense_depth(name: str) -> None:
    points, prediction = random_points(ground_truth(), 80), ground_truth() / 3
    prediction[:4, :4] = 0
    rows, columns = torch.meshgrid(torch.arange(0, 30, 3), torch.arange(0, 40, 3), indexing="ij")
    positions = torch.stack([columns.flatten(), rows.flatten()], dim=1).float()
    dense = BASELINES[name].depth(points, prediction)
    there = BASELINES[name].at(positions, points, prediction)
    assert torch.equal(there, dense[rows.flatten(), columns.flatten()])
