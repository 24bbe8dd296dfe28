from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from pnpdepth_cli.completion.propagation import EDGE_DEPTH, STIFFNESS, diffuse
from pnpdepth_cli.completion.residual_field import ResidualField, features_of
from pnpdepth_cli.points import SparsePoints

SIZE = (6, 8)


def field(xy: list[tuple[float, float]], residual: list[float], log_depth: Tensor) -> ResidualField:
    points = SparsePoints(
        xy=torch.tensor(xy),
        depth=torch.ones(len(xy)),
        size=(log_depth.shape[0], log_depth.shape[1]),
    )
    features = features_of(log_depth, None)
    at = torch.stack([points.sample(one) for one in features], dim=1)
    return ResidualField(
        features=features, points=points, at=at, residual=torch.tensor(residual).double()
    )


def step(size: tuple[int, int] = SIZE) -> Tensor:
    """Log depth (H, W), the right half farther."""
    log_depth = torch.zeros(size)
    log_depth[:, size[1] // 2 :] = 1.0
    return log_depth


@pytest.mark.parametrize(
    "xy",
    [
        [(1.0, 1.0), (6.0, 4.0), (2.0, 5.0)],
        [(1.25, 1.0), (6.0, 3.5), (2.75, 4.125), (2.5, 4.75)],  # between nodes
        [(-2.0, 0.5), (7.5, 5.5), (3.25, 9.0)],  # outside: moved to the outermost nodes
    ],
)
def test_it_is_the_least_squares_solution_of_its_equation(xy: list[tuple[float, float]]) -> None:
    residuals = field(xy, [0.3, -0.2, 0.1, -0.4][: len(xy)], step())
    u = residuals.features[2].double().numpy()
    number = np.arange(48).reshape(SIZE)
    lines, right = [], []
    for (x, y), r in zip(xy, residuals.residual.tolist(), strict=True):
        across = np.clip(1 - abs(np.clip(x, 0, 7) - np.arange(8)), 0, 1)
        down = np.clip(1 - abs(np.clip(y, 0, 5) - np.arange(6)), 0, 1)
        lines.append(np.outer(down, across).ravel())
        right.append(r)
    for a, b in [
        *zip(number[:, :-1].flat, number[:, 1:].flat, strict=True),
        *zip(number[:-1].flat, number[1:].flat, strict=True),
    ]:
        weight = STIFFNESS / (1 + ((u.flat[a] - u.flat[b]) / EDGE_DEPTH) ** 2)
        lines.append(np.sqrt(weight) * (np.eye(48)[a] - np.eye(48)[b]))
        right.append(0.0)
    expected = np.linalg.lstsq(np.array(lines), np.array(right), rcond=None)[0]
    assert np.allclose(diffuse(residuals).numpy(), expected.reshape(SIZE), atol=1e-3)
