from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
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


@pytest.mark.parametrize("kind", ["median", "scale", "affine"])
def test_many_points_with_a_fifth_of_outliers_are_off_by_less_than_2_percent(kind: str) -> None:
    d = scene(2000, 2)
    fit = align(d / 0.4, points_of(spoiled(d)), ("depth",), kind)
    assert torch.allclose(fit.depth(d / 0.4), d, rtol=0.02)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("kind", ["median", "scale", "affine"])
def test_a_fit_is_its_own_biweight_least_squares_and_has_its_errors(space: str, kind: str) -> None:
    rng = np.random.default_rng(7)
    true = scene(61).double().numpy()
    points = points_of(spoiled(scene(61)) * torch.from_numpy(np.exp(0.05 * rng.normal(size=61))))
    d = points.depth.double().numpy()
    to_space = {"depth": lambda v: v, "inverse": np.reciprocal, "log": np.log}[space]
    x = to_space(true) * (1 if space == "log" else 2.5) + (0.3 if kind == "affine" else 0.0)
    fit = align(torch.from_numpy(x), points, (space,), kind)
    # A fifth of gross outliers moves the depth by no more than 2 %.
    assert np.allclose(fit.depth(torch.from_numpy(x)), true, rtol=0.02)
    y = to_space(d)
    # 4.685 and 1.4826 give 95 % efficiency, and the standard deviation, of normal errors.
    off = np.abs(y - fit.scale * x - fit.shift)
    root = np.clip(1 - (off / (4.685 * 1.4826 * np.median(off))) ** 2, 0, None)
    if kind == "affine":
        expected = np.polyfit(x, y, 1, w=root)
    elif space == "log":
        shift = np.median(y - x) if kind == "median" else np.average(y - x, weights=root**2)
        expected = (1.0, shift)
    else:
        ratio = np.median(y / x) if kind == "median" else root**2 * x @ y / (root**2 * x @ x)
        expected = (ratio, 0.0)
    assert (fit.scale, fit.shift) == pytest.approx(tuple(expected), rel=1e-5, abs=1e-6)
    # The reading, clamped to ten times beyond the points, and its errors.
    bounds = d.min() / 10, d.max() * 10
    x = np.concatenate([x, x.mean() + 40 * np.ptp(x) * rng.normal(size=30)])
    line = fit.scale * x + fit.shift
    low, high = sorted(to_space(np.array(bounds)))
    from_space = {"depth": lambda v: v, "inverse": np.reciprocal, "log": np.exp}[space]
    depth = from_space(np.clip(line, low, high))
    assert np.allclose(fit.depth(torch.from_numpy(x)), depth, rtol=1e-5)
    assert fit.beyond(torch.from_numpy(x)) == np.mean((line < low) | (line > high)) > 0.1
    error = np.abs(np.log(depth[:61] / d))
    assert fit.error == pytest.approx(np.sort(error)[:43].mean(), rel=1e-4)  # the best 70 %
    assert fit.misfit == pytest.approx(np.minimum(error, 1).mean(), rel=1e-4)
    assert fit.outliers == np.mean(error > max(3 * 1.4826 * np.median(error), 0.05))


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
        (lambda d: 37.5 / d + 4, ("inverse", "affine")),
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
        assert ("nearer" in str(alignment)) == bool(output(d.min()) > output(d.max()))


def test_auto_pays_twice_the_price_of_a_parameter_in_bic() -> None:
    d = scene(40)
    noise = torch.randn(40, generator=torch.Generator().manual_seed(8))
    kinds = set()
    for factor in torch.linspace(1, 1.04, 40).tolist():
        x = (d + 2 * (factor - 1)) * factor * (1 + 0.01 * noise)
        fits = [align(x, points_of(d), ("depth",), kind) for kind in ("none", "scale", "affine")]
        fit_terms = 2 * 40 * np.log([fit.misfit for fit in fits])
        best = fits[int(np.argmin(fit_terms + 2 * np.arange(3) * math.log(40)))]
        assert align(x, points_of(d), ("depth",), "auto") == best
        kinds.add(best.kind)
    assert len(kinds) > 1


def test_a_value_held_at_a_bound_still_has_a_gradient() -> None:
    d = scene(50)
    alignment = align(d, points_of(d), ("depth",), "scale")
    below = torch.tensor([-3.0], requires_grad=True)
    held = alignment.depth(below)
    assert float(held.detach()) == pytest.approx(float(d.min()) / 10)
    held.sum().backward()
    assert float(below.grad) == pytest.approx(1.0, rel=1e-4)
    as_it_is = align(d, points_of(d), ("depth",), "none")
    assert as_it_is.beyond(torch.tensor(as_it_is.bounds, dtype=torch.float64)) == 0


@pytest.mark.parametrize(
    ("x", "kind", "error"),
    [
        (torch.ones(20), "affine", ModelError),
        (torch.ones(1), "affine", NoPointsError),
        (torch.ones(2), "affine", ModelError),
        (torch.full((20,), math.nan), "scale", ModelError),
        (torch.zeros(20), "scale", ModelError),
    ],
)
def test_what_cannot_be_aligned_is_refused(x: Tensor, kind: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        align(x, points_of(scene(len(x))), ("depth",), kind)
