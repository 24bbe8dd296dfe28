"""Lines around every pixel, fitted to its nearest points.

    min over a, b of  Σ_i w_i·(y_i − a·x_i − b)² + ridge·a²,   w_i = 1 / distance_i³

y is a residual at the points and x the prediction there. These are moving least squares (Lancaster
and Salkauskas 1981) of the depth against the prediction, as in locally weighted alignment of
monocular depth (Xu et al. 2022). Instead of a bandwidth, the weights make the lines go through the
points, which was far better on rendered frames from 20 points to LiDAR.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.points import SparsePoints

# Chosen on rendered frames, with predictions of three networks and of a synthetic one.
NEIGHBOURS = 12
POWER = 3.0
RIDGE = 0.03
"""Against the variance of x among the points of a pixel, in units of its variance among all."""

_NODES = 400_000  # lines that are fitted; with more pixels, lines are interpolated
_AT_A_POINT = 0.5  # pixels; closer than this, a point is as close as can be
_OUTLIER_WEIGHT = 1e-6  # what an outlier counts where no other point is near


def local_lines(
    points: SparsePoints, xy: Tensor | None, residual: Tensor, z: Tensor, inlier_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns shift and slope, (H, W) each, of the line around every pixel.

    Args:
        points: N points.
        xy: (M, 2) pixel coordinates around which lines (M,) are wanted. None: every pixel.
        residual: (N,) y at the points.
        z: (N,) x at the points, in units of its standard deviation.
        inlier_weight: (N,) 0…1.
    """
    if xy is not None:
        return _lines_at(xy.double().cpu(), points, residual, z, inlier_weight)
    height, width = points.size
    step = math.ceil(math.sqrt(height * width / _NODES))
    rows, columns = (
        torch.linspace(0, n - 1, math.ceil((n - 1) / step) + 1, dtype=torch.float64)
        for n in points.size
    )
    nodes = torch.cartesian_prod(rows, columns).flip(1)
    lines = torch.stack(_lines_at(nodes, points, residual, z, inlier_weight))
    lines = lines.reshape(1, 2, len(rows), len(columns))
    if step > 1:
        lines = F.interpolate(lines, points.size, mode="bilinear", align_corners=True)
    return lines[0, 0], lines[0, 1]


def _lines_at(
    nodes: Tensor, points: SparsePoints, residual: Tensor, z: Tensor, inlier_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """The same, (M,), around nodes (M, 2)."""
    distance, near = nearest_points(points, nodes, min(NEIGHBOURS, len(points)))
    weight = distance.clamp_min(_AT_A_POINT).pow(-POWER) * (inlier_weight[near] + _OUTLIER_WEIGHT)
    weight = weight / weight.sum(dim=1, keepdim=True)
    z, residual = z[near], residual[near]
    mean_z, mean = ((weight * v).sum(dim=1, keepdim=True) for v in (z, residual))
    slope = (weight * (z - mean_z) * (residual - mean)).sum(dim=1, keepdim=True) / (
        (weight * (z - mean_z).square()).sum(dim=1, keepdim=True) + RIDGE
    )
    return (mean - slope * mean_z)[:, 0], slope[:, 0]
