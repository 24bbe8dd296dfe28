"""Ways to predict the residual everywhere from the residual at the points (`--propagate`).

They are the entries of `choices.PROPAGATIONS`; `completion.residual_field` calls
them with the residuals at the inliers. "gp" is in `completion.gaussian_process`. "local" fits lines
over the predicted log depth:

    min over a, b of  Σ_i w_i·(y_i − a·x_i − b)² + ridge·a²,   w_i = 1 / distance_i³

around every pixel, to its nearest points. y is a residual at the points and x the prediction there.
These are moving least squares (Lancaster and Salkauskas 1981) of the depth against the prediction,
as in locally weighted alignment of monocular depth (Xu et al. 2022). Instead of a bandwidth, the
weights make the lines go through the points, which was far better on rendered frames from 20 points
to LiDAR.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion import gaussian_process
from pnpdepth_cli.completion.gaussian_process import DEPTH, Residuals
from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.points import SparsePoints

# The lines were chosen on rendered frames, with predictions of three networks and a synthetic one.
NEIGHBOURS = 12
"""Points that a line is fitted to."""
POWER = 3.0
"""Power of the distance by which a point counts less."""
RIDGE = 0.03
"""Against the variance of x among the points of a pixel, in units of its variance among all."""
_LINES = 400_000  # that are fitted; with more pixels, lines are interpolated
_AT_A_POINT = 0.5  # pixels; closer than this, a point is as close as can be
_OUTLIER_WEIGHT = 1e-6  # what an outlier counts where no other point is near


def local_lines(
    points: SparsePoints, xy: Tensor | None, residual: Tensor, z: Tensor, inlier_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns shift and slope, (H, W) each, of the line around every pixel.

    Args:
        xy: (M, 2) pixel coordinates around which lines (M,) are wanted. None: every pixel.
        residual: (N,) y at the points.
        z: (N,) x at the points, in units of its standard deviation.
        inlier_weight: (N,) 0…1.
    """
    if xy is not None:
        return _lines_at(xy.cpu().double(), points, residual, z, inlier_weight)
    # Lines around the nodes of a grid, which are interpolated where it has fewer than pixels.
    height, width = points.size
    step = math.ceil(math.sqrt(height * width / _LINES))
    rows, columns = (
        torch.linspace(0, side - 1, math.ceil((side - 1) / step) + 1, dtype=torch.float64)
        for side in (height, width)
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
    """Shift and slope, (M,) each, of the lines around nodes (M, 2); see `local_lines`."""
    distance, near = nearest_points(points, nodes, min(NEIGHBOURS, len(points)))
    weight = distance.clamp_min(_AT_A_POINT).pow(-POWER) * (inlier_weight[near] + _OUTLIER_WEIGHT)
    weight = weight / weight.sum(dim=1, keepdim=True)
    # Weighted least squares with a ridge, of all nodes at once.
    z, residual = z[near], residual[near]
    mean_z = (weight * z).sum(dim=1, keepdim=True)
    mean_residual = (weight * residual).sum(dim=1, keepdim=True)
    covariance = (weight * (z - mean_z) * (residual - mean_residual)).sum(dim=1, keepdim=True)
    variance = (weight * (z - mean_z).square()).sum(dim=1, keepdim=True)
    slope = covariance / (variance + RIDGE)
    return (mean_residual - slope * mean_z)[:, 0], slope[:, 0]


def by_lines(residuals: Residuals, queries: SparsePoints | None = None) -> Tensor:
    """Returns the residual, (H, W) or (M,) float32, by lines over the predicted log depth."""
    log_depth = residuals.features[DEPTH]
    xy = None
    if queries is not None:
        log_depth = queries.sample(log_depth)
        xy = queries.xy
    at_points = residuals.point_features[:, DEPTH].double()
    weights = torch.ones_like(residuals.residual)
    shift, slope = local_lines(residuals.points, xy, residuals.residual, at_points, weights)
    return (shift + slope * log_depth).float()


def by_gaussian_process(residuals: Residuals, queries: SparsePoints | None = None) -> Tensor:
    """Returns the mean residual, (H, W) or (M,), of a Gaussian process that fits the points."""
    return gaussian_process.predict(residuals.fitted, queries)
