"""The weights of the experts: those that predict the validation points best, near prior weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.camera import Floats
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.frames.experts import LEAST_ERROR, Expert, Experts, weighted_mean
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.validation import ValidatedFrame, log_of

STRENGTH = 60.0
"""Validation points that the prior weights count as. It was chosen with each of six sets left out
in turn (docs/notes/fusion.md)."""
OWN_SCANNER = 0.75
"""Weight of a completion network on scan lines. Validation points cannot judge it: the lines that
they leave are gaps that its scanner does not leave. On even KITTI frames this changes its MAE by
−0.9 (pncnn) and −2.8 % (nconv)."""
IMAGE_ON_LINES = 0.15
"""Least weight of an image network on scan lines, its aligned depth propagated. With simulated
networks of 4 and 9 % error on two KITTI frames, RMSE falls by 3.1 % and MAE by 1.2 to 1.5 %. With
0.25 it is 5 and 2 %, but exact lines of a depth camera lose 1 to 4 % indoors."""
ALL_ON_LINES = 1.5
"""Error of an image network's depth at the validation points, over that of `compact`, up to which
it has all of that least weight. Simulated networks of 4 and 9 % error have 0.4 to 1.55, FastDepth
1.9 to 2.5."""
NONE_ON_LINES = 2.0
"""Error of that depth, over that of `compact`, from which on it has no least weight."""

# Of the fit of the weights.
_PASSES = 5  # of iteratively reweighted least squares
_STD_OF_MEAN = 1.25  # standard deviation over the mean size of normal errors
_LEAST_STD = 1e-3  # of log depth, from which on a residual counts less
_LEAST_SIZE = 1e-9  # of a residual of log depth before it is divided by
_SUM_WEIGHT = 1e4  # of the row by which the weights add up to 1


def fit_weights(
    experts: Sequence[Expert], split: ValidatedFrame, chosen: Tensor | None = None
) -> dict[str, float]:
    """Returns the weights of the experts in the fused depth by name, >= 0, their sum 1.

    They minimise the residuals of log depth at the validation points by Huber's loss, plus
    `STRENGTH` times the squared distance from the prior weights. An expert without prior weight has
    none. Where an expert predicts nothing, the others' mean stands for it.

    Args:
        experts: The experts, at least one of which has a prior weight above 0.
        split: The frame and its validation points.
        chosen: (M,) bool, the validation points to fit. None: all.
    """
    weighted = [expert for expert in experts if expert.weight > 0]
    prior = np.array([expert.weight for expert in weighted])
    prior = prior / prior.sum()
    fitted = prior
    is_chosen = torch.ones(len(split.points), dtype=torch.bool) if chosen is None else chosen
    if len(weighted) > 1 and bool(is_chosen.any()):
        # Log predictions and log depths, relative to the prediction with the prior weights. An
        # unknown prediction is put at that mean.
        of_experts = [expert.at_validation[is_chosen].double() for expert in weighted]
        mean = weighted_mean(list(zip(of_experts, prior.tolist(), strict=True)))
        centre = log_of(mean)
        predicted = torch.stack(of_experts, dim=1)
        offsets = torch.where(predicted > 0, log_of(predicted) - centre[:, None], 0.0)
        residual = log_of(split.points.depth.double()[is_chosen]) - centre
        point_weights = split.weights[is_chosen].double()
        fitted = _fit(prior, offsets.numpy(), residual.numpy(), point_weights.numpy())
    # An expert without prior weight has none.
    weights = {expert.name: 0.0 for expert in experts}
    for expert, weight in zip(weighted, fitted, strict=True):
        weights[expert.name] = float(weight)
    return weights


def _fit(prior: Floats, offsets: Floats, residual: Floats, point_weights: Floats) -> Floats:
    """Weights (E,) of E experts, >= 0, their sum 1, that fit the experts' depths to the points.

    `offsets @ weights` is close to `residual` by Huber's loss, and the weights are close to the
    prior weights. It is solved by iteratively reweighted least squares.

    Args:
        prior: (E,) prior weights, all above 0, their sum 1.
        offsets: (M, E) log depth of each expert at each of M points, less a mean of the experts'.
        residual: (M,) measured log depth at the points, less the same mean.
        point_weights: (M,) how much each point counts.
    """
    from scipy.optimize import nnls

    # The residual from which on Huber's loss is linear: the standard deviation of the residuals.
    mean_size = float(np.average(np.abs(residual), weights=point_weights))
    scale = max(_STD_OF_MEAN * mean_size, _LEAST_STD)
    # The factor of the rows of the prior weights: a squared distance of 1 from these counts as
    # `STRENGTH` squared residuals of one standard deviation.
    ridge = np.sqrt(STRENGTH) * scale
    sum_of_weights = np.full((1, len(prior)), _SUM_WEIGHT)
    fitted = prior
    for _ in range(_PASSES):
        # Rows have the square root of their weight, which falls where a residual is above `scale`.
        size = np.abs(residual - offsets @ fitted)
        root = np.sqrt(point_weights * np.minimum(1, scale / np.maximum(size, _LEAST_SIZE)))
        # Rows of the least squares: the M points, the E prior weights, and the sum of 1.
        rows = [offsets * root[:, None], ridge * np.eye(len(prior)), sum_of_weights]
        targets = [residual * root, ridge * prior, [_SUM_WEIGHT]]
        fitted, _ = nnls(np.concatenate(rows), np.concatenate(targets))
        fitted /= fitted.sum()  # which the last row makes nearly 1
    return fitted


class Share(NamedTuple):
    """A network's depth, and its weight in the result beside the fused depth of all experts."""

    name: str
    weight: float
    """0…1, its weight in the result."""
    dense: Tensor
    """(H, W) metres, 0 = unknown: its depth."""
    at_validation: Tensor
    """(M,) metres, 0 = unknown: its depth at the M validation points, from the other points."""


def with_shares(fused: Tensor, shares: Sequence[tuple[Tensor, float]]) -> Tensor:
    """Returns the weighted geometric mean of the fused depth and depths of single networks.

    Args:
        fused: Depth in metres, 0 = unknown, of any shape. It has the weight that the others leave.
        shares: Depths of that shape, and their weights, whose sum is at most 1.
    """
    weight_of_fused = 1 - sum(weight for _, weight in shares)
    return weighted_mean([(fused, weight_of_fused), *shares])


def shares_on_lines(
    experts: Experts, split: ValidatedFrame, inliers: Frame, weights: Mapping[str, float]
) -> list[Share]:
    """Returns the networks that have a weight in the result beside the fused depth; mostly none.

    This is for frames whose points are scan lines. The validation points of such a frame are whole
    lines beside others, where `compact` and interpolation are best. So their error does not show
    what a completion network for that scanner is worth, nor what an image network is worth between
    the lines. The user's completion networks that fit the points have the weight
    `OWN_SCANNER` together. If none does, the user's first network may have up to `IMAGE_ON_LINES`,
    if it takes the image alone.

    Args:
        experts: The experts.
        split: The frame and its validation points.
        inliers: The frame without its outliers.
        weights: Weights of the experts in the fused depth, by name.
    """
    if not len(split.points):
        return []  # no error of the experts to compare with
    of_scanner = _shares_of_scanner(experts.every, split, weights)
    if of_scanner:
        return of_scanner
    return _share_of_image(experts, split, inliers, weights)


def _shares_of_scanner(
    experts: Sequence[Expert], split: ValidatedFrame, weights: Mapping[str, float]
) -> list[Share]:
    """The user's completion networks that fit the points, with weights beside the fused depth.

    A network fits if its error at all points, which it was given, is at most the error of the
    experts' mean at the validation points, which they were not given. No share if none fits.

    Args:
        experts: The experts.
        split: The frame and its validation points.
        weights: The weights in the fused depth, by name.
    """
    of_scanner = [expert for expert in experts if expert.of_scanner]
    if not of_scanner:
        return []
    # Those that fit the points that they were given, by mean absolute error in metres.
    mean = weighted_mean([(expert.at_validation, weights[expert.name]) for expert in experts])
    limit = split.error(mean)
    points = split.whole.points
    fitting = [
        expert
        for expert in of_scanner
        if (points.sample(expert.dense) - points.depth).abs().mean() <= limit
    ]
    if not fitting:
        return []
    # The weight is divided equally among them.
    weight = OWN_SCANNER / len(fitting)
    return [
        Share(expert.name, weight, expert.dense, expert.updated_at_validation) for expert in fitting
    ]


def _share_of_image(
    experts: Experts, split: ValidatedFrame, inliers: Frame, weights: Mapping[str, float]
) -> list[Share]:
    """The user's first network, if it has a weight beside the fused depth, in a list; else none.

    Its depth is the aligned one, the residual propagated. A network of the image alone has a least
    weight in the result; here it gets what its weight in the fused depth lacks of that. It gets
    nothing if that weight is enough, if the network takes points, or if no other one is fused with
    it.

    Args:
        experts: The experts.
        split: The frame and its validation points.
        inliers: The frame without its outliers.
        weights: The weights in the fused depth, by name.
    """
    first = experts.first_of_user
    without_prior = experts.without_prior
    if without_prior is None or first.user is None or first.user.takes_points:
        return []
    # The least weight follows its error at the validation points over that of `compact`: all of
    # `IMAGE_ON_LINES` up to `ALL_ON_LINES`, 0 from `NONE_ON_LINES` on, linear in between.
    kept = split.kept
    field = ResidualField(first.from_others.aligned, kept.points, kept.rgb)
    predicted = field.depth(split.points.xy, kind=split.propagation)
    ratio = split.error(predicted) / max(split.error(without_prior.at_validation), LEAST_ERROR)
    fraction = (NONE_ON_LINES - ratio) / (NONE_ON_LINES - ALL_ON_LINES)
    least_weight = IMAGE_ON_LINES * min(1.0, max(0.0, fraction))
    # What its weight in the fused depth lacks of that.
    missing = least_weight - weights[first.name]
    if missing <= 0:
        return []
    # Its depth from all points.
    field = ResidualField(first.from_all.aligned, inliers.points, inliers.rgb)
    return [Share(first.name, missing, field.depth(kind=split.propagation), predicted)]
