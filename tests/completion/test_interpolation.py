from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from scipy.interpolate import LinearNDInterpolator
from torch import Tensor

from pnpdepth_cli.choices import SPACES
from pnpdepth_cli.completion.alignment import from_space
from pnpdepth_cli.completion.interpolation import in_hull, linear, nearest, pixels_of
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import SparsePoints

FILLS: dict[str, Callable[[SparsePoints], Tensor]] = {
    "nearest": nearest,
    "linear": linear,
    "linear log": partial(linear, space="log"),
}


def points_at(xy: object, depth: object, size: tuple[int, int]) -> SparsePoints:
    xy, depth = (torch.as_tensor(each, dtype=torch.float32) for each in (xy, depth))
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
    xy, depth = points.xy.repeat(2, 1), torch.cat([points.depth + 5, points.depth])
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
    dense, theirs = linear(points, space=space), theirs.reshape(points.size)
    inside = ~theirs.isnan()
    assert 0.5 < float(inside.double().mean()) < 1
    assert torch.allclose(dense[inside].double(), theirs[inside], rtol=1e-5)
    assert torch.equal(dense[~inside], nearest(points)[~inside])


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
