"""Validation points: a fifth of a frame's points, which the method predicts from the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.completion.folds import spatial_folds, under_holes
from pnpdepth_cli.completion.outliers import inlier_weights
from pnpdepth_cli.frames.frame import Frame, ValidationPoints, is_dense
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.scan_pattern import scan_pattern

FOLDS = 5
"""One of so many folds of the points is for validation. By convention; not tuned."""
MIN_POINTS = 5
"""With fewer points none is for validation: a fold would have less than one."""
MOST_VALIDATION_POINTS = 1000
"""Of more validation points, so many at random are predicted. It bounds the time of a LiDAR's."""
_LEAST_STANDARD_ERROR = 1e-12
"""A standard error of log depth is at least this before it is divided by."""
_LEAST_DEPTH = 1e-6
"""Metres; depth is at least this before its logarithm is taken."""


@dataclass(frozen=True, kw_only=True)
class ValidatedFrame(ValidationPoints):
    """A frame with all its inliers, the same without its validation points, and these points."""

    whole: Frame
    """The frame with all its inliers."""
    kept: Frame
    """The frame without its validation points; `whole` if there are none."""
    has_scan_lines: bool
    """Whether the points lie on scan lines."""
    propagation: str
    """How the residual at the points is propagated, a name in `choices.PROPAGATIONS`, or "none"."""
    hole: Tensor | None = None
    """(M,) number from 1 on of the copied hole that each validation point of a depth map lies under
    (`under_holes`). None: the points are no depth map with holes."""

    def gain(self, predicted: Tensor, rival: Tensor) -> float:
        """Returns by how many standard errors one prediction is better than another.

        Absolute errors of log depth are compared; the number is negative if the prediction is
        worse. Points under one hole of a depth map err together, so a hole counts as one point.

        Args:
            predicted: (M,) metres, 0 = unknown: the prediction at the validation points.
            rival: (M,) metres, 0 = unknown: the prediction that it is compared with.
        """
        # By how much its error is smaller at each point, and the point's fraction of all weights.
        truth = log_of(self.points.depth)
        fractions = self.weights / self.weights.sum()
        gains = (log_of(rival) - truth).abs() - (log_of(predicted) - truth).abs()
        # The mean of each hole in place of its points, all holes alike.
        if self.hole is not None:
            _, hole_of_point = torch.unique(self.hole, return_inverse=True)
            fraction_of_hole = torch.bincount(hole_of_point, fractions)
            sum_of_hole = torch.bincount(hole_of_point, fractions * gains)
            gains = (sum_of_hole / fraction_of_hole)[fraction_of_hole > 0]
            fractions = torch.full_like(gains, 1 / len(gains))
        # The mean over its standard error.
        mean = (fractions * gains).sum()
        standard_error = (fractions.square() * (gains - mean).square()).sum().sqrt()
        return float(mean / standard_error.clamp_min(_LEAST_STANDARD_ERROR))


def whole_frame(frame: Frame, propagation: str | None) -> ValidatedFrame:
    """Returns the frame with all its points, none of which is for validation.

    Args:
        frame: The frame without its outliers.
        propagation: How the residual is propagated. None: "local" for scan lines, else "gp". On
            even KITTI frames the MAE of "local" is 1.9 % and its RMSE 1.7 % below those of "gp".
            With points at random pixels, "gp" is 0 to 28 % below "local".
    """
    points = frame.points
    has_scan_lines = scan_pattern(points.xy, points.size) is not None
    if propagation is None:
        propagation = "local" if has_scan_lines else "gp"
    no_points = points.select(slice(0))
    return ValidatedFrame(
        whole=frame,
        kept=frame,
        points=no_points,
        weights=no_points.depth,
        has_scan_lines=has_scan_lines,
        propagation=propagation,
    )


def split_frame(
    unsplit: ValidatedFrame, prediction: Tensor, networks: Sequence[OpenNetwork], *, seed: int
) -> ValidatedFrame:
    """Returns the frame with and without its validation points, and these points.

    The frame stays as it is, without validation points, if it has fewer than `MIN_POINTS` points,
    or if a network sees none of the points that are not for validation.

    Args:
        unsplit: The frame with all its points, none of them for validation yet.
        prediction: (H, W) metres, 0 = unknown: depth from a network. Validation points whose
            residual, log measured − log predicted depth, differs from their neighbours' count
            less: outliers would decide the weights.
        networks: The networks that will predict.
        seed: Random seed of the validation points.
    """
    points = unsplit.whole.points
    if len(points) < MIN_POINTS:
        return unsplit
    # Of a depth map with holes, the points under copies of its holes (number 0 is under none); else
    # one fold of the points.
    hole = None
    if is_dense(points) and not unsplit.has_scan_lines:
        hole = under_holes(points, FOLDS, seed=seed)
    if hole is None:
        fold = spatial_folds(points, FOLDS, seed=seed)
        is_chosen = fold == 0
    else:
        is_chosen = hole > 0
    kept = replace(unsplit.whole, points=points.select(~is_chosen))
    if not bool(is_chosen.any()) or not all(network.sees(kept) for network in networks):
        return unsplit
    # Of many validation points some are drawn for the comparison. The experts predict without any.
    (numbers,) = is_chosen.nonzero(as_tuple=True)
    order = torch.randperm(len(numbers), generator=torch.Generator().manual_seed(seed))
    numbers = numbers[order[:MOST_VALIDATION_POINTS]]
    validation = points.select(numbers)
    hole = None if hole is None else hole[numbers]
    # Each has a weight 0…1 by how consistent its residual is with its neighbours'; all count alike
    # if none is consistent.
    predicted = validation.sample(prediction)
    residual = validation.depth.double().log() - predicted.clamp_min(_LEAST_DEPTH).double().log()
    weights = torch.where(predicted > 0, inlier_weights(validation, residual), 0.0).float()
    if not bool(weights.any()):
        weights = torch.ones_like(weights)
    return replace(unsplit, kept=kept, points=validation, weights=weights, hole=hole)


def log_of(depth: Tensor) -> Tensor:
    """Returns the logarithm of depth in metres; unknown depth (0) counts as a micrometre."""
    return depth.clamp_min(_LEAST_DEPTH).log()
