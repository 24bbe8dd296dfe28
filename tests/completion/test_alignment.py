from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pnpdepth_cli.choices import SPACES
from pnpdepth_cli.completion.alignment import align
from pnpdepth_cli.errors import ModelError, NoPointsError
from pnpdepth_cli.points import SparsePoints


def points_of(depth: Tensor) -> SparsePoints:
    xy = torch.stack([torch.arange(len(depth)), torch.zeros(len(depth))], dim=1).float()
    return SparsePoints(xy=xy, depth=depth.float(), size=(1, len(depth)))


def scene(count: int, seed: int = 0) -> Tensor:
    return 1 + 9 * torch.rand(count, generator=torch.Generator().manual_seed(seed))


def spoiled(depth: Tensor) -> Tensor:
    """The first fifth of the depths replaced by others far off, on both sides."""
    count = len(depth) // 5
    off = torch.tensor([0.2, 3.0, 6.0]).repeat(count)[:count]
    return torch.cat([depth[:count] * off, depth[count:]])


def output_for(depth: Tensor, space: str, scale: float, shift: float) -> Tensor:
    y = {"depth": depth, "inverse": 1 / depth, "log": depth.log()}[space]
    return (y - shift) / scale


@pytest.mark.parametrize("space", SPACES)
def test_an_affine_output_is_read_exactly_in_every_space(space: str) -> None:
    d = scene(50)
    x = output_for(d, space, 0.3, 0.05)
    alignment = align(x, points_of(d), (space,), "affine")
    assert (alignment.scale, alignment.shift) == pytest.approx((0.3, 0.05), rel=1e-4)
    assert alignment.outliers == 0
    assert torch.allclose(alignment.depth(x), d, rtol=1e-4)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("kind", ["median", "scale", "affine"])
@pytest.mark.parametrize(("count", "seed"), [(30, 0), (30, 1), (2000, 2)])
def test_20_percent_gross_outliers_move_the_fit_by_less_than_2_percent(
    space: str, kind: str, count: int, seed: int
) -> None:
    d = scene(count, seed)
    noise = torch.randn(count, generator=torch.Generator().manual_seed(seed + 100))
    x = output_for(d * (1 + 0.01 * noise), space, 1.0 if space == "log" else 0.4, 0.0)
    clean = align(x, points_of(d), (space,), kind).depth(x)
    moved = align(x, points_of(spoiled(d)), (space,), kind).depth(x)
    assert float((moved / clean - 1).abs().max()) < 0.02


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("seed", range(3))
def test_auto_aligns_a_disparity_network_from_30_points_with_20_percent_outliers(
    sign: int, seed: int
) -> None:
    d = scene(4000, seed)
    x = sign * (37.5 / d + 4.0)
    alignment = align(x[:30], points_of(spoiled(d[:30])), ("depth", "inverse"), "auto")
    assert (alignment.space, alignment.kind) == ("inverse", "affine")
    assert alignment.falling == (sign > 0)
    assert float((alignment.depth(x) / d - 1).abs().max()) < 0.005
    assert alignment.outliers == pytest.approx(0.2, abs=0.04)


@pytest.mark.parametrize(
    ("output", "wanted"),
    [
        (lambda d: d, ("depth", "none")),
        (lambda d: 0.2 * d, ("depth", "scale")),
        (lambda d: 0.2 * d + 3, ("depth", "affine")),
        (lambda d: 5 - 0.2 * d, ("depth", "affine")),
        (lambda d: 1 / d, ("inverse", "none")),
        (lambda d: 9 / d, ("inverse", "scale")),
        (lambda d: -9 / d, ("inverse", "scale")),
    ],
)
def test_auto_takes_the_simplest_reading_that_explains_the_points(
    output: Callable[[Tensor], Tensor], wanted: tuple[str, str]
) -> None:
    for seed in range(4):
        d = scene(100, seed)
        noise = torch.randn(100, generator=torch.Generator().manual_seed(seed + 50))
        noisy = output(d * (1 + 0.02 * noise))
        alignment = align(noisy, points_of(d), ("depth", "inverse"), "auto")
        assert (alignment.space, alignment.kind) == wanted


def test_depth_at_or_behind_infinity_reads_as_ten_times_the_farthest_point() -> None:
    d = scene(50)
    x = 1 / d
    alignment = align(x, points_of(d), ("inverse",), "affine")
    sky = torch.tensor([-5.0, 0.0])
    assert torch.allclose(alignment.depth(sky), torch.full((2,), 10 * float(d.max())), rtol=1e-5)
    assert alignment.beyond(torch.cat([sky, x[:8]])) == pytest.approx(0.2)


def test_a_value_held_at_a_bound_still_has_a_gradient() -> None:
    d = scene(50)
    alignment = align(d, points_of(d), ("depth",), "scale")
    below = torch.tensor([-3.0], requires_grad=True)
    held = alignment.depth(below)
    assert float(held.detach()) == pytest.approx(float(d.min()) / 10)
    held.sum().backward()
    assert below.grad is not None
    assert float(below.grad) == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize(
    ("x", "kind", "error"),
    [
        (torch.ones(20), "affine", ModelError),
        (torch.ones(1), "affine", NoPointsError),
        (torch.full((20,), math.nan), "scale", ModelError),
        (torch.zeros(20), "scale", ModelError),
    ],
)
def test_what_cannot_be_aligned_is_refused(x: Tensor, kind: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        align(x, points_of(scene(len(x))), ("depth",), kind)
