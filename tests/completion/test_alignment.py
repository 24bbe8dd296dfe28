from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from pnpdepth_cli.choices import READINGS
from pnpdepth_cli.completion.alignment import Alignment, Candidate, align, alignments, candidates
from pnpdepth_cli.errors import ModelError, NoPointsError
from pnpdepth_cli.points import SparsePoints

OUTPUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "depth": lambda d: (d - 0.3) / 2.5,
    "disparity": lambda d: (1 / d + 0.2) / 0.4,
    "log": lambda d: (d.log() + 0.5) / 0.7,
    "inverted-disparity": lambda d: 0.4 / (1 / d + 0.2),
    "power": lambda d: 3 * d**0.6,
}
"""What a network gives for depth d, by the reading that restores d."""


def points_of(depth: Tensor) -> SparsePoints:
    xy = torch.stack([torch.arange(len(depth)), torch.zeros(len(depth))], dim=1).float()
    return SparsePoints(xy=xy, depth=depth.float(), size=(1, len(depth)))


def scene(count: int, seed: int = 0) -> Tensor:
    return 1 + 9 * torch.rand(count, generator=torch.Generator().manual_seed(seed))


def normal(count: int, seed: int) -> Tensor:
    return torch.randn(count, generator=torch.Generator().manual_seed(seed))


def spoiled(depth: Tensor) -> Tensor:
    """The first fifth of the depths replaced by others far off, on both sides."""
    count = len(depth) // 5
    off = torch.tensor([0.2, 3.0, 6.0]).repeat(count)[:count]
    return torch.cat([depth[:count] * off, depth[count:]])


@pytest.mark.parametrize("kind", ["median", "scale", "affine"])
def test_many_points_with_a_fifth_of_outliers_are_off_by_less_than_2_percent(kind: str) -> None:
    d = scene(2000, 2)
    fit = align(d / 0.4, points_of(spoiled(d)), [Candidate("depth", kind)])
    assert torch.allclose(fit.depth(d / 0.4), d, rtol=0.02)


@pytest.mark.parametrize("reading", READINGS)
def test_every_reading_restores_depth_despite_a_fifth_of_outliers(reading: str) -> None:
    d = scene(61, 7)
    noisy = spoiled(d) * (0.03 * normal(61, 3)).exp()
    x = OUTPUTS[reading](d)
    fit = align(x, points_of(noisy), [Candidate(reading, "affine", 1)])
    assert torch.allclose(fit.depth(x), d, rtol=0.03)
    assert 12 / 61 <= fit.outliers < 0.3


@pytest.mark.parametrize("reading", READINGS)
def test_a_fit_is_the_minimum_of_cauchys_loss_of_log_depth(reading: str) -> None:
    d = scene(61, 7)
    noisy = spoiled(d) * (0.05 * normal(61, 3)).exp()
    x = OUTPUTS[reading](d)
    fit = align(x, points_of(noisy), [Candidate(reading, "affine")])

    def errors(line: np.ndarray) -> np.ndarray:
        of_line = Alignment(
            **{**vars(fit), "scale": float(line[0]), "shift": float(line[1])},
        )
        return np.asarray((of_line.depth(x.double()).log() - noisy.double().log()).numpy())

    # 2.385 and 1.4826 give 95 % efficiency, and the standard deviation, of normal errors.
    at_fit = errors(np.array([fit.scale, fit.shift]))
    width = 2.385 * 1.4826 * np.median(np.abs(at_fit))
    minimum = least_squares(
        errors, (fit.scale, fit.shift), loss="cauchy", f_scale=width, xtol=1e-12, x_scale="jac"
    )
    assert minimum.x == pytest.approx((fit.scale, fit.shift), rel=0.02, abs=0.01)
    error = np.abs(at_fit)
    assert fit.error == pytest.approx(np.sort(error)[:43].mean(), rel=1e-4)  # the best 70 %
    assert fit.misfit == pytest.approx(np.minimum(error, 1).mean(), rel=1e-4)
    assert fit.outliers == np.mean(error > max(3 * 1.4826 * np.median(error), 0.05))


def test_the_points_of_one_plane_do_not_make_outliers_of_the_others() -> None:
    plane = torch.full((7,), 2.0)
    beyond = torch.tensor([5.0, 6.0, 8.0])
    d = torch.cat([plane + 0.01 * torch.arange(7), beyond])
    x = (1 / d) * (1 + 0.04 * normal(10, 5)) + 0.3
    fit = align(x, points_of(d), candidates("auto", "inverse", "affine"))
    assert torch.allclose(fit.depth(x)[7:], beyond, rtol=0.35)


def test_far_depth_does_not_fly_away_where_near_points_are_many() -> None:
    d = torch.cat([1 + scene(90, 3) / 20, 8 + scene(10, 4) / 5])
    x = (1 / d) * (1 + 0.05 * normal(100, 5))
    fit = align(x, points_of(d), [Candidate("disparity", "affine", 1)])
    off = (fit.depth(x).log() - d.log()).abs()
    slope, shift = np.polyfit(x, 1 / d, 1)
    plain = (torch.clamp(slope * x + shift, min=1e-3).log() + d.log()).abs()
    assert off.mean() < plain.mean()


@pytest.mark.parametrize(
    ("output", "wanted"),
    [
        (lambda d: d, ("depth", "none")),
        (lambda d: 0.2 * d, ("depth", "scale")),
        (lambda d: 0.2 * d + 3, ("depth", "affine")),
        (lambda d: 5 - 0.2 * d, ("depth", "affine")),
        (lambda d: 1 / d, ("disparity", "none")),
        (lambda d: 9 / d, ("disparity", "scale")),
        (lambda d: -9 / d, ("disparity", "scale")),
        (lambda d: 37.5 / d + 4, ("disparity", "affine")),
        (lambda d: d.log(), ("log", "none")),
        (lambda d: 2 + d.log(), ("log", "scale")),
        (lambda d: 2 - 0.3 * d.log(), ("log", "affine")),
        (lambda d: 5 * d.sqrt(), ("power", "affine")),
        (lambda d: 3 / d.sqrt(), ("power", "affine")),
        (lambda d: d.square() / 7, ("power", "affine")),
        (lambda d: d.log10(), ("log", "affine")),
        (lambda d: 1 / (9 / d + 3), ("inverted-disparity", "affine")),
    ],
)
def test_auto_takes_the_simplest_reading_that_explains_the_points(
    output: Callable[[Tensor], Tensor], wanted: tuple[str, str]
) -> None:
    found = []
    for seed in range(4):
        d = scene(400, seed)
        noisy = output(d * (1 + 0.01 * normal(400, seed + 50)))
        fit = align(noisy, points_of(d), candidates("auto"))
        found.append((fit.reading, fit.kind))
        assert ("nearer" in str(fit)) == bool(output(d.min()) > output(d.max()))
    assert found == [wanted] * 4


def test_a_parameter_must_be_worth_its_price_in_bic() -> None:
    d = scene(40)
    kinds = set()
    for factor in torch.linspace(1, 1.04, 40).tolist():
        x = (d + 2 * (factor - 1)) * factor * (1 + 0.01 * normal(40, 8))
        tried = [Candidate("depth", kind) for kind in ("none", "scale", "affine")]
        fits = [align(x, points_of(d), [candidate]) for candidate in tried]
        of_error = 2 * 40 * np.log([fit.misfit for fit in fits])
        best = fits[int(np.argmin(of_error + np.arange(3) * math.log(40)))]
        assert align(x, points_of(d), tried) == best
        kinds.add(best.kind)
    assert len(kinds) > 1


@pytest.mark.parametrize("scale", ["affine", "unknown"])
@pytest.mark.parametrize("kind", ["depth", "inverse"])
def test_what_is_stated_is_never_turned_round(kind: str, scale: str) -> None:
    d = scene(30)
    x = 1 / d if kind == "depth" else d  # the other one
    fit = align(x, points_of(d), candidates("auto", kind, scale))
    depth = fit.depth(torch.linspace(1, 9, 9))
    order = depth.diff() if kind == "depth" else -depth.diff()
    assert bool((order >= -1e-6).all())
    if scale == "affine":  # then depth is the same everywhere
        assert fit.scale == 0
        assert torch.allclose(depth, d.median().expand(9), rtol=0.3)


@pytest.mark.parametrize(
    ("asked", "kind", "scale", "kinds"),
    [
        ("auto", "inverse", "affine", {("disparity", "affine"), ("power", "affine")}),
        ("auto", "log", "affine", {("log", "affine")}),
        ("affine", "inverse", "unknown", {("disparity", "affine")}),
        ("disparity", "inverse", "affine", {("disparity", "affine")}),
        ("power", "depth", "metric", {("power", "affine")}),
        ("median", "unknown", "unknown", {(r, "median") for r in ("depth", "disparity", "log")}),
    ],
)
def test_only_what_is_asked_or_stated_is_tried(
    asked: str, kind: str, scale: str, kinds: set[tuple[str, str]]
) -> None:
    tried = candidates(asked, kind, scale)
    assert {(candidate.reading, candidate.kind) for candidate in tried} == kinds


def test_a_definition_of_metres_or_of_a_factor_may_need_more_parameters() -> None:
    for scale, fewest in (("metric", "none"), ("scale", "scale"), ("affine", "affine")):
        kinds = [candidate.kind for candidate in candidates("auto", "depth", scale)]
        assert kinds[0] == fewest
        assert kinds[-1] == "affine"


@pytest.mark.parametrize("reading", READINGS)
def test_depth_stays_within_five_times_the_range_and_has_a_gradient(reading: str) -> None:
    d = scene(50)
    x = OUTPUTS[reading](d)
    fit = align(x, points_of(d), [Candidate(reading, "affine")])
    nearest = float(d.min()) / 5.1
    farthest = float(d.max()) * 5.1  # 5 times 1 + 1/50
    everywhere = torch.cat([torch.linspace(-100, 100, 2001), torch.tensor([0.0])])
    everywhere.requires_grad_()
    depth = fit.depth(everywhere)
    held = depth.detach()
    assert bool((held >= nearest * (1 - 1e-4)).all())
    assert bool((held <= farthest * (1 + 1e-4)).all())
    outside = (held <= nearest * (1 + 1e-4)) | (held >= farthest * (1 - 1e-4))
    assert fit.beyond(everywhere.detach()) == pytest.approx(
        float(outside.double().mean()), abs=2e-3
    )
    depth.sum().backward()
    assert bool(everywhere.grad.isfinite().all())
    assert bool((everywhere.grad != 0).all())


def test_a_value_held_at_a_bound_has_the_gradient_of_the_line() -> None:
    d = scene(50)
    fit = align(d, points_of(d), [Candidate("depth", "scale")])
    below = torch.tensor([-3.0], requires_grad=True)
    held = fit.depth(below)
    assert float(held.detach()) == pytest.approx(float(d.min()) / 5.1)
    held.sum().backward()
    assert float(below.grad) == pytest.approx(1.0, rel=1e-4)
    as_it_is = align(d, points_of(d), [Candidate("depth", "none")])
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
        align(x, points_of(scene(len(x))), [Candidate("depth", kind)])


def test_a_stated_network_that_gives_the_same_everywhere_is_one_depth_everywhere() -> None:
    d = scene(20)
    fit = align(torch.ones(20), points_of(d), candidates("auto", "inverse", "affine"))
    assert fit.scale == 0
    assert float(d.min()) < float(fit.depth(torch.zeros(1))) < float(d.max())


def test_readings_that_explain_few_points_as_well_follow_the_chosen_one() -> None:
    d = 2 + 0.6 * torch.rand(10, generator=torch.Generator().manual_seed(1))  # a small range
    x = OUTPUTS["inverted-disparity"](d) * (0.02 * normal(10, 2)).exp()
    best, *others = alignments(x, points_of(d), candidates("auto"))
    assert best == align(x, points_of(d), candidates("auto"))
    assert others
    readings = [fit.reading for fit in (best, *others)]
    assert len({*readings}) == len(readings)
    assert all(fit.misfit < 1.5 * best.misfit for fit in others)


@pytest.mark.parametrize("reading", READINGS)
def test_many_points_over_a_large_range_are_explained_by_one_reading_alone(reading: str) -> None:
    d = scene(200, 3)
    x = OUTPUTS[reading](d) * (0.003 * normal(200, 4)).exp()
    (only,) = alignments(x, points_of(d), candidates("auto"))
    assert only.reading == reading
