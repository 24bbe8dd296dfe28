from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import LinearNDInterpolator
from torch import Tensor

from pnpdepth_cli.choices import SPACES
from pnpdepth_cli.completion.alignment import from_space
from pnpdepth_cli.completion.interpolation import in_hull, linear, nearest
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import SparsePoints

FILLS: dict[str, Callable[[SparsePoints], Tensor]] = {
    "nearest": nearest,
    "linear": linear,
    "linear log": partial(linear, space="log"),
}


def points_at(
    xy: list[tuple[float, float]], depth: list[float], size: tuple[int, int]
) -> SparsePoints:
    return SparsePoints(xy=torch.tensor(xy), depth=torch.tensor(depth), size=size)


def scattered(
    count: int, size: tuple[int, int] = (40, 60), seed: int = 0, *, on_grid: bool = False
) -> SparsePoints:
    generator = torch.Generator().manual_seed(seed)
    xy = torch.rand(count, 2, generator=generator) * torch.tensor([size[1] - 1.0, size[0] - 1.0])
    depth = 1 + 9 * torch.rand(count, generator=generator)
    return SparsePoints(xy=xy.round() if on_grid else xy, depth=depth, size=size)


def pixels(size: tuple[int, int]) -> Tensor:
    y, x = torch.meshgrid(*(torch.arange(float(n)) for n in size), indexing="ij")
    return torch.stack([x, y], dim=-1)


@pytest.mark.parametrize("name", FILLS)
@pytest.mark.parametrize("count", [1, 2, 3, 50])
@pytest.mark.parametrize("on_grid", [True, False])
def test_every_pixel_gets_a_depth_among_those_of_the_points(
    name: str, count: int, on_grid: bool
) -> None:
    points = scattered(count, on_grid=on_grid)
    dense = FILLS[name](points)
    assert dense.shape == points.size
    assert dense.dtype == torch.float32
    least, most = float(points.depth.min()), float(points.depth.max())
    assert least * (1 - 1e-5) <= float(dense.min())
    assert float(dense.max()) <= most * (1 + 1e-5)


@pytest.mark.parametrize("name", FILLS)
def test_of_points_at_one_position_the_nearest_counts(name: str) -> None:
    points = scattered(30, on_grid=True)
    behind = SparsePoints(xy=points.xy, depth=points.depth + 5, size=points.size)
    both = SparsePoints(
        xy=torch.cat([behind.xy, points.xy]),
        depth=torch.cat([behind.depth, points.depth]),
        size=points.size,
    )
    assert torch.equal(FILLS[name](both), FILLS[name](points))


@pytest.mark.parametrize("name", FILLS)
def test_without_points_there_is_no_answer(name: str) -> None:
    with pytest.raises(NoPointsError):
        FILLS[name](scattered(0))


@pytest.mark.parametrize("name", FILLS)
def test_points_beyond_the_border_count(name: str) -> None:
    dense = FILLS[name](points_at([(-2.0, 3.0), (12.5, 3.0)], [2.0, 8.0], (6, 10)))
    assert dense[3, 0] < 3
    assert dense[3, 9] > 7


def test_linear_is_what_scipy_gives_inside_the_hull_and_nearest_outside() -> None:
    points = scattered(300)
    dense = linear(points)
    theirs = torch.from_numpy(
        LinearNDInterpolator(points.xy.double().numpy(), points.depth.double().numpy())(
            pixels(points.size).double().numpy()
        )
    )
    inside = ~theirs.isnan()
    assert 0.5 < float(inside.double().mean()) < 1
    assert torch.allclose(dense[inside].double(), theirs[inside], rtol=1e-5)
    assert torch.equal(dense[~inside], nearest(points)[~inside])


@pytest.mark.parametrize("space", SPACES)
@given(
    slopes=st.tuples(st.floats(-0.004, 0.004), st.floats(-0.004, 0.004)), seed=st.integers(0, 2**16)
)
@settings(max_examples=10)
def test_what_is_linear_in_a_space_is_restored_in_it_between_the_corners(
    space: str, slopes: tuple[float, float], seed: int
) -> None:
    size = (30, 40)
    corners = torch.tensor([[0.0, 0.0], [39, 0], [0, 29], [39, 29]])
    xy = torch.cat([corners, scattered(20, size, seed).xy])
    plane = 0.5 + (pixels(size).double() * torch.tensor(slopes).double()).sum(-1)
    at_points = 0.5 + (xy.double() * torch.tensor(slopes).double()).sum(-1)
    points = SparsePoints(xy=xy, depth=from_space(at_points, space).float(), size=size)
    assert torch.allclose(linear(points, space=space), from_space(plane, space).float(), rtol=1e-5)


@pytest.mark.parametrize(
    ("xy", "inside"),
    [
        ([(2.0, 1.0)], []),
        ([(0.0, 0.0), (3.0, 2.0)], []),
        ([(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)], []),  # on one line
        ([(0.0, 0.0), (2.0, 0.0), (0.0, 2.0)], [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2)]),
    ],
)
def test_the_hull_holds_the_pixels_between_three_points_and_none_of_fewer_or_of_a_line(
    xy: list[tuple[float, float]], inside: list[tuple[int, int]]
) -> None:
    points = points_at(xy, [1.0] * len(xy), (3, 4))
    expected = torch.tensor([[(x, y) in inside for x in range(4)] for y in range(3)])
    assert torch.equal(in_hull(points), expected)
