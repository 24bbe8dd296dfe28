"""Robust fits of log depth: the line that explains it best in a given quantity, and the factor.

With y = scale·x + shift in the quantity of depth that is linear in x, such as 1/d, the errors are
those of log depth, which count far and near points alike. Their loss is Cauchy's, log(1 + (e/c)²),
where c follows the median of the errors: an outlier counts little, no point counts nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pnpdepth_cli.core.losses import MAD_TO_STD

MAX_ERROR = 1.0
"""|log| error above which a point counts no more in a comparison of fits."""

_CAUCHY = 2.385
"""c over the standard deviation of the errors.

Then the fit is 95 % efficient for normal errors (Holland, Welsch 1977)."""

_LEAST_ERROR = 0.02
"""Standard deviation of the errors that is assumed at least."""

_STEPS = 20
"""Most steps of a minimisation. It converges in about six."""

_CONVERGED = 1e-6
"""Fraction of the loss by which a step must lower it for another one to follow.

Of a location it is how far a step must move it, in the unit of the values."""

_HALVINGS = 8
"""Most halvings of a step that does not lower the loss."""

_PAIRS = 256
"""Lines through two points that are tried. With a fifth of outliers 160 of them have none."""

_SCORED = 512
"""Most points that the median error of such a line is over."""


def mean_error(errors: Tensor) -> float:
    """Returns the mean size of errors (N,) of log depth, none counting more than `MAX_ERROR`."""
    return float(errors.abs().clamp_max(MAX_ERROR).mean())


def fit_location(values: Tensor) -> float:
    """Returns the robust mean of values (N,): where Cauchy's loss of their differences is least.

    Found from their median, by means with the loss's weights until they change no more.
    """
    location = values.median()
    for _ in range(_STEPS):
        errors = values - location
        weights = _weights(errors, _width(errors))
        before = location
        location = (weights @ values) / weights.sum()
        if abs(float(location - before)) <= _CONVERGED:
            break
    return float(location)


def fit_line(x: Tensor, y: Tensor, space: str, limits: tuple[float, float]) -> tuple[float, float]:
    """Returns the scale and the shift of y = scale·x + shift, of which outliers decide little.

    The loss has several minima. It is minimised from least squares over all points, and from the
    one of many lines through two points that has the smallest median error (LMedS, Rousseeuw 1984).
    The line with the smaller `mean_error` is the result.

    Args:
        x: (N,) values, not all the same.
        y: (N,) the points' depth in `space`.
        space: Quantity of depth that y is, one of `choices.SPACES`.
        limits: (low, high) of y, to which the line is clamped.
    """
    task = _LineFit(x, y, space, limits)
    starts = [task.least_squares()]
    through_two = task.least_median()
    if through_two is not None:
        starts.append(through_two)
    lines = [task.minimise(scale, shift) for scale, shift in starts]
    return min(lines, key=lambda line: mean_error(task.errors(*line)))


class _LineFit:
    """The task of fitting y = scale·x + shift to N points; the arguments are those of `fit_line`.

    All tensors are (N,). A logarithm of y is log depth, up to its sign.
    """

    def __init__(self, x: Tensor, y: Tensor, space: str, limits: tuple[float, float]) -> None:
        self._x = x
        self._y = y
        self._space = space
        self._limits = limits
        self._log_y = self._log(y)

    def errors(self, scale: float, shift: float) -> Tensor:
        """Returns the errors (N,) of log depth by a line; where y is 1/depth, of log(1/depth)."""
        return self._log(scale * self._x + shift) - self._log_y

    def least_squares(self) -> tuple[float, float]:
        """Returns scale and shift by least squares of relative errors over all points.

        Where y is log depth, its plain errors are relative ones of depth.
        """
        if self._space == "log":
            return _weighted_least_squares(self._x, self._y, torch.ones_like(self._y))
        return _weighted_least_squares(self._x, self._y, self._y**-2)  # squares of errors over y

    def least_median(self) -> tuple[float, float] | None:
        """Returns scale and shift of the line through two points with the least median error.

        Of many points, some pairs are drawn, with a fixed seed. None where x is the same at the
        points of each pair.
        """
        x, y, log_y = self._x, self._y, self._log_y
        generator = torch.Generator().manual_seed(0)
        if len(x) > _SCORED:
            scored = torch.randperm(len(x), generator=generator)[:_SCORED]
            x, y, log_y = x[scored], y[scored], log_y[scored]
        # Pairs of points, and the lines through them.
        first, second = torch.triu_indices(len(x), len(x), 1)
        if len(first) > _PAIRS:
            drawn = torch.randperm(len(first), generator=generator)[:_PAIRS]
            first, second = first[drawn], second[drawn]
        is_apart = x[first] != x[second]
        first, second = first[is_apart], second[is_apart]
        if not len(first):
            return None
        scale = (y[first] - y[second]) / (x[first] - x[second])
        shift = y[first] - scale * x[first]
        # Errors (pairs, points), and the line that half of the points are nearest to.
        errors = self._log(scale[:, None] * x + shift[:, None]) - log_y
        best = errors.abs().median(dim=1).values.argmin()
        return float(scale[best]), float(shift[best])

    def minimise(self, scale: float, shift: float) -> tuple[float, float]:
        """Returns scale and shift where Gauss-Newton steps from this line find a minimum."""
        errors = self.errors(scale, shift)
        for _ in range(_STEPS):
            width = _width(errors)
            loss = _loss(errors, width)
            # By how much the line must change at each point, and what an error weighs there. A
            # point where the line is clamped pulls as if it were at the limit.
            if self._space == "log":
                change = -errors
                weights = _weights(errors, width)
            else:
                line_y = (errors + self._log_y).exp()  # y of the line at each point, clamped
                change = -errors * line_y
                weights = _weights(errors, width) / line_y.square()
            scale_step, shift_step = _weighted_least_squares(self._x, change, weights)
            # The step is halved until it lowers the loss; if none does, this is the minimum.
            for halving in range(_HALVINGS):
                fraction = 0.5**halving
                next_scale = scale + fraction * scale_step
                next_shift = shift + fraction * shift_step
                next_errors = self.errors(next_scale, next_shift)
                next_loss = _loss(next_errors, width)
                if next_loss < loss:
                    break
            else:
                break
            scale = next_scale
            shift = next_shift
            errors = next_errors
            if loss - next_loss < _CONVERGED * loss:
                break
        return scale, shift

    def _log(self, y: Tensor) -> Tensor:
        """The logarithm of values of y, clamped to the limits; of log depth y itself."""
        clamped = y.clamp(*self._limits)
        return clamped if self._space == "log" else clamped.log()


def _weighted_least_squares(x: Tensor, y: Tensor, weights: Tensor) -> tuple[float, float]:
    """Scale and shift of y = scale·x + shift by least squares with weights; all tensors are (N,).

    The scale is 0 where x is the same everywhere.
    """
    total = weights.sum()
    mean_x = (weights @ x) / total
    mean_y = (weights @ y) / total
    spread = weights @ (x - mean_x).square()
    if not float(spread) > 0:
        return 0.0, float(mean_y)
    scale = (weights @ ((x - mean_x) * (y - mean_y))) / spread
    return float(scale), float(mean_y - scale * mean_x)


def _width(errors: Tensor) -> float:
    """c of the loss log(1 + (e/c)²) for errors (N,): a multiple of their robust deviation."""
    return _CAUCHY * max(MAD_TO_STD * float(errors.abs().median()), _LEAST_ERROR)


def _weights(errors: Tensor, width: float) -> Tensor:
    """(N,) the weights with which least squares has the gradient of the loss; width is its c."""
    return 1 / (1 + (errors / width).square())


def _loss(errors: Tensor, width: float) -> float:
    """Cauchy's loss of the errors, up to a factor."""
    return float((errors / width).square().log1p().sum())
