"""Neighbours of points and the weights predicted from them."""

from __future__ import annotations

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from model_zoo_defs._compact import cloud as clouds
from model_zoo_defs._compact.cloud import NEIGHBOURS, Cloud, neighbours
from model_zoo_defs._compact.inliers import InlierWeights
from model_zoo_defs._compact.points import Points

SIZE = (64, 96)


def sparse_map(count: int, seed: int = 0) -> Tensor:
    """(1, 1, 64, 96) metres with `count` points."""
    generator = torch.Generator().manual_seed(seed)
    sparse = torch.zeros(SIZE[0] * SIZE[1])
    at = torch.randperm(len(sparse), generator=generator)[:count]
    sparse[at] = 1.0 + 4.0 * torch.rand(len(at), generator=generator)
    return sparse.view(1, 1, *SIZE)


def images(count: int, seed: int = 0) -> Tensor:
    """(count, 3, 64, 96) normalised."""
    return torch.randn(count, 3, *SIZE, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def shaken() -> InlierWeights:
    """A layer with random weights everywhere."""
    torch.manual_seed(1)
    layer = InlierWeights()
    for parameter in layer.parameters():
        nn.init.normal_(parameter, std=0.2)
    return layer


@given(seed=st.integers(0, 10_000), count=st.integers(1, 200))
@settings(max_examples=30, deadline=None)
def test_neighbours_are_the_nearest_points_of_the_cells_around(seed: int, count: int) -> None:
    position = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed)) * count**0.5
    near, found = neighbours(position)
    cells = position.long()
    most = int(torch.unique(cells, dim=0, return_counts=True)[1].amax())
    assume(most <= clouds.CELL_POINTS)
    reachable = (cells[:, None] - cells[None]).abs().amax(2) <= 2
    square = torch.cdist(position, position).square().masked_fill(~reachable, torch.inf)
    square.fill_diagonal_(torch.inf)
    expected = square.sort(1).values[:, :NEIGHBOURS]
    assert torch.equal(found.sum(1), (expected < torch.inf).sum(1))
    distance = (position[near] - position[:, None]).square().sum(2)
    for row, own, known in zip(expected, distance, found, strict=True):
        torch.testing.assert_close(own[known], row[row < torch.inf], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_points_without_neighbours_have_a_weight(shaken: InlierWeights, count: int) -> None:
    points = Points(sparse_map(count))
    weights = shaken(points, Cloud.of(points, images(1)))
    assert bool(((weights >= 0) & (weights <= 1)).all())
    assert torch.equal(weights != 1, points.mask > 0)
