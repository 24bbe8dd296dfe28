"""What a network's numbers mean in metres, fitted to the sparse points.

A network gives depth, inverse depth or log depth, often only up to a scale, or a scale and a
shift. The fit is made in the network's own space: with x its output at a point of depth d,

    depth:    d     = scale·x + shift
    inverse:  1/d   = scale·x + shift
    log:      log d = scale·x + shift

`scale` leaves the shift at 0 (in log space, where a factor of depth is an addend, it leaves the
scale at 1), `median` is the same by the median of the points' own ratios. Wrong points do not pull:
a line through two points is drawn for many pairs, the one with the smallest median residual wins
(LMedS, Rousseeuw 1984), and reweighted least squares with Tukey's biweight goes on from there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.errors import ModelError, NoPointsError
from pnpdepth_cli.points import SparsePoints

BEYOND = 10.0
"""Aligned depth is bounded to this factor in front of the nearest and behind the farthest point."""

_PAIRS = 1024
_SCORED = 1024
_BIWEIGHT = 4.685  # of Tukey's weights: 95 % efficient for normal errors (Holland, Welsch 1977)
_NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation, normal errors
_TRUSTED = 0.7  # share of the points that `error` is measured on: the best ones
_WRONG = 1.0  # |log| error beyond which a point counts as wrong, not as more wrong
_NO_BETTER = 1e-3  # relative errors below this do not tell one alignment from another


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """How the network's numbers read as metres.

    space, kind, scale, shift: as above. bounds: (nearest, farthest) in metres; what comes out
    beyond them, or at no positive depth at all, reads as the bound. points: how many were
    fitted. error: mean |log(aligned / true depth)| of the best 70 % of them. misfit: the same of
    all, none counting more than 1.0. outliers: share of points that are far off.
    """

    space: str
    kind: str
    scale: float
    shift: float
    bounds: tuple[float, float]
    points: int
    error: float = math.nan
    misfit: float = math.nan
    outliers: float = 0.0

    def depth(self, x: Tensor) -> Tensor:
        """Metres, all within `bounds`. The gradient is that of the unbounded reading at the bound:

        a point where the aligned depth went beyond it still pulls it back.
        """
        line = self.scale * x + self.shift
        near, far = self.bounds
        if self.space == "inverse":
            return _held(line, 1 / far, 1 / near).reciprocal()
        if self.space == "log":
            return _held(line, math.log(near), math.log(far)).exp()
        return _held(line, near, far)

    def beyond(self, x: Tensor) -> float:
        """Share of the values that `depth` holds at a bound."""
        line = self.scale * x + self.shift
        near, far = (float(to_space(torch.tensor(b), self.space)) for b in self.bounds)
        return float(((line < min(near, far)) | (line > max(near, far))).double().mean())

    @property
    def falling(self) -> bool:
        """True if a larger number of the network means a nearer point."""
        return (self.scale < 0) != (self.space == "inverse")

    def __str__(self) -> str:
        reads = {"depth": "depth", "inverse": "1/depth", "log": "log depth"}[self.space]
        sign, shift = ("−" if self.shift < 0 else "+"), abs(self.shift)
        line = f"{self.scale:.4g}·output" + (f" {sign} {shift:.4g}" if shift else "")
        sense = "nearer" if self.falling else "farther"
        return f"{self.kind}: {reads} = {line}, larger is {sense}"


def align(x: Tensor, points: SparsePoints, spaces: tuple[str, ...], kind: str) -> Alignment:
    """The alignment of the network's numbers at the points, x (N,), with their depths.

    spaces: what the network may give; with several, or with kind "auto", the best by BIC of a
    Laplace model of the relative errors: a more elaborate one must earn its parameters.
    NoPointsError with too few points, ModelError if the numbers do not vary (or are not finite).
    """
    x, d = x.detach().double().cpu(), points.depth.detach().double().cpu()
    good = x.isfinite()
    if not bool(good.any()):
        raise ModelError("the network's output is not finite at any sparse point; nothing to align")
    x, d = x[good], d[good]
    tried = ("none", "scale", "affine") if kind == "auto" else (kind,)
    found = [made for s in spaces for k in tried if (made := _fitted(x, d, s, k)) is not None]
    if not found and len(x) < 2:
        raise NoPointsError(
            f"alignment {kind!r} needs at least 2 sparse points where the network sees them,"
            f" here is {len(x)}; --align scale needs only one"
        )
    if not found:
        raise ModelError(
            f"alignment {kind!r} is not possible: the network's output is the same at all"
            f" {len(x)} sparse points, or zero"
        )
    return min(found, key=lambda a: _bic(a))


def aligned(prediction: Tensor, points: SparsePoints, *, kind: str, space: str = "depth") -> Tensor:
    """Depth (H, W) float32 of a prediction (H, W), aligned with the points in one of SPACES.

    prediction: depth, metric or not; what is not positive and finite is unknown, and is 0 in the
    result. Errors as of `align`; NoPointsError if no point lies where there is a prediction.
    """
    known, points = where_predicted(prediction, points)
    x = to_space(torch.where(known, prediction, 1.0), space)
    made = align(points.sample(x), points, (space,), kind)
    return torch.where(known, made.depth(x), 0.0)


def where_predicted(prediction: Tensor, points: SparsePoints) -> tuple[Tensor, SparsePoints]:
    """(where a prediction (H, W) is depth, the points that lie there). NoPointsError if none."""
    known = prediction.isfinite() & (prediction > 0)
    seen = points.select(points.sample(torch.where(known, prediction, torch.nan)).isfinite())
    if not len(seen):
        raise NoPointsError(
            f"none of the {len(points)} sparse points lies where the network has a prediction"
        )
    return known, seen


def _fitted(x: Tensor, d: Tensor, space: str, kind: str) -> Alignment | None:
    y = to_space(d, space)
    line = (1.0, 0.0) if kind == "none" else _LINES[kind](x, y, space)
    if line is None or not all(map(math.isfinite, line)) or line[0] == 0:
        return None
    bounds = (float(d.min()) / BEYOND, float(d.max()) * BEYOND)
    made = Alignment(
        space=space, kind=kind, scale=line[0], shift=line[1], bounds=bounds, points=len(x)
    )
    off = (made.depth(x).log() - d.log()).abs()
    error = float(off.sort().values[: max(1, round(_TRUSTED * len(off)))].mean())
    gross = max(3 * _NORMAL_MAD * float(off.median()), 0.05)
    misfit = float(off.clamp_max(_WRONG).mean())
    return replace(made, error=error, misfit=misfit, outliers=float((off > gross).double().mean()))


def _bic(made: Alignment) -> float:
    parameters = {"none": 0, "affine": 2}.get(made.kind, 1)
    error = max(made.misfit, _NO_BETTER)
    # Wrong points leave room for a parameter to fit them: on rendered frames, with and without
    # outliers, twice the usual price of one chose best.
    return 2 * (made.points * math.log(error) + parameters * math.log(max(2, made.points)))


def _median(x: Tensor, y: Tensor, space: str) -> tuple[float, float] | None:
    if space == "log":
        return 1.0, float((y - x).median())
    used = x != 0
    return (float((y[used] / x[used]).median()), 0.0) if bool(used.any()) else None


def _scale(x: Tensor, y: Tensor, space: str) -> tuple[float, float] | None:
    start = _median(x, y, space)
    if start is None:
        return None
    if space == "log":
        one = torch.ones_like(x)
        return 1.0, _reweighted(one, y - x, (start[1], 0.0), shifted=False)[0]
    return _reweighted(x, y, start, shifted=False)


def _affine(x: Tensor, y: Tensor, space: str) -> tuple[float, float] | None:
    if len(x) < 2 or float(x.max() - x.min()) <= 1e-9 * float(x.abs().max()):
        return None
    return _reweighted(x, y, _least_median(x, y), shifted=True)


_LINES = {"median": _median, "scale": _scale, "affine": _affine}


def _least_median(x: Tensor, y: Tensor) -> tuple[float, float]:
    """The line through two of the points with the smallest median residual; the seed is fixed."""
    generator = torch.Generator().manual_seed(0)
    if len(x) > _SCORED:
        kept = torch.randperm(len(x), generator=generator)[:_SCORED]
        x, y = x[kept], y[kept]
    first, second = torch.triu_indices(len(x), len(x), 1)
    if len(first) > _PAIRS:
        drawn = torch.randperm(len(first), generator=generator)[:_PAIRS]
        first, second = first[drawn], second[drawn]
    apart = x[first] != x[second]
    if not bool(apart.any()):  # hardly any value differs and no pair drawn has two
        first, second, apart = x.argmin()[None], x.argmax()[None], torch.ones(1, dtype=torch.bool)
    first, second = first[apart], second[apart]
    slope = (y[first] - y[second]) / (x[first] - x[second])
    shift = y[first] - slope * x[first]
    residual = (slope[:, None] * x + shift[:, None] - y).abs().median(dim=1).values
    best = residual.argmin()
    return float(slope[best]), float(shift[best])


def _reweighted(
    x: Tensor, y: Tensor, start: tuple[float, float], *, shifted: bool
) -> tuple[float, float]:
    """Least squares of y = a·x + b from a start, points far off the line weighing nothing."""
    a, b = start
    least = 1e-9 * float(y.abs().median()) + torch.finfo(y.dtype).tiny
    for _ in range(30):
        residual = (y - a * x - b).abs()
        spread = _BIWEIGHT * max(_NORMAL_MAD * float(residual.median()), least)
        w = (1 - (residual / spread).square()).clamp_min(0).square()
        total = w.sum()
        mx, my = ((w * x).sum() / total, (w * y).sum() / total) if shifted else (0.0, 0.0)
        power = (w * (x - mx).square()).sum()
        if not float(total) > 0 or not float(power) > 0:
            break
        slope = float((w * (x - mx) * (y - my)).sum() / power)
        before, a, b = a, slope, float(my - slope * mx)
        if abs(a - before) <= 1e-12 * abs(a):
            break
    return a, b


def to_space(depth: Tensor, space: str) -> Tensor:
    """Depth as one of SPACES has it."""
    return {"depth": lambda: depth, "inverse": depth.reciprocal, "log": depth.log}[space]()


def from_space(value: Tensor, space: str) -> Tensor:
    """The depth of a value of one of SPACES."""
    return {"depth": lambda: value, "inverse": value.reciprocal, "log": value.exp}[space]()


def _held(x: Tensor, low: float, high: float) -> Tensor:
    """x within low … high; the gradient passes through as if it were not held."""
    held = x.clamp(low, high)
    return held if not x.requires_grad else held.detach() + (x - x.detach())
