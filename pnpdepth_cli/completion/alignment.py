"""Alignment: what a network's numbers mean in metres, fitted to the sparse points.

With x a network's output at a point of depth d, it is read as

    depth:               d     = scale·x + shift
    disparity:           1/d   = scale·x + shift
    log:                 log d = scale·x + shift
    inverted-disparity:  1/d   = scale/x + shift
    power:               log d = scale·log x + shift

A network of √d is read as a power. The kind of a fit is the parameters that it has. `affine` has
both, `scale` keeps the shift at 0, and `none` has neither. Of log, where a factor of depth is an
addend, `scale` keeps the scale at 1. `median` is `scale` by the median of the points' own factors.

All errors are of log depth: far points do not count more than near ones, and a fit of disparity
does not let far depth fly away. Outliers count little (`robust_line`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from pnpdepth_cli.choices import FITS, READINGS
from pnpdepth_cli.completion.robust_line import MAX_ERROR, fit_line, fit_location, mean_error
from pnpdepth_cli.core.losses import MAD_TO_STD
from pnpdepth_cli.errors import ModelError, NoPointsError
from pnpdepth_cli.points import SparsePoints

BEYOND = 5.0
"""Aligned depth is clamped to this factor in front of the nearest and behind the farthest point.

With N points it is 1 + 1/N times of it, since a few do not show the range of the scene.
"""

_BEST = 0.7
"""Fraction of the points that `Alignment.error` is measured on."""

_LEAST_ERROR = 1e-3
"""Errors of log depth below this do not distinguish fits."""

_UNTESTED = 0.2
"""Error of log depth that is assumed of a fit with as many parameters as points."""

_GROSS = 0.05
"""Errors of log depth below this are no outliers."""

_GROSS_STDS = 3.0
"""Errors below so many standard deviations are none either."""

_ALIKE = 1.0
"""Standard errors of the difference between two fits' criteria within which they are alike."""

_DISTINCT = 1e-9
"""Range of x over its largest size below which x is the same at all points."""

_LARGEST_LOG = 60.0
"""Largest |log x| of a bound, so that x and 1/x are float32 numbers."""


class Candidate(NamedTuple):
    """A fit that is tried: a reading, its parameters, and the sign that its scale must have."""

    reading: str  # of `choices.READINGS`
    kind: str  # of `choices.FITS`
    sign: int = 0  # 1 or -1; 0 for either


class _Reading(NamedTuple):
    """What a network's numbers can be, and the line that gives depth from them."""

    title: str  # in a sentence
    output: str  # of `choices.SPACES`: the scale is that of x, of 1/x or of log x
    space: str  # of `choices.SPACES`: the quantity of depth that the line gives


_READINGS = {
    "depth": _Reading("depth", "depth", "depth"),
    "disparity": _Reading("disparity", "depth", "inverse"),
    "log": _Reading("log depth", "depth", "log"),
    "inverted-disparity": _Reading("the inverse of a disparity", "inverse", "inverse"),
    "power": _Reading("a power of depth", "log", "log"),
}
READING_OF_KIND = {"depth": "depth", "inverse": "disparity", "log": "log"}
"""The reading of a definition's `output_kind`."""

_OF_SCALE = {"affine": ("affine",), "scale": ("scale", "affine")}
"""Kinds of fits by a definition's `output_scale`; those of the others are `_ALL`."""

_ALL = ("none", "scale", "affine")


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """How the network's numbers are converted to metres."""

    reading: str  # what the numbers are, one of `choices.READINGS`
    kind: str  # kind of the fit, one of `choices.FITS`
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
        low, high = self._limits
        line = self._line(_clamp_value(x, low=self._least_output))
        return from_space(_clamp_value(line, low, high), _READINGS[self.reading].space)

    def beyond(self, x: Tensor) -> float:
        """Returns the fraction of the values that `depth` clamps."""
        x = x.cpu().double()
        low, high = self._limits
        least = self._least_output
        line = self._line(x.clamp(min=least))
        return float(((x < least) | (line < low) | (line > high)).double().mean())

    def _line(self, x: Tensor) -> Tensor:
        """The line at x, in the reading's space and not clamped."""
        return self.scale * to_space(x, _READINGS[self.reading].output) + self.shift

    @property
    def _limits(self) -> tuple[float, float]:
        """The bounds of the line in its space, the lower one first."""
        bounds = torch.tensor(self.bounds, dtype=torch.float64)
        low, high = sorted(to_space(bounds, _READINGS[self.reading].space).tolist())
        return low, high

    @property
    def _least_output(self) -> float:
        """The least x whose depth is within the bounds; below it 1/x or log x must not go.

        −∞ for a line in x itself, which has no such end.
        """
        output = _READINGS[self.reading].output
        if output == "depth":
            return -math.inf
        # Where the line meets its bounds, as log x or as 1/x.
        ends = [(limit - self.shift) / self.scale for limit in self._limits]
        if output == "log":
            return math.exp(min(max(min(ends), -_LARGEST_LOG), _LARGEST_LOG))
        return 1 / max(ends) if max(ends) > 0 else math.inf

    @property
    def title(self) -> str:
        """What the numbers are, in a sentence."""
        title = _READINGS[self.reading].title
        if self.reading == "power" and self.scale < 0:
            return "a power of disparity"
        return f"negated {title}" if self.scale < 0 else title

    def __str__(self) -> str:
        if self.scale == 0:
            return "the network's output is read as one depth everywhere"
        farther = (self.scale < 0) == (self.reading == "disparity")
        if self.reading == "power":
            fitted = f"fitted by factor and exponent {self.scale:.3g}"
        elif self.kind == "none":
            fitted = "not fitted"
        elif self.kind == "affine":
            fitted = "fitted by scale and shift"
        else:
            fitted = f"fitted by {self.kind}"
        sense = "farther" if farther else "nearer"
        return f"the network's output is read as {self.title} (larger is {sense}), {fitted}"


def candidates(
    asked: str, output_kind: str = "unknown", output_scale: str = "unknown"
) -> tuple[Candidate, ...]:
    """Returns the fits that an alignment can have.

    What is stated fixes the sign of the scale and the fewest parameters. An open kind can be any
    reading, with either sign.

    Args:
        asked: One of `choices.ALIGNMENTS`, but "none". A reading is obeyed, whatever the definition
            states; "auto" leaves all to the definition and the points.
        output_kind: What a definition states, of `choices.OutputKind`.
        output_scale: What a definition states, of `choices.OutputScale`.
    """
    stated = READING_OF_KIND.get(output_kind)
    # A reading that contradicts the definition leaves its scale open, too.
    if asked in READINGS and asked != stated:
        output_scale = "unknown"
    reading = asked if asked in READINGS else stated
    kinds = (asked,) if asked in FITS else _OF_SCALE.get(output_scale, _ALL)
    if reading is None:
        return tuple(
            Candidate(name, kind) for name in READINGS for kind in kinds if _has(name, kind)
        )
    sign = 0 if reading == "power" else 1
    fits = [Candidate(reading, kind, sign) for kind in kinds if _has(reading, kind)]
    # Networks stretch or compress the range, which a power of what they state shows.
    if asked == "auto" and reading != "log":
        fits.append(Candidate("power", "affine", -1 if reading == "disparity" else 1))
    return tuple(fits)


def align(x: Tensor, points: SparsePoints, tried: Sequence[Candidate]) -> Alignment:
    """Returns the alignment of the network's numbers with the points.

    Of several candidates it is the best by BIC, so that a fit with more parameters must be worth
    them. Where the points contradict the sign that is stated, the scale can be 0: depth is the same
    everywhere.

    Args:
        x: (N,) the network's numbers at the points.
        points: The points.
        tried: The candidates, that of what is stated first.

    Raises:
        NoPointsError: There are too few points.
        ModelError: The numbers do not vary, or are not finite.
    """
    return alignments(x, points, tried)[0]


def alignments(x: Tensor, points: SparsePoints, tried: Sequence[Candidate]) -> list[Alignment]:
    """Returns the alignment with the points, and then those that explain them as well.

    The latter are the best ones of other readings, the better first. They are worse by no more than
    the standard error of the difference, which the points have by chance.

    Args:
        x: (N,) the network's numbers at the points.
        points: The points.
        tried: The candidates, that of what is stated first.

    Raises:
        NoPointsError: There are too few points.
        ModelError: The numbers do not vary, or are not finite.
    """
    x = x.detach().cpu().double()
    d = points.depth.detach().cpu().double()
    finite = x.isfinite()
    if not bool(finite.any()):
        raise ModelError(
            f"the network's prediction is not finite at any of {len(x):,} sparse points; are its"
            " weights, its input range (`normalise`) and precision right?"
        )
    x, d = x[finite], d[finite]
    fits = [fit for candidate in tried if (fit := _fit(x, d, candidate)) is not None]
    if fits:
        # The best of each reading; the first of the best.
        ordered = sorted(fits, key=_bic)
        readings = {fit.reading: fit for fit in reversed(ordered)}
        best, *others = (fit for fit in ordered if readings[fit.reading] is fit)
        return [best, *(fit for fit in others if _is_alike(fit, best, x, d))]
    stated = tried[0]
    if len(x) < 2:
        raise NoPointsError(
            f"alignment {stated.kind!r} needs 2 sparse points where the network sees them, here is"
            f" {len(x)}; 'scale' needs only one"
        )
    raise ModelError(
        f"alignment {stated.kind!r} as {stated.reading} is not possible: the network's output is"
        f" the same at all {len(x)} sparse points, or not above 0; are its weights and its input"
        " range (`normalise`) right, and does it give what the alignment says?"
    )


def align_prediction(
    prediction: Tensor, points: SparsePoints, *, kind: str, reading: str = "depth"
) -> Tensor:
    """Returns the prediction aligned with the points, (H, W) float32 metres, 0 = unknown.

    Args:
        prediction: (H, W) depth, metric or not; not positive or not finite is unknown.
        kind: Kind of the fit, one of `choices.FITS`.
        reading: What the line is fitted to, "depth", or "disparity" for the inverse of both.

    Raises:
        NoPointsError: No point has a prediction.
        ModelError: The prediction is the same at all points, or zero, so that no line fits.
    """
    known, points = where_predicted(prediction, points)
    x = torch.where(known, prediction, 1.0)
    x = x.reciprocal() if reading == "disparity" else x
    fit = align(points.sample(x), points, [Candidate(reading, kind)])
    return torch.where(known, fit.depth(x), 0.0)


def where_predicted(prediction: Tensor, points: SparsePoints) -> tuple[Tensor, SparsePoints]:
    """Returns where a prediction (H, W) is known, and the points that lie there.

    Raises:
        NoPointsError: There is no such point.
    """
    known = prediction.isfinite() & (prediction > 0)
    seen = points.where(points.sample(torch.where(known, prediction, torch.nan)).isfinite())
    if not len(seen):
        raise NoPointsError(
            f"none of the {len(points)} sparse points lies where the network has a prediction;"
            " are points and image of the same frame, and in pixels of the same image?"
        )
    return known, seen


def _has(reading: str, kind: str) -> bool:
    """Whether a reading has fits of this kind: those of one factor are depth's or disparity's."""
    return kind == "affine" or reading in ("depth", "disparity", "log")


def _fit(x: Tensor, d: Tensor, candidate: Candidate) -> Alignment | None:
    """The fit of a candidate; None where the x do not allow it.

    Where they contradict the sign that is stated, the best line is level.
    """
    line = _scale_and_shift(x, d, candidate.reading, candidate.kind)
    if line is None or not all(map(math.isfinite, line)):
        return None
    scale, _ = line
    if candidate.sign and scale * candidate.sign <= 0:
        has_level = candidate.kind == "affine" and len(x) > 1
        return _level(x, d, candidate) if has_level else None
    return _with_errors(x, d, candidate, line) if scale else None


def _level(x: Tensor, d: Tensor, candidate: Candidate) -> Alignment:
    """The best line whose scale is 0: depth is the same everywhere."""
    reading = candidate.reading if _READINGS[candidate.reading].output == "depth" else "depth"
    depth = d.new_tensor(fit_location(d.log())).exp()
    level = float(to_space(depth, _READINGS[reading].space))
    return _with_errors(x, d, candidate._replace(reading=reading), (0.0, level))


def _with_errors(
    x: Tensor, d: Tensor, candidate: Candidate, line: tuple[float, float]
) -> Alignment:
    """The fit with this line, and how far the points are from it."""
    scale, shift = line
    nearest, farthest = _bounds(d).tolist()
    fit = Alignment(
        reading=candidate.reading,
        kind=candidate.kind,
        scale=scale,
        shift=shift,
        bounds=(nearest, farthest),
        points=len(x),
    )
    errors = (fit.depth(x).log() - d.log()).abs()
    best = errors.sort().values[: max(1, round(_BEST * len(errors)))]
    gross = max(_GROSS_STDS * MAD_TO_STD * float(errors.median()), _GROSS)
    return replace(
        fit,
        error=float(best.mean()),
        misfit=mean_error(errors),
        outliers=float((errors > gross).double().mean()),
    )


def _scale_and_shift(x: Tensor, d: Tensor, reading: str, kind: str) -> tuple[float, float] | None:
    """The line of a reading, level where the x are all the same; None where there is no line."""
    if kind == "none":
        return 1.0, 0.0
    if kind != "affine":
        return _factor(x, d, reading, kind)
    output = _READINGS[reading].output
    space = _READINGS[reading].space
    if output != "depth" and not bool((x > 0).all()):
        return None
    x = to_space(x, output)
    if float(x.max() - x.min()) <= _DISTINCT * float(x.abs().max()):
        return 0.0, 0.0
    low, high = sorted(to_space(_bounds(d), space).tolist())
    return fit_line(x, to_space(d, space), space, (low, high))


def _factor(x: Tensor, d: Tensor, reading: str, kind: str) -> tuple[float, float] | None:
    """Scale and shift of a reading whose one parameter is a factor of depth."""
    if reading == "log":  # a factor of depth is an addend of its logarithm
        return 1.0, _location(d.log() - x, kind)
    # Numbers of the rarer sign, or 0, give no depth at any factor.
    sign = 1.0 if float(x.median()) >= 0 else -1.0
    used = sign * x > 0
    if not bool(used.any()):
        return None
    # d = scale·x, or 1/d = scale·x: log d is log x, or −log x, and what the scale adds to it.
    log_x = (sign * x[used]).log()
    log_d = d[used].log()
    if reading == "depth":
        return sign * math.exp(_location(log_d - log_x, kind)), 0.0
    return sign * math.exp(-_location(log_d + log_x, kind)), 0.0


def _location(addends: Tensor, kind: str) -> float:
    """The addend of all points, from the one that each would need."""
    return float(addends.median()) if kind == "median" else fit_location(addends)


def _bic(fit: Alignment) -> float:
    """The Bayesian information criterion of a fit, for Laplace's distribution of the errors."""
    parameters = {"none": 0, "affine": 2}.get(fit.kind, 1)
    error = max(fit.misfit, _LEAST_ERROR) if fit.points > parameters else _UNTESTED
    return 2 * fit.points * math.log(error) + parameters * math.log(fit.points)


def _is_alike(fit: Alignment, best: Alignment, x: Tensor, d: Tensor) -> bool:
    """Whether a fit explains the points as well as the best one, within what they have by chance.

    The criterion has the logarithm of the mean error. The standard error of the difference of two
    follows from the differences that single points make.
    """
    shares = [
        (of.depth(x).log() - d.log()).abs().clamp_max(MAX_ERROR) / max(of.misfit, _LEAST_ERROR)
        for of in (fit, best)
    ]
    by_chance = 2 * math.sqrt(len(x)) * float((shares[0] - shares[1]).std(correction=0))
    return _bic(fit) - _bic(best) <= _ALIKE * by_chance


def _bounds(d: Tensor) -> Tensor:
    """(nearest, farthest) metres that aligned depth can have."""
    factor = BEYOND * (1 + 1 / len(d))
    return torch.stack([d.min() / factor, d.max() * factor])


def _clamp_value(value: Tensor, low: float, high: float = math.inf) -> Tensor:
    """The value clamped, but with the gradient of the value as it is."""
    clamped = value.clamp(low, high)
    return clamped.detach() + (value - value.detach()) if value.requires_grad else clamped


def to_space(depth: Tensor, space: str) -> Tensor:
    """Returns depth as one of `choices.SPACES`."""
    match space:
        case "depth":
            return depth
        case "inverse":
            return depth.reciprocal()
        case "log":
            return depth.log()
        case _:
            raise KeyError(space)


def from_space(value: Tensor, space: str) -> Tensor:
    """Returns the depth of a value in one of `choices.SPACES`."""
    match space:
        case "depth":
            return value
        case "inverse":
            return value.reciprocal()
        case "log":
            return value.exp()
        case _:
            raise KeyError(space)
