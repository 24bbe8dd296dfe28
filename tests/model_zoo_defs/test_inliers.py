"""Neighbours of points and the weights predicted from them."""

from __future__ import annotations

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from model_zoo_defs._compact import cloud as clouds
from model_zoo_defs._compact import inliers
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


def test_images_of_a_batch_do_not_influence_each_other(shaken: InlierWeights) -> None:
    maps = [sparse_map(70, 1), sparse_map(300, 2)]
    together = Points(torch.cat(maps))
    rgb = images(2)
    cloud = Cloud.of(together, rgb)
    log_odds = shaken.log_odds(cloud).split([70, 300])
    weights = shaken(together, cloud)
    for number, sparse in enumerate(maps):
        alone, own = Points(sparse), rgb[number : number + 1]
        cloud = Cloud.of(alone, own)
        expected = shaken.log_odds(cloud)
        torch.testing.assert_close(log_odds[number], expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(weights[number], shaken(alone, cloud)[0], rtol=1e-3, atol=1e-4)


def test_the_size_of_the_chunks_changes_nothing(
    shaken: InlierWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = Points(sparse_map(300))
    whole = Cloud.of(points, images(1))
    expected = shaken.log_odds(whole)
    monkeypatch.setattr(clouds, "CHUNK", 7)
    monkeypatch.setattr(inliers, "CHUNK", 7)
    assert torch.equal(Cloud.of(points, images(1)).near, whole.near)
    torch.testing.assert_close(shaken.log_odds(whole), expected, rtol=1e-4, atol=1e-5)


def test_the_colour_of_a_point_is_the_mean_of_25_pixels() -> None:
    rgb = images(1)
    sparse = torch.zeros(1, 1, *SIZE)
    sparse[..., 10, 20] = sparse[..., 0, 95] = 2.0
    corner, inside = Cloud.of(Points(sparse), rgb).colour
    torch.testing.assert_close(inside, rgb[0, :, 8:13, 18:23].mean((1, 2)))
    # at the corner, its own pixel counts nine times
    rows, columns = [0, 0, 0, 1, 2], [93, 94, 95, 95, 95]
    torch.testing.assert_close(corner, rgb[0][:, rows][:, :, columns].mean((1, 2)))


def test_only_differences_of_colour_count(shaken: InlierWeights) -> None:
    points, rgb = Points(sparse_map(200)), images(1)
    log_odds = shaken.log_odds(Cloud.of(points, rgb)).detach()
    brighter = shaken.log_odds(Cloud.of(points, rgb + 1.0))
    torch.testing.assert_close(log_odds, brighter, rtol=1e-3, atol=1e-3)
    other = shaken.log_odds(Cloud.of(points, images(1, seed=1)))
    assert float((log_odds - other.detach()).abs().max()) > 0.01
