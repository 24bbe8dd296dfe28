from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import LinearNDInterpolator
from torch import Tensor

from pnpdepth_cli.choices import SPACES
from pnpdepth_cli.completion import interpolation
from pnpdepth_cli.completion.alignment import from_space
from pnpdepth_cli.completion.interpolation import (
    Triangulation,
    distinct,
    in_hull,
    linear,
    nearest,
    neighbours_of,
    pixels_of,
)
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import SparsePoints
from tests.completion.exact_triangles import POINTS, all_delaunay, holds

FILLS: dict[str, Callable[[SparsePoints], Tensor]] = {
    "nearest": nearest,
    "linear": linear,
    "linear log": partial(linear, space="log"),
}


def points_at(xy: object, depth: object, size: tuple[int, int]) -> SparsePoints:
    xy, depth = (torch.as_tensor(values, dtype=torch.float32) for values in (xy, depth))
    return SparsePoints(xy=xy, depth=depth, size=size)


def scattered(count: int, *, on_grid: bool = False) -> SparsePoints:
    """Points in a frame of 40 × 60 pixels."""
    generator = torch.Generator().manual_seed(0)
    xy = torch.rand(count, 2, generator=generator) * torch.tensor([59.0, 39.0])
    depth = 1 + 9 * torch.rand(count, generator=generator)
    return points_at(xy.round() if on_grid else xy, depth, (40, 60))


@pytest.mark.parametrize("name", FILLS)
@pytest.mark.parametrize("count", [1, 2, 3, 50])
@pytest.mark.parametrize("on_grid", [True, False])
def test_every_depth_is_among_those_of_the_points(name: str, count: int, on_grid: bool) -> None:
    points = scattered(count, on_grid=on_grid)
    dense = FILLS[name](points)
    assert (dense.shape, dense.dtype) == (points.size, torch.float32)
    assert float(points.depth.min()) * (1 - 1e-5) <= float(dense.min())
    assert float(dense.max()) <= float(points.depth.max()) * (1 + 1e-5)


@pytest.mark.parametrize("name", FILLS)
def test_of_points_at_one_position_the_nearest_counts_and_any_beyond_the_border(name: str) -> None:
    points = scattered(30, on_grid=True)
    xy = points.xy.repeat(2, 1)
    depth = torch.cat([points.depth + 5, points.depth])
    assert torch.equal(FILLS[name](points_at(xy, depth, points.size)), FILLS[name](points))
    dense = FILLS[name](points_at([(-2.0, 3.0), (12.5, 3.0)], [2.0, 8.0], (6, 10)))
    assert dense[3, 0] < 3
    assert dense[3, 9] > 7
    with pytest.raises(NoPointsError):
        FILLS[name](scattered(0))


@pytest.mark.parametrize("space", SPACES)
def test_linear_is_scipys_in_its_space_inside_the_hull_and_nearest_outside(space: str) -> None:
    points = scattered(300)
    value = {"depth": points.depth, "inverse": 1 / points.depth, "log": points.depth.log()}[space]
    within = LinearNDInterpolator(points.xy.double().numpy(), value.double().numpy())
    theirs = from_space(torch.from_numpy(within(pixels_of(points.size).numpy())), space)
    dense = linear(points, space=space)
    theirs = theirs.reshape(points.size)
    inside = ~theirs.isnan()
    assert 0.5 < float(inside.double().mean()) < 1
    assert torch.allclose(dense[inside].double(), theirs[inside], rtol=1e-5)
    assert torch.equal(dense[~inside], nearest(points)[~inside])


def depth_map(height: int, width: int, known: float, seed: int = 0) -> SparsePoints:
    """The known pixels of a depth map with two holes, and others missing at random."""
    rng = np.random.default_rng(seed)
    depth = (1 + 9 * rng.random((height, width))).astype(np.float32)
    depth[rng.random((height, width)) > known] = 0
    depth[2:9, 3:12] = depth[height // 2 :, width // 2 : width // 2 + 6] = 0
    rows, columns = depth.nonzero()
    return points_at(np.stack([columns, rows], axis=1), depth[rows, columns], (height, width))


@settings(max_examples=40)
@given(POINTS, st.randoms())
def test_depth_is_linear_in_a_triangle_that_delaunay_allows_and_nearest_outside(
    xy: list[tuple[float, float]], random: random.Random
) -> None:
    depth = [1 + 9 * random.random() for _ in xy]
    points = points_at(xy, depth, (6, 7))
    dense = linear(points).flatten()
    closest = nearest(points).flatten()
    at = np.array(xy)
    of_points = points.depth.double().numpy()
    triangles = all_delaunay(at)
    for pixel, found, alone in zip(pixels_of(points.size).numpy(), dense, closest, strict=True):
        possible = list[float]()
        for corners in map(list, triangles):
            if holds(at, tuple(corners), pixel):
                shares = np.linalg.solve(np.vstack([at[corners].T, np.ones(3)]), [*pixel, 1])
                possible.append(float(shares @ of_points[corners]))
        possible = possible or [float(alone)]
        assert min(possible) * (1 - 1e-6) <= float(found) <= max(possible) * (1 + 1e-6)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("known", [1.0, 0.8, 0.05])
def test_a_plane_is_a_plane_between_any_points_in_its_space(space: str, known: float) -> None:
    points = depth_map(40, 60, known)
    x, y = pixels_of(points.size).T
    plane = from_space(0.5 + 0.003 * x + 0.004 * y, space).reshape(points.size).float()
    points = points_at(points.xy, points.sample(plane), points.size)
    generator = torch.Generator().manual_seed(0)
    xy = torch.rand(200, 2, generator=generator) * torch.tensor([50.0, 30.0]) + 4
    expected = from_space(0.5 + xy.double() @ torch.tensor([0.003, 0.004]).double(), space)
    triangulation = Triangulation(points)
    inside = torch.zeros(points.size, dtype=torch.bool)
    inside[5:35, 5:55] = True
    assert torch.allclose(triangulation.dense(space)[inside], plane[inside], rtol=2e-6)
    assert torch.allclose(triangulation.at(xy, space), expected.float(), rtol=1e-5)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("known", [1.0, 0.8])
def test_of_a_depth_map_the_holes_are_as_if_all_its_pixels_were_triangulated(
    space: str, known: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = depth_map(40, 60, known)
    dense = linear(points, space=space)
    monkeypatch.setattr(interpolation, "_NODES", 0)
    assert torch.allclose(linear(points, space=space), dense, rtol=1e-6)
    assert torch.allclose(points.sample(dense), points.depth, rtol=1e-6)


def test_of_a_small_depth_map_in_a_large_frame_squares_are_bilinear() -> None:
    small = 1 + 9 * torch.rand(12, 16, generator=torch.Generator().manual_seed(0))
    x, y = pixels_of((12, 16)).T
    points = points_at(torch.stack([x, y], dim=1), small.flatten(), (12, 16)).resized(30, 48)
    expected = F.interpolate(small[None, None], (30, 48), mode="bilinear")[0, 0]
    inside = in_hull(points)
    inside[[0, -1]], inside[:, [0, -1]] = False, False
    assert torch.allclose(linear(points)[inside], expected[inside], rtol=1e-5)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("points", [scattered(300), scattered(2), depth_map(40, 60, 0.8)])
def test_at_a_pixel_depth_is_that_of_the_dense_map_however_few_are_asked_for(
    points: SparsePoints, space: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    triangulation = Triangulation(points)
    dense = triangulation.dense(space).flatten()
    pixels = pixels_of(points.size).float()
    assert torch.allclose(triangulation.at(pixels, space), dense, rtol=1e-6)
    monkeypatch.setattr(interpolation, "_FEW", 0)
    some = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(1))[:40]
    assert torch.allclose(triangulation.at(pixels[some], space), dense[some], rtol=1e-6)
    assert torch.allclose(linear(points, pixels[some], space=space), dense[some], rtol=1e-6)
    assert triangulation.at(pixels[:0], space).shape == (0,)


@pytest.mark.parametrize("points", [scattered(200, on_grid=True), depth_map(40, 60, 0.9)])
def test_the_order_of_the_points_has_no_effect(points: SparsePoints) -> None:
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    assert torch.equal(linear(points.select(order)), linear(points))


@pytest.mark.parametrize(
    ("xy", "inside"),
    [
        ([(2.0, 1.0)], []),
        ([(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)], []),  # on one line
        ([(0.0, 0.0), (2.0, 0.0), (0.0, 2.0)], [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2)]),
    ],
)
def test_the_hull_holds_the_pixels_between_three_points_and_none_of_fewer_or_of_a_line(
    xy: list[tuple[float, float]], inside: list[tuple[int, int]]
) -> None:
    expected = torch.tensor([[(x, y) in inside for x in range(4)] for y in range(3)])
    assert torch.equal(in_hull(points_at(xy, [1.0] * len(xy), (3, 4))), expected)


def random_points(count: int, seed: int = 0) -> SparsePoints:
    generator = torch.Generator().manual_seed(seed)
    xy = torch.rand(count, 2, generator=generator) * 59
    return points_at(xy, 1 + torch.rand(count, generator=generator), (60, 60))


def test_neighbours_of_points_are_the_nearest_others_however_many_were_asked_for_before() -> None:
    points = random_points(80)
    apart = torch.cdist(points.xy.double(), points.xy.double()).fill_diagonal_(torch.inf)
    for count in (3, 8, 5):
        assert torch.equal(neighbours_of(points, count), apart.argsort(dim=1)[:, :count])


def test_the_same_points_have_one_ordered_set_as_long_as_they_are_in_use() -> None:
    points = random_points(20)
    other = random_points(20)
    assert distinct(points) is distinct(points)
    assert distinct(other) is not distinct(points)


def test_depth_asked_for_at_other_coordinates_is_not_that_of_the_last_ones() -> None:
    triangulation = Triangulation(random_points(40))
    here = random_points(9, 1).xy
    there = random_points(9, 2).xy
    first = triangulation.at(here)
    assert torch.equal(triangulation.at(there), Triangulation(random_points(40)).at(there))
    assert torch.equal(triangulation.at(here), first)
    assert torch.equal(triangulation.at(here), first)
