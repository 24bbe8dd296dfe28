"""Alignment: what a network's numbers mean in metres, fitted to the sparse points.

A network gives depth, inverse depth or log depth, often only up to a scale, or a scale and a
shift. The fit is made in the network's own space: with x its output at a point of depth d,

    depth:    d     = scale·x + shift
    inverse:  1/d   = scale·x + shift
    log:      log d = scale·x + shift

`scale` keeps the shift at 0. In log space, where a factor of depth is an addend, it keeps the scale
at 1. `median` is the same by the median of the points' own ratios. The fit is robust to outliers.
Of lines through many pairs of points, the one with the smallest median residual is the start
(LMedS, Rousseeuw 1984) of reweighted least squares with Tukey's biweight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.core.losses import MAD_TO_STD
from pnpdepth_cli.errors import ModelError, NoPointsError
from pnpdepth_cli.points import SparsePoints

BEYOND = 10.0
"""Aligned depth is clamped to this factor in front of the nearest and behind the farthest point."""

_PAIRS = 1024
_SCORED = 1024
_BIWEIGHT = 4.685  # of Tukey's weights: 95 % efficient for normal errors (Holland, Welsch 1977)
_BEST = 0.7  # fraction of the points that `error` is measured on
_MAX_ERROR = 1.0  # |log| error above which a point counts no more
_MIN_ERROR = 1e-3  # relative errors below this do not distinguish alignments


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """How the network's numbers are converted to metres."""

    space: str  # quantity in which the line is fitted, one of `choices.SPACES`
    kind: str  # kind of the fit, one of `choices.ALIGNMENTS`
    scale: float
    shift: float
    bounds: tuple[float, float]
    """(nearest, farthest) metres; depth outside, or no positive depth at all, becomes the bound."""
    points: int
    error: float = math.nan  # mean |log(aligned / measured depth)| of the best 70 % of the points
    misfit: float = math.nan  # the same of all points, none counting more than 1.0
    outliers: float = 0.0  # fraction of the points that are far off

    def depth(self, x: Tensor) -> Tensor:
        """Returns metres within `bounds`, of the shape of x.

        The gradient is that of the unclamped depth, so that a loss still pulls back a pixel that
        is outside.
        """
        line, (low, high) = self.scale * x + self.shift, self._limits
        clamped = line.clamp(low, high)
        if x.requires_grad:
            clamped = clamped.detach() + (line - line.detach())
        return from_space(clamped, self.space)

    def beyond(self, x: Tensor) -> float:
        """Returns the fraction of the values that `depth` clamps."""
        line, (low, high) = self.scale * x.cpu() + self.shift, self._limits
        return float(((line < low) | (line > high)).double().mean())

    @property
    def _limits(self) -> list[float]:
        """The bounds of the line in its space, the lower one first."""
        bounds = torch.tensor(self.bounds, dtype=torch.float64)
        return sorted(to_space(bounds, self.space).tolist())

    def __str__(self) -> str:
        read_as = {"depth": "depth", "inverse": "inverse depth", "log": "log depth"}[self.space]
        sense = "nearer" if (self.scale < 0) != (self.space == "inverse") else "farther"
        fitted = {"none": "not fitted", "affine": "fitted by scale and shift"}.get(
            self.kind, f"fitted by {self.kind}"
        )
        read_as = f"negated {read_as}" if self.scale < 0 else read_as
        return f"the network's output is read as {read_as} (larger is {sense}), {fitted}"


def align(x: Tensor, points: SparsePoints, spaces: tuple[str, ...], kind: str) -> Alignment:
    """Returns the alignment of the network's numbers with the points.

    With several spaces, or with kind "auto", it is the best by BIC of a Laplace model of the
    relative errors, so that a fit with more parameters must be worth them.

    Args:
        x: (N,) the network's numbers at the points.
        spaces: Quantities that the network may predict, of `choices.SPACES`.

    Raises:
        NoPointsError: There are too few points.
        ModelError: The numbers do not vary, or are not finite.
    """
    x, d = x.detach().cpu().double(), points.depth.detach().cpu().double()
    good = x.isfinite()
    if not bool(good.any()):
        raise ModelError(
            f"the network's prediction is not finite at any of {len(x):,} sparse points; are its"
            " weights, its input range (`normalise`) and precision right?"
        )
    x, d = x[good], d[good]
    kinds = ("none", "scale", "affine") if kind == "auto" else (kind,)
    fits = [fit for s in spaces for k in kinds if (fit := _fit(x, d, s, k)) is not None]
    if not fits and len(x) < 2:
        fact = f"alignment {kind!r} needs 2 sparse points where the network sees them"
        raise NoPointsError(f"{fact}, here is {len(x)}; 'scale' needs only one")
    if not fits:
        raise ModelError(
            f"alignment {kind!r} is not possible: the network's output is the same at all"
            f" {len(x)} sparse points, or zero"
        )
    return min(fits, key=_bic)


def align_prediction(
    prediction: Tensor, points: SparsePoints, *, kind: str, space: str = "depth"
) -> Tensor:
    """Returns the prediction aligned with the points, (H, W) float32 metres, 0 = unknown.

    Args:
        prediction: (H, W) depth, metric or not; not positive or not finite is unknown.
        space: Quantity in which the line is fitted, one of `choices.SPACES`.

    Raises:
        NoPointsError: No point has a prediction.
        ModelError: The prediction is the same at all points, or zero, so that no line fits.
    """
    known, points = where_predicted(prediction, points)
    x = to_space(torch.where(known, prediction, 1.0), space)
    fit = align(points.sample(x), points, (space,), kind)
    return torch.where(known, fit.depth(x), 0.0)


def where_predicted(prediction: Tensor, points: SparsePoints) -> tuple[Tensor, SparsePoints]:
    """Returns where a prediction (H, W) is known, and the points that lie there.

    Raises:
        NoPointsError: There is no such point.
    """
    known = prediction.isfinite() & (prediction > 0)
    seen = points.select(points.sample(torch.where(known, prediction, torch.nan)).isfinite())
    if not len(seen):
        raise NoPointsError(
            f"none of the {len(points)} sparse points lies where the network has a prediction"
        )
    return known, seen


def _fit(x: Tensor, d: Tensor, space: str, kind: str) -> Alignment | None:
    y = to_space(d, space)
    line = _line(x, y, space, kind)
    if line is None or not all(map(math.isfinite, line)) or line[0] == 0:
        return None
    bounds = (float(d.min()) / BEYOND, float(d.max()) * BEYOND)
    fit = Alignment(
        space=space, kind=kind, scale=line[0], shift=line[1], bounds=bounds, points=len(x)
    )
    off = (fit.depth(x).log() - d.log()).abs()
    error = float(off.sort().values[: max(1, round(_BEST * len(off)))].mean())
    gross = max(3 * MAD_TO_STD * float(off.median()), 0.05)
    misfit = float(off.clamp_max(_MAX_ERROR).mean())
    return replace(fit, error=error, misfit=misfit, outliers=float((off > gross).double().mean()))


def _bic(fit: Alignment) -> float:
    parameters = {"none": 0, "affine": 2}.get(fit.kind, 1)
    error = max(fit.misfit, _MIN_ERROR)
    # A parameter can fit outliers: on rendered frames, with and without outliers, twice BIC's
    # price of a parameter chose best.
    return 2 * (fit.points * math.log(error) + parameters * math.log(max(2, fit.points)))


def _line(x: Tensor, y: Tensor, space: str, kind: str) -> tuple[float, float] | None:
    """Scale and shift of y = scale·x + shift; None where the x do not determine them."""
    if kind == "none":
        return 1.0, 0.0
    if kind == "affine":
        if float(x.max() - x.min()) <= 1e-9 * float(x.abs().max()):
            return None
        return _fit_reweighted(x, y, _least_median(x, y), shifted=True)
    if space == "log":  # where a factor of depth is an addend
        x, y = torch.ones_like(x), y - x
    used = x != 0
    if not bool(used.any()):
        return None
    factor = float((y[used] / x[used]).median())
    if kind == "scale":
        factor, _ = _fit_reweighted(x, y, (factor, 0.0), shifted=False)
    return (1.0, factor) if space == "log" else (factor, 0.0)


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


def _fit_reweighted(
    x: Tensor, y: Tensor, start: tuple[float, float], *, shifted: bool
) -> tuple[float, float]:
    """Least squares of y = a·x + b from a start; points far off the line have no weight."""
    a, b = start
    least = 1e-9 * float(y.abs().median()) + torch.finfo(y.dtype).tiny
    for _ in range(30):
        residual = (y - a * x - b).abs()
        cutoff = _BIWEIGHT * max(MAD_TO_STD * float(residual.median()), least)
        w = (1 - (residual / cutoff).square()).clamp_min(0).square()
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
    """Returns depth as one of `choices.SPACES`."""
    return {"depth": lambda: depth, "inverse": depth.reciprocal, "log": depth.log}[space]()


def from_space(value: Tensor, space: str) -> Tensor:
    """Returns the depth of a value in one of `choices.SPACES`."""
    return {"depth": lambda: value, "inverse": value.reciprocal, "log": value.exp}[space]()
