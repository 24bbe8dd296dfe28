"""How strong a network is on a frame, by what its depth leaves unexplained at the points."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.frames.frame import Frame, Prediction
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.validation import MIN_POINTS, ValidatedFrame, log_of
from pnpdepth_cli.points import SparsePoints

STRONG = 0.5
"""Leave-one-out error at the points of a network's depth, its residual propagated, over that of a
constant depth, up to which its strength is 1. Networks of 2 to 9 % error have 0.1 to 0.4 in the
median, FastDepth 0.95, random weights 1.1."""
WEAK = 0.8
"""That quotient of leave-one-out errors, from which on the strength of a network is 0."""
FITTED = 2
"""Parameters of an alignment, which explain so many points by themselves."""
LEAST_LOG_ERROR = 1e-9
"""Errors of log depth are at least this before they are divided by."""
LEAST_SQUARES = 1e-12
"""Sums of squares of log depth are at least this before they are divided by."""
USELESS = 0.25
"""Fraction of the variance of log depth that a network explains at points that its alignment was
not fitted to, up to which it has no prior weight. A network of random weights has less than this in
86 % of the runs with 20 points, 97 % with more."""
USEFUL = 0.75
"""That fraction of the variance, from which on a network has all of its prior weight."""


class OutlierSearch(NamedTuple):
    """A frame without its outliers, and the network beside whose depth these were found.

    Where outliers were not sought, the frame has all its points.
    """

    network: OpenNetwork
    """The network beside whose depth outliers were found."""
    inliers: Frame
    """The frame without its outliers."""
    prediction: Prediction
    """What `network` gives for `inliers`."""
    field: ResidualField | None = None
    """Residual field of its aligned depth at all points. None: outliers were not sought."""
    constant: ResidualField | None = None
    """Residual field of a constant depth at all points. None: outliers were not sought."""

    def by(self, network: OpenNetwork) -> Prediction | None:
        """Returns what a network gives for the inliers; None if outliers were found by another."""
        if network is self.network:
            return self.prediction
        return None  # it has not predicted yet


def unexplained_by(aligned: Tensor, split: ValidatedFrame, search: OutlierSearch) -> float:
    """Returns which part of the points' depth, mostly 0…1, a network leaves unexplained.

    That is a quotient of two leave-one-out errors: that with which the network's aligned depth, its
    residual propagated, predicts each point from the others, over that of a constant depth, whose
    residual follows position and colour alone. The network takes the image alone, so that it has
    not seen the points. It is 1 with fewer than `MIN_POINTS` points. It is 1 on scan lines, too:
    there each point has a neighbour on its line, which predicts it whatever the network says.

    The alignment was fitted to all points. So the error of N points is multiplied by
    (N − 1) / (N − 1 − FITTED), as in the unbiased estimate of a variance.

    Args:
        aligned: (H, W) metres, 0 = unknown, the network's depth before updates of z.
        split: The frame and its validation points.
        search: The frame without outliers, and the residual fields by which these were found.
    """
    points = split.whole.points
    known_count = int((points.sample(aligned) > 0).sum())
    if split.has_scan_lines or known_count < MIN_POINTS or search.constant is None:
        return 1.0
    field = search.field
    if field is None or not field.is_of(aligned, points):  # that of another network
        field = ResidualField(aligned, points, split.whole.rgb)
    return unexplained_of(field, search.constant)


def unexplained_of(field: ResidualField, constant: ResidualField) -> float:
    """Returns which part of the points' depth a network's depth leaves unexplained, mostly 0…1.

    It is the quotient of leave-one-out errors that `unexplained_by` describes, and 1 with fewer
    than `MIN_POINTS` points.

    Args:
        field: Residual field of the network's depth.
        constant: Residual field of a constant depth at the same points.
    """
    count = len(field.at_points.points)
    if count < MIN_POINTS:
        return 1.0
    of_depth = field.at_inliers.leave_one_out_error
    of_constant = constant.at_inliers.leave_one_out_error
    quotient = of_depth / max(of_constant, LEAST_LOG_ERROR)
    # The alignment of the depth was fitted to these points.
    return quotient * (count - 1) / (count - 1 - FITTED)


def strength_of(unexplained: float) -> float:
    """Returns 0…1, how strong a network is that leaves this part unexplained (`unexplained_by`).

    0 from `WEAK` on, 1 up to `STRONG`, linear in between.
    """
    return min(1.0, max(0.0, (WEAK - unexplained) / (WEAK - STRONG)))


def trust_in_image(aligned: Tensor, points: SparsePoints) -> float:
    """Returns 0…1, the fraction of its prior weights that a network of the image alone gets.

    The prior weights are those in the fused depth before the validation points change them.

    It rises from 0 to 1 as the fraction of the variance of the points' log depth that the network's
    log depth explains rises from `USELESS` to `USEFUL`. That fraction is 1 − PRESS / SS: each point
    is predicted by the line through the other points (Allen, "The relationship between variable
    selection and data augmentation and a method for prediction", 1974). It is 0 with fewer than
    `MIN_POINTS` points, and if the network takes far for near.

    Args:
        aligned: (H, W) metres, 0 = unknown, the network's depth, z not updated.
        points: The frame's points without outliers.
    """
    # x is the network's log depth at the points, y theirs, both less their mean below.
    predicted = points.sample(aligned).double()
    is_known = predicted > 0
    x = log_of(predicted[is_known])
    y = log_of(points.depth[is_known].double())
    count = len(x)
    if count < MIN_POINTS:
        return 0.0
    x = x - x.mean()
    y = y - y.mean()
    squares = (x @ x).clamp_min(LEAST_SQUARES)
    slope = (x @ y) / squares
    if slope <= 0:
        return 0.0  # it says that far is near
    # The error at each point of the line through the others is that of the line through all, over
    # 1 − leverage; so is that of the others' mean.
    leverage_left = 1 - 1 / count - x.square() / squares
    errors = (y - slope * x) / leverage_left
    mean_errors = y / (1 - 1 / count)
    total = mean_errors.square().sum().clamp_min(LEAST_SQUARES)  # SS
    explained = float(1 - errors.square().sum() / total)  # 1 − PRESS / SS
    return min(1.0, max(0.0, (explained - USELESS) / (USEFUL - USELESS)))
