from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.sparse.linalg import splu
from torch import Tensor

from pnpdepth_cli.completion import diffusion
from pnpdepth_cli.completion.diffusion import EDGE_DEPTH, STIFFNESS, diffuse
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


def test_an_edge_of_the_prediction_stops_it() -> None:
    dense = diffuse(field([(0.0, 3.0), (7.0, 3.0)], [0.5, -0.5], step()))
    assert float((dense[:, :4] - 0.5).abs().max()) < 0.05
    assert float((dense[:, 4:] + 0.5).abs().max()) < 0.05


@pytest.mark.parametrize("nodes", [12, 10**6])
def test_one_point_is_everywhere_also_on_a_coarser_grid(
    nodes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diffusion, "_MIN_NODES", nodes)
    monkeypatch.setattr(diffusion, "_MAX_NODES", nodes)
    dense = diffuse(field([(3.4, 2.6)], [0.25], step()))
    assert torch.allclose(dense, torch.full(SIZE, 0.25), atol=1e-5)


@pytest.mark.parametrize(("count", "nodes"), [(3, 2000), (400, 4000), (5000, 30_000)])
def test_the_grid_is_finer_where_points_are_many(
    count: int, nodes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved = []

    def noted(system: Any, **how: Any) -> Any:
        solved.append(system.shape[0])
        return splu(system, **how)

    monkeypatch.setattr("scipy.sparse.linalg.splu", noted)
    positions = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * 199
    diffuse(field([(x, y) for x, y in positions.tolist()], [0.1] * count, step((200, 300))))
    assert solved[0] == pytest.approx(nodes, rel=0.02)


def test_the_nodes_are_read_bilinearly_between_them() -> None:
    residuals = field([(1.25, 2.5), (6.75, 0.125), (3.0, 4.0)], [0.0] * 3, step())
    y, x = np.mgrid[:6, :8].astype(float)
    readings = diffusion._readings(residuals, *SIZE)
    for node_values, expected in [
        (np.ones(SIZE), [1.0, 1.0, 1.0]),
        (x, [1.25, 6.75, 3.0]),
        (y, [2.5, 0.125, 4.0]),
        (x * y, [1.25 * 2.5, 6.75 * 0.125, 12.0]),
    ]:
        assert (readings @ node_values.ravel()).tolist() == expected
