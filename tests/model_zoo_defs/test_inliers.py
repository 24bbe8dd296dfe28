"""Neighbours of points and the weights predicted from them."""

from __future__ import annotations

import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from model_zoo_defs._compact import cloud as clouds
from model_zoo_defs._compact.cloud import NEIGHBOURS, neighbours


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
