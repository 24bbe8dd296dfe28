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
"""Error of log depth that an outlier exceeds."""

_GROSS_STDS = 3.0
"""Standard deviations of all errors that the error of an outlier exceeds, too."""

_ALIKE = 1.0
"""Standard errors of the difference between two fits' criteria within which they are alike."""

_DISTINCT = 1e-9
"""Range of x over its largest size below which x is the same at all points."""

_LARGEST_LOG = 60.0
"""Largest |log x| of a bound, so that x and 1/x are float32 numbers."""


class Candidate(NamedTuple):
    """A fit that is tried: what the numbers are taken for, and which parameters are fitted."""

    reading: str
    """What the network's numbers are taken for, one of `choices.READINGS`."""
    kind: str
    """The parameters that are fitted, one of `choices.FITS`."""
    sign: int = 0
    """The sign that the scale must have, 1 or −1; 0 for either."""


class _Reading(NamedTuple):
    """What a network's numbers x can be: a quantity of depth is linear in a quantity of x."""

    title: str
    """Its name in a sentence."""
    x_space: str
    """The quantity of x: "depth" for x itself, "inverse" for 1/x, "log" for log x."""
    depth_space: str
    """The quantity of depth that is linear in it, one of `choices.SPACES`."""


_READINGS = {
    "depth": _Reading("depth", "depth", "depth"),
    "disparity": _Reading("disparity", "depth", "inverse"),
    "log": _Reading("log depth", "depth", "log"),
    "inverted-disparity": _Reading("the inverse of a disparity", "inverse", "inverse"),
    "power": _Reading("a power of depth", "log", "log"),
}
READING_OF_KIND = {"depth": "depth", "inverse": "disparity", "log": "log"}
"""The reading of a definition's `output_kind`."""

_KINDS_OF_SCALE = {"affine": ("affine",), "scale": ("scale", "affine")}
"""Kinds of fits by a definition's `output_scale`; those of the others are `_ALL_KINDS`."""

_ALL_KINDS = ("none", "scale", "affine")


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """How the network's numbers are converted to metres."""

    reading: str
    """What the numbers are, one of `choices.READINGS`."""
    kind: str
    """The parameters that were fitted, one of `choices.FITS`."""
    scale: float
    """Slope of the line that takes a quantity of the numbers to one of depth (see this module)."""
    shift: float
    """The line's value where that quantity of the numbers is 0."""
    bounds: tuple[float, float]
    """(nearest, farthest) metres; depth outside, or no positive depth at all, becomes the bound."""
    points: int
    """Number of points that it was fitted to."""
    error: float = math.nan
    """Mean |log(aligned / measured depth)| of the best 70 % of the points."""
    misfit: float = math.nan
    """The same of all points, none counting more than 1.0."""
    outliers: float = 0.0
    """Fraction of the points that are far off."""

    def depth(self, x: Tensor) -> Tensor:
        """Returns depth of the shape of x, metres within `bounds`.

        The gradient is that of the unclamped depth, so that a loss still pulls back a pixel that
        is outside.

        Args:
            x: The network's numbers.
        """
        low, high = self._limits
        # x, too, is clamped: a line in 1/x or log x needs it above 0.
        line = self._line(_clamp_value(x, low=self._least_x))
        return from_space(_clamp_value(line, low, high), _READINGS[self.reading].depth_space)

    def beyond(self, x: Tensor) -> float:
        """Returns the fraction 0…1 of the network's numbers x that `depth` clamps to a bound."""
        x = x.cpu().double()
        low, high = self._limits
        line = self._line(x.clamp(min=self._least_x))
        is_clamped = (x < self._least_x) | (line < low) | (line > high)
        return float(is_clamped.double().mean())

    def _line(self, x: Tensor) -> Tensor:
        """The quantity of depth that is linear in x (or 1/x, log x) at x, not clamped."""
        return self.scale * to_space(x, _READINGS[self.reading].x_space) + self.shift

    @property
    def _limits(self) -> tuple[float, float]:
        """The bounds as values of the line, the lower one first: 1/farthest of a disparity."""
        bounds = torch.tensor(self.bounds, dtype=torch.float64)
        low, high = sorted(to_space(bounds, _READINGS[self.reading].depth_space).tolist())
        return low, high

    @property
    def _least_x(self) -> float:
        """The least x whose depth is within the bounds, where 1/x or log x needs x above 0.

        −∞ where the line is one in x itself, which may be any number; ∞ where no positive x has a
        depth within the bounds.
        """
        x_space = _READINGS[self.reading].x_space
        if x_space == "depth":
            return -math.inf
        # Where the line meets its limits, as log x or as 1/x. The least x is that of the lesser
        # log x, or of the greater 1/x.
        ends = [(limit - self.shift) / self.scale for limit in self._limits]
        if x_space == "log":
            least_log = max(min(ends), -_LARGEST_LOG)
            return math.exp(min(least_log, _LARGEST_LOG))
        return 1 / max(ends) if max(ends) > 0 else math.inf

    @property
    def title(self) -> str:
        """What the numbers are, in a sentence."""
        title = _READINGS[self.reading].title
        if self.reading == "power" and self.scale < 0:
            return "a power of disparity"
        return f"negated {title}" if self.scale < 0 else title

    def __str__(self) -> str:
        """What the numbers are and how they were fitted, as a sentence."""
        if self.scale == 0:
            return "the network's output is read as one depth everywhere"
        # Depth rises with the numbers, except with a disparity; a negative scale turns that round.
        falls = self.reading == "disparity"
        if self.scale < 0:
            falls = not falls
        if self.reading == "power":
            fitted = f"fitted by factor and exponent {self.scale:.3g}"
        elif self.kind == "none":
            fitted = "not fitted"
        elif self.kind == "affine":
            fitted = "fitted by scale and shift"
        else:
            fitted = f"fitted by {self.kind}"
        sense = "nearer" if falls else "farther"
        return f"the network's output is read as {self.title} (larger is {sense}), {fitted}"


def candidates(
    align_setting: str, output_kind: str = "unknown", output_scale: str = "unknown"
) -> tuple[Candidate, ...]:
    """Returns the fits to try, which are what the user and the network's definition leave open.

    What they state fixes what the numbers are (the reading), the sign of the scale and the fewest
    parameters. If neither says what the numbers are, they can be anything, with either sign.

    Args:
        align_setting: What the user states: a reading, which is obeyed whatever the definition
            states, or a kind of fit, which fixes the parameters. "auto" leaves all to the
            definition and the points. One of `choices.ALIGNMENTS`, but "none".
        output_kind: What the definition states, of `choices.OutputKind`.
        output_scale: What the definition states, of `choices.OutputScale`.
    """
    defined_reading = READING_OF_KIND.get(output_kind)
    # A reading that contradicts the definition leaves its scale open, too.
    if align_setting in READINGS and align_setting != defined_reading:
        output_scale = "unknown"
    reading = align_setting if align_setting in READINGS else defined_reading
    kinds = _KINDS_OF_SCALE.get(output_scale, _ALL_KINDS)
    if align_setting in FITS:
        kinds = (align_setting,)
    # Neither says what the numbers are.
    if reading is None:
        fits = [Candidate(any_reading, kind) for any_reading in READINGS for kind in kinds]
        return tuple(fit for fit in fits if _has_kind(fit.reading, fit.kind))
    # What is stated; the scale of a power is its exponent, which is negative for a disparity.
    sign = 0 if reading == "power" else 1
    fits = [Candidate(reading, kind, sign) for kind in kinds if _has_kind(reading, kind)]
    # A network may stretch or compress the range of depth; then it gives a power of what is stated.
    # Log depth has none, as it may be below 0.
    if align_setting == "auto" and reading != "log":
        fits.append(Candidate("power", "affine", -1 if reading == "disparity" else 1))
    return tuple(fits)


def align(x: Tensor, points: SparsePoints, tried: Sequence[Candidate]) -> Alignment:
    """Returns how the network's numbers are converted to metres, fitted to the points.

    Of several candidates it is the best by BIC, so that a fit with more parameters must be worth
    them. Where the points contradict the sign that is stated, the scale can be 0: depth is the same
    everywhere.

    Args:
        x: (N,) the network's numbers at the points.
        points: The N points.
        tried: The candidates, of `candidates`; errors name the first.

    Raises:
        NoPointsError: There are too few points.
        ModelError: The numbers do not vary, or are not finite.
    """
    return alignments(x, points, tried)[0]


def alignments(x: Tensor, points: SparsePoints, tried: Sequence[Candidate]) -> list[Alignment]:
    """Returns the best alignment of the network's numbers, and then those that are as good.

    The latter take the numbers for something else (have another reading). Each is the best one that
    does, the better first. They are worse by no more than the standard error of the difference,
    which the points have by chance.

    Args:
        x: (N,) the network's numbers at the points.
        points: The N points.
        tried: The candidates, of `candidates`; errors name the first.

    Raises:
        NoPointsError: There are too few points.
        ModelError: The numbers do not vary, or are not finite.
    """
    # The points where the network gives a number.
    x = x.detach().cpu().double()
    depth = points.depth.detach().cpu().double()
    finite = x.isfinite()
    if not bool(finite.any()):
        raise ModelError(
            f"the network's prediction is not finite at any of {len(x):,} sparse points; are its"
            " weights, its input range (`normalise`) and precision right?"
        )
    x = x[finite]
    depth = depth[finite]
    # The best fit of each reading, the best one first; of equal ones the first that was tried.
    possible = [_fit(x, depth, candidate) for candidate in tried]
    fits = [fit for fit in possible if fit is not None]
    best_of_reading: dict[str, Alignment] = {}
    for fit in sorted(fits, key=_bic):
        best_of_reading.setdefault(fit.reading, fit)
    if best_of_reading:
        best, *others = best_of_reading.values()
        return [best, *(fit for fit in others if _is_alike(fit, best, x, depth))]
    # No candidate fits; the error is that of the first.
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
        prediction: Depth (H, W), metric or not; not positive or not finite is unknown.
        points: The points.
        kind: The parameters that are fitted, one of `choices.FITS`.
        reading: Quantity that is fitted: "depth", or "disparity" for 1/depth of prediction and
            points.

    Raises:
        NoPointsError: No point has a prediction.
        ModelError: The prediction is the same at all points, or zero, so that no line fits.
    """
    known, points = where_predicted(prediction, points)
    # 1 stands for what is unknown, as it can be inverted; it becomes 0 again.
    x = torch.where(known, prediction, 1.0)
    if reading == "disparity":
        x = x.reciprocal()
    fit = align(points.sample(x), points, [Candidate(reading, kind)])
    return torch.where(known, fit.depth(x), 0.0)


def where_predicted(prediction: Tensor, points: SparsePoints) -> tuple[Tensor, SparsePoints]:
    """Returns (H, W) bool, where a prediction is known, and the points that lie there.

    Args:
        prediction: Depth (H, W); not positive or not finite is unknown.
        points: The points. One between pixels lies there if all pixels around it are known.

    Raises:
        NoPointsError: There is no such point.
    """
    known = prediction.isfinite() & (prediction > 0)
    at_points = points.sample(torch.where(known, prediction, torch.nan))  # NaN beside any unknown
    seen = points.where(at_points.isfinite())
    if not len(seen):
        raise NoPointsError(
            f"none of the {len(points)} sparse points lies where the network has a prediction;"
            " are points and image of the same frame, and in pixels of the same image?"
        )
    return known, seen


def _has_kind(reading: str, kind: str) -> bool:
    """Whether a network's output, read as this quantity, can be fitted by these parameters.

    As an inverted disparity or a power it is fitted by scale and shift together, not by one.

    Args:
        reading: The quantity, one of `choices.READINGS`.
        kind: The parameters, one of `choices.FITS`.
    """
    return kind == "affine" or reading in ("depth", "disparity", "log")


def _fit(x: Tensor, depth: Tensor, candidate: Candidate) -> Alignment | None:
    """The best alignment with a candidate's reading, parameters and sign; None where none fits.

    Where the points contradict the sign, it is the one with the same depth everywhere.

    Args:
        x: (N,) float64 the network's numbers at the points.
        depth: (N,) float64 the points' depth in metres.
        candidate: The candidate.
    """
    line = _scale_and_shift(x, depth, candidate.reading, candidate.kind)
    if line is None or not all(map(math.isfinite, line)):  # such as in log x of numbers below 0
        return None
    scale, _ = line
    if candidate.sign and scale * candidate.sign <= 0:  # the points contradict the sign
        # Depth that is the same everywhere needs a shift, and says something of two points or more.
        has_level = candidate.kind == "affine" and len(x) > 1
        return _level(x, depth, candidate) if has_level else None
    if not scale:  # the numbers are the same at all points
        return None
    return _with_errors(x, depth, candidate, line)


def _level(x: Tensor, depth: Tensor, candidate: Candidate) -> Alignment:
    """The best alignment whose scale is 0, so that depth is the same everywhere.

    Args:
        x: (N,) float64 the network's numbers at the points.
        depth: (N,) float64 the points' depth in metres.
        candidate: The reading and the parameters; the reading is depth instead where it is of 1/x
            or log x.
    """
    # Of scale 0, a line in 1/x or log x says no more than one in x, and has no `_least_x`.
    is_in_x = _READINGS[candidate.reading].x_space == "depth"
    reading = candidate.reading if is_in_x else "depth"
    level_m = depth.new_tensor(fit_location(depth.log())).exp()
    shift = float(to_space(level_m, _READINGS[reading].depth_space))
    return _with_errors(x, depth, candidate._replace(reading=reading), (0.0, shift))


def _with_errors(
    x: Tensor, depth: Tensor, candidate: Candidate, line: tuple[float, float]
) -> Alignment:
    """The alignment by a line, with its errors at the points.

    Args:
        x: (N,) float64 the network's numbers at the points.
        depth: (N,) float64 the points' depth in metres.
        candidate: The reading and the parameters.
        line: (scale, shift).
    """
    scale, shift = line
    nearest, farthest = _bounds(depth).tolist()
    fit = Alignment(
        reading=candidate.reading,
        kind=candidate.kind,
        scale=scale,
        shift=shift,
        bounds=(nearest, farthest),
        points=len(x),
    )
    errors = (fit.depth(x).log() - depth.log()).abs()
    # The error is that of the best points; what is far above the median is an outlier.
    best_errors = errors.sort().values[: max(1, round(_BEST * len(errors)))]
    least_outlying = max(_GROSS_STDS * MAD_TO_STD * float(errors.median()), _GROSS)
    return replace(
        fit,
        error=float(best_errors.mean()),
        misfit=mean_error(errors),
        outliers=float((errors > least_outlying).double().mean()),
    )


def _scale_and_shift(
    x: Tensor, depth: Tensor, reading: str, kind: str
) -> tuple[float, float] | None:
    """Scale and shift of the line that fits the points best; None where x allows none.

    A scale of 0 says that no line fits, because the numbers are the same at all points.

    Args:
        x: (N,) float64 the network's numbers at the points.
        depth: (N,) float64 the points' depth in metres.
        reading: What the numbers are taken for, a key of `_READINGS`.
        kind: The parameters that are fitted, one of `choices.FITS`.
    """
    if kind == "none":  # nothing is fitted
        return 1.0, 0.0
    if kind != "affine":
        return _factor(x, depth, reading, kind)
    # Scale and shift: a line in x, in 1/x or in log x, of which the latter two need x above 0.
    _, x_space, depth_space = _READINGS[reading]
    if x_space != "depth" and not bool((x > 0).all()):
        return None
    x = to_space(x, x_space)
    if float(x.max() - x.min()) <= _DISTINCT * float(x.abs().max()):
        return 0.0, 0.0
    # The line is clamped where aligned depth is.
    low, high = sorted(to_space(_bounds(depth), depth_space).tolist())
    return fit_line(x, to_space(depth, depth_space), depth_space, (low, high))


def _factor(x: Tensor, depth: Tensor, reading: str, kind: str) -> tuple[float, float] | None:
    """Scale and shift where the only parameter is a factor of depth; None where none fits.

    Args:
        x: (N,) float64 the network's numbers at the points.
        depth: (N,) float64 the points' depth in metres.
        reading: What the numbers are taken for: "depth", "disparity" or "log".
        kind: "scale" for a robust mean of the points' own factors, "median" for their median.
    """
    if reading == "log":  # a factor of depth is an addend of its logarithm
        return 1.0, _common_addend(depth.log() - x, kind)
    # Numbers of the rarer sign, or 0, give no depth at any factor.
    sign = 1.0 if float(x.median()) >= 0 else -1.0
    is_used = sign * x > 0
    if not bool(is_used.any()):
        return None
    # d = scale·x, or 1/d = scale·x: log d is log x, or −log x, and what the scale adds to it.
    log_x = (sign * x[is_used]).log()
    log_depth = depth[is_used].log()
    if reading == "depth":
        return sign * math.exp(_common_addend(log_depth - log_x, kind)), 0.0
    return sign * math.exp(-_common_addend(log_depth + log_x, kind)), 0.0


def _common_addend(addends: Tensor, kind: str) -> float:
    """One addend of log depth for all points, from the one (N,) that each would need.

    Args:
        addends: The addends.
        kind: "median", or "scale" for their robust mean.
    """
    return float(addends.median()) if kind == "median" else fit_location(addends)


def _bic(fit: Alignment) -> float:
    """The Bayesian information criterion of a fit, of which less is better.

    Errors of log depth are taken as distributed by Laplace, whose log likelihood of N of them is
    −N·log(mean error) and a constant.
    """
    parameters = {"none": 0, "scale": 1, "median": 1, "affine": 2}[fit.kind]
    error = max(fit.misfit, _LEAST_ERROR)
    if fit.points <= parameters:  # it goes through all points, which says nothing of its error
        error = _UNTESTED
    return 2 * fit.points * math.log(error) + parameters * math.log(fit.points)


def _is_alike(fit: Alignment, best: Alignment, x: Tensor, depth: Tensor) -> bool:
    """Whether a fit explains the points as well as the best one, within what they have by chance.

    The criterion `_bic` is 2N times the logarithm of the mean error. To first order, a point moves
    it by twice its error over the mean. So the standard error of the difference of two criteria
    follows from what single points contribute to it.

    Args:
        fit: The fit.
        best: The fit with the least criterion.
        x: (N,) float64 the network's numbers at the points.
        depth: (N,) float64 the points' depth in metres.
    """
    difference = _relative_errors(fit, x, depth) - _relative_errors(best, x, depth)
    by_chance = 2 * math.sqrt(len(x)) * float(difference.std(correction=0))
    return _bic(fit) - _bic(best) <= _ALIKE * by_chance


def _relative_errors(fit: Alignment, x: Tensor, depth: Tensor) -> Tensor:
    """(N,) the errors of log depth at the points, over their mean.

    Args:
        fit: The fit.
        x: (N,) float64 the network's numbers at the points.
        depth: (N,) float64 the points' depth in metres.
    """
    errors = (fit.depth(x).log() - depth.log()).abs().clamp_max(MAX_ERROR)
    return errors / max(fit.misfit, _LEAST_ERROR)


def _bounds(depth: Tensor) -> Tensor:
    """(nearest, farthest) metres that aligned depth can have, from the depth (N,) of the points."""
    factor = BEYOND * (1 + 1 / len(depth))  # a few points do not show the range of the scene
    return torch.stack([depth.min() / factor, depth.max() * factor])


def _clamp_value(value: Tensor, low: float, high: float = math.inf) -> Tensor:
    """The value clamped between low and high, but with the gradient of the unclamped value."""
    clamped = value.clamp(low, high)
    if not value.requires_grad:
        return clamped
    return clamped.detach() + (value - value.detach())  # the addend is 0 and has the gradient


def to_space(depth: Tensor, space: str) -> Tensor:
    """Returns depth itself, 1/depth or log depth, as `space` says, one of `choices.SPACES`."""
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
    """Returns depth from what `to_space` makes of it; `space` is one of `choices.SPACES`."""
    match space:
        case "depth":
            return value
        case "inverse":
            return value.reciprocal()
        case "log":
            return value.exp()
        case _:
            raise KeyError(space)
