"""A prior as log depth, the residuals of the points against it, and whether it is of use."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from model_zoo_defs._compact.cloud import Cloud
from model_zoo_defs._compact.points import Points, mean_and_std

# A prior is clamped to so much log depth from the median of the points.
PRIOR_RANGE = 4.0
# A prior is used if it lowers the leave-one-out error at the points by at least 1 %.
EXPLAINED = 0.99


@dataclass(frozen=True)
class Prior:
    """Another network's depth, and how the points differ from it."""

    value: Tensor
    """Log depth minus the median of the points (B, 1, H, W), 0 where unknown."""
    valid: Tensor
    """(B, 1, H, W), 1 where it is known, else 0."""
    weight: Tensor
    """Inlier weight of each of the n points, 0 where the prior is unknown."""
    residual: Tensor
    """Log depth of each of the n points minus the prior's, 0 where that is unknown."""
    moments: Tensor
    """Means over 2 x 2 pixels (B, 4, H / 2, W / 2), as `Points.moments`, of these residuals."""

    @classmethod
    def of(cls, depth: Tensor, points: Points, cloud: Cloud) -> Prior:
        """Returns the prior of a depth; one that does not explain its image's points is unknown.

        Args:
            depth: (B, 1, H, W) metres, aligned to the points, 0 where unknown.
            points: Points of the batch, with inlier weights.
            cloud: The same points with their neighbours.
        """
        known = (depth > 0) & torch.isfinite(depth)
        log_depth = torch.log(torch.where(known, depth, 1.0).to(torch.float32)) - points.median
        log_depth = log_depth.clamp(-PRIOR_RANGE, PRIOR_RANGE)
        residual = points.at(points.value) - points.at(log_depth)
        valid = known * explains(residual, points.at(known), points, cloud)
        at_points = points.at(valid)
        weight = points.at(points.weight) * at_points
        residual = residual * at_points
        moments = points.pooled([at_points, weight, weight * residual, weight * residual**2], 2)
        return cls(log_depth * valid, valid, weight, residual, moments)

    def at(self, stride: int) -> tuple[Tensor, Tensor]:
        """Returns value and validity (B, 1, h, w) at the middle of each cell of `stride` pixels."""
        start = stride // 2
        centres = (..., slice(start, None, stride), slice(start, None, stride))
        return self.value[centres], self.valid[centres]

    def hints(self, before: Tensor, stride: int) -> Tensor:
        """Returns what a level sees of the prior, (B, 4, h, w).

        In order: its value minus the depth so far, its validity, and mean and standard deviation of
        the points' residuals against it.

        Args:
            before: Log depth so far minus the median, (B, 1, h, w).
            stride: Side of the level's cells in pixels.
        """
        value, valid = self.at(stride)
        sums = F.avg_pool2d(self.moments, stride // 2) if stride > 2 else self.moments
        _, *of_residuals = sums.chunk(4, dim=1)
        return torch.cat([(value - before) * valid, valid, *mean_and_std(*of_residuals)], dim=1)


@torch.no_grad()
def explains(residual: Tensor, known: Tensor, points: Points, cloud: Cloud) -> Tensor:
    """Returns whether a prior helps to predict points from each other, 1 or 0, as (B, 1, 1, 1).

    Every point that sends messages is predicted from its neighbours, as their mean with weights of
    1 / squared distance times inlier weight: once its log depth, once its residual against the
    prior. 1 for an image without two neighbouring points.

    Args:
        residual: Log depth of the N points minus that of the prior (N,).
        known: Whether the prior is known there (N,).
        points: The points.
        cloud: The same points with their neighbours.
    """
    weight = points.at(points.weight)[cloud.chosen]
    near = cloud.near
    residual = residual[cloud.chosen]
    known = known[cloud.chosen]
    # Weights of each point's neighbours (n, NEIGHBOURS), which add up to 1 or are all 0.
    square = (cloud.position[near] - cloud.position.unsqueeze(1)).square().sum(2)
    share = cloud.found * known[near] * weight[near] / (square + 0.1)
    share = share / share.sum(1, keepdim=True).clamp(min=1e-6)
    # How much the error of each point counts: 0 of one that is not predicted.
    importance = cloud.sends * known * share.sum(1) * weight

    def error(value: Tensor) -> Tensor:
        """Returns the summed error (B,) of predicting a value (n,) of each point by the others."""
        per_point = importance * (value - (share * value[near]).sum(1)).abs()
        return torch.stack([image.sum() for image in torch.split(per_point, list(cloud.counts))])

    explained = error(residual) <= EXPLAINED * error(cloud.value)
    return explained.to(torch.float32).view(-1, 1, 1, 1)
