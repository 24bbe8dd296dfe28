"""A prior as log depth, the residuals of the points against it, and whether it is of use."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from model_zoo_defs._compact.cloud import Cloud
from model_zoo_defs._compact.points import Points, mean_and_std

# a prior further than this from the median, in log depth, is clamped
PRIOR_RANGE = 4.0
# A prior is used if it lowers the leave-one-out error at the points by at least 1 %.
EXPLAINED = 0.99


@dataclass(frozen=True)
class Prior:
    """A dense depth in the units of `Points`, 0 where unknown, and where it is known.

    value, valid: (B, 1, H, W). weight, residual: of the points against the prior (n,), 0 where it
    is unknown. moments: their sums over 2 x 2 pixels (B, 4, H / 2, W / 2).
    """

    value: Tensor
    valid: Tensor
    weight: Tensor
    residual: Tensor
    moments: Tensor

    @classmethod
    def of(cls, depth: Tensor, points: Points, cloud: Cloud) -> Prior:
        """The prior of a depth (B, 1, H, W) in metres, 0 where unknown.

        One that does not explain the points of its image is unknown everywhere.
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
        """Value and validity at the centre pixels of the cells of `stride` pixels."""
        start = stride // 2
        part = (..., slice(start, None, stride), slice(start, None, stride))
        return self.value[part], self.valid[part]

    def hints(self, before: Tensor, stride: int) -> Tensor:
        """Value relative to `before`, validity, residual and std (B, 4, h, w) of a level."""
        value, valid = self.at(stride)
        sums = F.avg_pool2d(self.moments, stride // 2) if stride > 2 else self.moments
        _, *of_residuals = sums.chunk(4, dim=1)
        return torch.cat([(value - before) * valid, valid, *mean_and_std(*of_residuals)], dim=1)


@torch.no_grad()
def explains(residual: Tensor, known: Tensor, points: Points, cloud: Cloud) -> Tensor:
    """Whether a prior lowers the leave-one-out error at the points, 0 or 1 (B, 1, 1, 1).

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
    residual, known = residual[cloud.chosen], known[cloud.chosen]
    square = (cloud.position[near] - cloud.position.unsqueeze(1)).square().sum(2)
    share = cloud.found * known[near] * weight[near] / (square + 0.1)
    share = share / share.sum(1, keepdim=True).clamp(min=1e-6)
    predicted = cloud.sends * known * share.sum(1) * weight

    def error(value: Tensor) -> Tensor:
        per_point = predicted * (value - (share * value[near]).sum(1)).abs()
        return torch.stack([image.sum() for image in torch.split(per_point, list(cloud.counts))])

    explained = error(residual) <= EXPLAINED * error(cloud.value)
    return explained.to(torch.float32).view(-1, 1, 1, 1)
