"""Validation points: a part of the points that predictions from the others are compared with."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from pnpdepth_cli.completion.folds import spatial_folds
from pnpdepth_cli.completion.outliers import inlier_weights
from pnpdepth_cli.frames.frame import Frame, no_points
from pnpdepth_cli.frames.refined import ValidationPoints
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_pattern

FOLDS = 5
"""Number of folds of the points, one of which is for validation."""
MIN_POINTS = 5
"""With fewer points none is for validation."""
MOST_VALIDATION_POINTS = 1000
"""Most validation points that are predicted; of more, so many at random."""


@dataclass(frozen=True, kw_only=True)
class ValidationSplit(ValidationPoints):
    """A frame with all its inliers, and without its validation points."""

    whole: Frame
    kept: Frame

    @functools.cached_property
    def has_scan_lines(self) -> bool:
        """Whether the points are those of a scanner."""
        points = self.whole.points
        return scan_pattern(points.xy.cpu().numpy(), points.size).has_scan_lines

    @property
    def propagation(self) -> str:
        """How the residual at the points is propagated, a name in `choices.PROPAGATIONS`.

        It is "local" for scan lines: on even KITTI frames its MAE is 1.9 % and its RMSE 1.7 % below
        those of "gp". With points at random pixels, "gp" is 0 to 28 % below "local".
        """
        return "local" if self.has_scan_lines else "gp"

    def gain(self, at: Tensor, other: Tensor) -> float:
        """Returns by how many standard errors one prediction (M,) is better than another.

        In log depth; negative where it is worse.
        """
        truth, share = log_depth(self.points.depth), self.weights / self.weights.sum()
        gain = (log_depth(other) - truth).abs() - (log_depth(at) - truth).abs()
        mean = (share * gain).sum()
        error = (share.square() * (gain - mean).square()).sum().sqrt()
        return float(mean / error.clamp_min(1e-12))


def split_frame(frame: Frame, judged: Tensor, seed: int) -> ValidationSplit:
    """Returns the frame with and without its validation points.

    Args:
        frame: The frame without its outliers.
        judged: (H, W) metres, what the network that judged the outliers gives for it.
        seed: Random seed of the validation points.
    """
    parts = split_points(frame.points, seed)
    if parts is None:
        none = no_points(frame.points)
        return ValidationSplit(whole=frame, kept=frame, points=none, weights=torch.empty(0))
    kept, points = parts
    weights = consistency(points, judged)
    return ValidationSplit(
        whole=frame, kept=frame.with_points(kept), points=points, weights=weights
    )


def split_points(points: SparsePoints, seed: int) -> tuple[SparsePoints, SparsePoints] | None:
    """Returns the other points and the validation points; None where they are too few."""
    if len(points) < MIN_POINTS:
        return None
    chosen = spatial_folds(points, FOLDS, seed=seed) == 0
    if not 0 < int(chosen.sum()) < len(points):
        return None
    (numbers,) = chosen.nonzero(as_tuple=True)
    drawn = torch.randperm(len(numbers), generator=torch.Generator().manual_seed(seed))
    return points.select(~chosen), points.select(numbers[drawn[:MOST_VALIDATION_POINTS]])


def consistency(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns (N,) 0…1, how consistent each point is with its neighbours beside a prediction.

    Outliers among the validation points would decide the weights.
    """
    at_points = points.sample(prediction)
    residual = points.depth.double().log() - at_points.clamp_min(1e-6).double().log()
    weights = torch.where(at_points > 0, inlier_weights(points, residual), 0.0).float()
    return weights if bool(weights.any()) else torch.ones_like(weights)


def log_depth(depth: Tensor) -> Tensor:
    """Returns the logarithm of depth in metres; unknown depth is that of a micrometre."""
    return depth.clamp_min(1e-6).log()
