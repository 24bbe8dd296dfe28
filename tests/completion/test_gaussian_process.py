from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.completion import gaussian_process as gp
from pnpdepth_cli.completion.gaussian_process import fit, leave_one_out, predict, predict_at
from pnpdepth_cli.completion.residual_field import ResidualField, features_of
from pnpdepth_cli.points import SparsePoints

SIZE = (20, 30)


def field(
    count: int, *, size: tuple[int, int] = SIZE, colour: bool = True, seed: int = 0
) -> ResidualField:
    """A smooth residual at random pixels of an image with a step in its prediction."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    chosen = torch.randperm(height * width, generator=generator)[:count]
    xy = torch.stack([chosen % width, chosen // width], dim=1).float()
    rgb = torch.rand(3, height, width, generator=generator) if colour else None
    log = torch.rand(size, generator=generator) * 0.1
    log[:, width // 2 :] += 1.0
    points = SparsePoints(xy=xy, depth=torch.ones(count), size=size)
    features = features_of(log, rgb)
    residual = torch.sin(xy[:, 0] / width * 3).double() * 0.3 + 0.2
    at = torch.stack([points.sample(one) for one in features], dim=1)
    return ResidualField(features=features, points=points, at=at, residual=residual)


def dense_reference(field: ResidualField) -> np.ndarray:
    """The mean by the textbook, with one inverse of everything."""
    lengths = np.array([1, 1, field.kernel.depth, *[field.kernel.colour] * 3])
    lengths = lengths[: field.at.shape[1]]
    a = field.at.double().numpy()
    b = torch.stack(field.features, dim=-1).double().numpy().reshape(-1, a.shape[1])

    def covariance(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        apart = np.linalg.norm((p[:, None] - q[None]) / lengths, axis=2)
        return np.exp(-apart) + gp.CONSTANT + gp.SLOPE * p[:, None, 2] * q[None, :, 2]

    inverse = np.linalg.inv(covariance(a, a) + field.kernel.noise * np.eye(len(a)))
    mean: np.ndarray = covariance(b, a) @ inverse @ field.residual.numpy()
    return mean.reshape(field.points.size)


@pytest.mark.parametrize("count", [1, 2, 7, 60])
@pytest.mark.parametrize("colour", [True, False])
def test_the_mean_is_that_of_the_textbook(count: int, colour: bool) -> None:
    residuals = field(count, colour=colour)
    assert np.allclose(predict(residuals).numpy(), dense_reference(residuals), atol=2e-4)


@pytest.mark.parametrize(
    ("count", "size", "atol"), [(3, SIZE, 1e-5), (40, SIZE, 1e-5), (900, (60, 80), 0.02)]
)
def test_prediction_at_positions_equals_the_dense_one_and_is_near_it_with_many_points(
    count: int, size: tuple[int, int], atol: float
) -> None:
    residuals = fit(field(count, size=size))
    positions = torch.tensor([[3.0, 4.0], [size[1] - 1.0, size[0] - 1.0], [0.0, 0.0], [7.0, 8.0]])
    queries = SparsePoints(xy=positions, depth=torch.ones(4), size=size)
    at = predict_at(residuals, positions, residuals.features_at(queries))
    assert torch.allclose(at, queries.sample(predict(residuals)), atol=atol)


def left_out_by_hand(residuals: ResidualField, index: int) -> float:
    others = torch.arange(len(residuals.points)) != index
    mean = predict(residuals.select(others))
    return float(residuals.residual[index] - residuals.points.sample(mean)[index])


def test_errors_of_left_out_points_are_those_of_leaving_them_out() -> None:
    residuals = field(12)
    error, _ = leave_one_out(residuals, torch.arange(12)[None])
    by_hand = [left_out_by_hand(residuals, index) for index in range(12)]
    assert torch.allclose(error[0], torch.tensor(by_hand).double(), atol=1e-4)


def test_a_point_of_zero_weight_does_not_change_the_others() -> None:
    residuals = field(12)
    weight = torch.ones(12).double()
    weight[5] = 0
    spoiled = replace(residuals, residual=residuals.residual.index_fill(0, torch.tensor([5]), 9.0))
    near = torch.arange(12)[None]
    clean, _ = leave_one_out(residuals, near, weight)
    with_outlier, _ = leave_one_out(spoiled, near, weight)
    others = torch.arange(12) != 5
    assert torch.allclose(with_outlier[0, others], clean[0, others], atol=1e-4)
