"""Outliers: points whose depth is inconsistent with their neighbours'.

A point on a small object is as alone as an outlier. So points are removed only where the others
predict each other far better without all that are alone. Points that are alone together are no
outliers. They are something that the network has not seen, such as a corridor behind a door.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pnpdepth_cli.completion.gaussian_process import Residuals, leave_one_out, neighbourhoods
from pnpdepth_cli.completion.interpolation import nearest_points, neighbours_of
from pnpdepth_cli.core.losses import MAD_TO_STD
from pnpdepth_cli.points import SparsePoints

ALONE = 10.0
"""Disagreement with all neighbours, in robust standard deviations, at which a weight is 0."""
FAR = 0.2
"""Difference of log depth beyond which a network that weighs its points contradicts a point."""

_LEAST_DEPTH = 1e-6
"""Metres; a prediction is at least this before its logarithm is taken."""

_COMPARED = 8
"""Neighbours that a point is compared with."""
_AGREEING = 2
"""Of these neighbours, how many must agree with it, at least."""
_MIN_DISAGREEMENT = 0.005
"""Difference of log depth that is taken as usual between neighbours, at least."""

_ALIKE = 0.15
"""Difference of two points' errors of log depth below which they are off together."""
_AGREE_AROUND = 3
"""Of `_AROUND` neighbours, how many must be off together with a point, at least."""

_PASSES = 3
"""Times that outliers are sought: without the worst ones, others stand out."""
_MIN_POINTS = 5
"""Fewer do not predict each other."""
_MAX_EXACT = 256
"""Points up to which all predict each other, instead of neighbourhoods."""
_CUTOFFS = (4.0, 4.0, 5.0, 6.0, 8.0)
"""Times the typical error at which a weight is 0, in turn."""
_MIN_ERROR = 1e-3
"""Typical error, over its standard deviation, that is assumed at least."""
_MIN_WEIGHT = 0.05
"""Points with less weight are suspected."""
_AROUND = 6
"""Neighbours among which suspected points are counted."""
_MOST_SUSPECTED = 4
"""Suspected ones among these neighbours, at least, of a point that is suspected together with them.

With a fifth of outliers, 2 % of the points have 4."""
_HALF_SUSPECTED = 3
"""Those among them, at least, that are suspected together, for a point beside these to join."""
_FAR_BETTER = 0.5
"""The others' errors without the suspected points must fall to this fraction."""
_FAR_BETTER_MANY = 0.65
"""The same where there are many points, whose errors are well known."""


def far_points(prediction: Tensor, points: SparsePoints) -> Tensor:
    """Returns (N,) bool: the points whose log depth differs by more than `FAR` from a prediction.

    The points of a wrong track of structure from motion agree with each other. Only a network that
    sees the image and weighs its points tells that they are outliers. A prediction far from half of
    the points or more is of no use: then none is far.

    Args:
        prediction: Depth (H, W) in metres, 0 = unknown, of a network that weighs its points.
        points: The N points.
    """
    at_points = points.sample(prediction)
    error = points.depth.log() - at_points.clamp_min(_LEAST_DEPTH).log()
    far = (at_points > 0) & (error.abs() > FAR)
    return far if far.sum() < len(points) / 2 else torch.zeros_like(far)


def off_together(points: SparsePoints, error: Tensor, least: float) -> Tensor:
    """Returns (N,) bool: points that agree with points around them, but not with a prediction.

    Such are the points seen in a mirror or through a pane. No geometry of the points tells these
    from a corridor behind a door; a prediction that is right everywhere else does.

    They are all farther than predicted, or all nearer, whichever are more.

    Args:
        points: The N points.
        error: Errors (N,), log measured − log predicted depth.
        least: |Error| above which a point does not agree with the prediction.
    """
    # Of so few points none has neighbours enough; and without a larger error none is off.
    if len(points) <= _AROUND or not bool((error.abs() > least).any()):
        return torch.zeros(len(points), dtype=torch.bool)
    # Points that are off to one side, with neighbours that are off by about as much.
    near = neighbours_of(points, _AROUND)
    alike = (error[near] - error[:, None]).abs() < _ALIKE  # (N, _AROUND)
    groups = list[Tensor]()
    for signed_error in (error, -error):  # farther points, then nearer ones
        off = signed_error > least
        agreeing = (off[near] & alike).sum(dim=1)
        groups.append(off & (agreeing >= _AGREE_AROUND))
    return max(groups, key=lambda group: int(group.sum()))


def without_outliers(residuals: Residuals) -> Residuals:
    """Returns the residuals at the points that are no outliers; all unless some clearly are.

    Outliers are sought again without those that were found, until there are none, at most
    `_PASSES` times.
    """
    for _ in range(_PASSES):
        inliers = inlier_mask(residuals)
        if bool(inliers.all()):
            break
        residuals = residuals.select(inliers)
    return residuals


def inlier_weights(points: SparsePoints, residual: Tensor) -> Tensor:
    """Returns the weight (N,) 0…1 of each point by how consistent it is with its neighbours.

    A point that no two of its neighbours agree with is an outlier, or on an object so small that
    nothing can be learnt from it for others: its weight is 0.

    Args:
        points: The N points.
        residual: Residual (N,) of the points, log measured − log predicted depth.
    """
    if len(points) <= _AGREEING:  # no point has neighbours enough to be contradicted
        return torch.ones_like(residual)
    near = neighbours_of(points, min(_COMPARED, len(points) - 1))
    # By how much a point differs from the neighbour that agrees with it second best.
    differences = (residual[near] - residual[:, None]).abs().sort(dim=1).values
    disagreement = differences[:, _AGREEING - 1]
    typical = max(MAD_TO_STD * float(disagreement.median()), _MIN_DISAGREEMENT)
    return _biweight(disagreement / (ALONE * typical))


def _biweight(ratio: Tensor) -> Tensor:
    """Tukey's weights (1 − ratio²)² of errors over the cutoff; 0 from a ratio of 1 on."""
    return (1 - ratio.square()).clamp_min(0).square()


def inlier_mask(residuals: Residuals) -> Tensor:
    """Returns (N,) bool: the points that are no outliers; all of them unless some clearly are.

    Points are weighted by how well others predict them. First these are their neighbours
    (`inlier_weights`). Then, unless there are very many points, it is the Gaussian process from all
    others with their weights.
    """
    weight = inlier_weights(residuals.points, residuals.residual)
    near = neighbourhoods(residuals, _MAX_EXACT)
    has_all_points = len(near) == 1
    # Few points all predict each other, with weights that follow from the errors, again and again.
    if has_all_points and near.shape[1] >= _MIN_POINTS:
        for cutoff in _CUTOFFS:
            errors, variances = leave_one_out(residuals, near, weight)
            deviations = errors[0].abs() / variances[0].sqrt()
            typical = max(MAD_TO_STD * float(deviations.median()), _MIN_ERROR)
            weight = _biweight(deviations / (cutoff * typical))
    # Points of little weight are suspected. Where their neighbours are, too, they are inliers,
    # which have at least the weight that tells the two apart.
    inliers = weight > _MIN_WEIGHT
    inliers = inliers | _suspected_together(residuals.points, ~inliers)
    weight = torch.where(inliers, weight.clamp_min(_MIN_WEIGHT), weight)
    if bool(inliers.all()) or not bool(inliers.any()):  # with all suspected, none stands out
        return torch.ones_like(inliers)
    # They are outliers if the others predict each other far better without them.
    errors_with, _ = leave_one_out(residuals, near)
    errors_without, _ = leave_one_out(residuals, near, weight)
    scored_weight = weight[near[:, : errors_with.shape[1]]]  # of the points that have an error
    sum_with = float((errors_with.abs() * scored_weight).sum())
    sum_without = float((errors_without.abs() * scored_weight).sum())
    far_better = _FAR_BETTER if has_all_points else _FAR_BETTER_MANY
    if sum_without >= far_better * sum_with:
        return torch.ones_like(inliers)
    return inliers


def _suspected_together(points: SparsePoints, suspected: Tensor) -> Tensor:
    """(N,) bool: suspected points most of whose neighbours are suspected, and those beside them.

    So points that are off together, as on an object that the network has not seen, are found.

    Args:
        points: The N points.
        suspected: Whether each point, (N,) bool, may be an outlier.
    """
    # Of so few points none has neighbours enough.
    together = torch.zeros_like(suspected)
    if len(points) <= _AROUND or not bool(suspected.any()):
        return together
    # Only suspected points can be among them, so only their neighbours are sought.
    (numbers,) = suspected.nonzero(as_tuple=True)
    _, near = nearest_points(points, points.xy[numbers].double(), _AROUND + 1)
    near = near[:, 1:]  # the nearest is the point itself
    together[numbers] = suspected[near].sum(dim=1) >= _MOST_SUSPECTED
    # Suspected points beside these join them, until there are no more.
    while True:
        more = together[numbers] | (together[near].sum(dim=1) >= _HALF_SUSPECTED)
        if torch.equal(more, together[numbers]):
            return together
        together[numbers] = more
