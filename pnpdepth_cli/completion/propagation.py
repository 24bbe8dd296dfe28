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
from pnpdepth_cli.completion.gaussian_process import LOG_DEPTH, Residuals
from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.points import SparsePoints

# The lines were chosen on rendered frames, with predictions of three networks and a synthetic one.
NEIGHBOURS = 12
"""Points that a line is fitted to."""
POWER = 3.0
"""Power of the distance by which a point counts less."""
RIDGE = 0.03
"""Against the variance of x among the points of a pixel, in units of its variance among all."""
_LINES = 400_000
"""Lines that are fitted at most; with more pixels, lines are interpolated."""
_AT_A_POINT_PX = 0.5
"""Pixels; closer than this, a point is as close as can be."""
_OUTLIER_WEIGHT = 1e-6
"""What an outlier counts where no other point is near."""


def local_lines(
    points: SparsePoints,
    xy: Tensor | None,
    residual: Tensor,
    regressor: Tensor,
    inlier_weight: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns shift and slope of the line residual = shift + slope · regressor around each pixel.

    The line is fitted to the pixel's nearest points. Both are (H, W) float64, or (M,) at
    coordinates.

    Args:
        points: The N points.
        xy: Pixel coordinates (M, 2) around which lines are wanted. None: every pixel.
        residual: Residual (N,) float64 at the points, of any unit.
        regressor: Quantity (N,) float64 at the points over which lines run, such as the predicted
            log depth, of standard deviation 1.
        inlier_weight: Weight (N,) 0…1 of each point.
    """
    if xy is not None:
        return _lines_at(xy.cpu().double(), points, residual, regressor, inlier_weight)
    # Lines around the nodes of a grid, which are interpolated where it has fewer than pixels.
    height, width = points.size
    step = math.ceil(math.sqrt(height * width / _LINES))
    rows = _nodes(height, step)
    columns = _nodes(width, step)
    nodes = torch.cartesian_prod(rows, columns).flip(1)  # x, y
    lines = torch.stack(_lines_at(nodes, points, residual, regressor, inlier_weight))
    lines = lines.reshape(1, 2, len(rows), len(columns))
    if step > 1:  # the outer nodes are at the corners
        lines = F.interpolate(lines, points.size, mode="bilinear", align_corners=True)
    return lines[0, 0], lines[0, 1]


def _nodes(length: int, step: int) -> Tensor:
    """Coordinates from 0 to length − 1, evenly spaced by at most `step` pixels, float64."""
    count = math.ceil((length - 1) / step) + 1
    return torch.linspace(0, length - 1, count, dtype=torch.float64)


def _lines_at(
    nodes: Tensor, points: SparsePoints, residual: Tensor, regressor: Tensor, inlier_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Shift and slope, (M,) each, of the line around each of M nodes, by weighted least squares.

    Args:
        nodes: (M, 2) pixel coordinates of the nodes, float64.
        points: The N points.
        residual: (N,) float64 quantity at the points that the lines give.
        regressor: (N,) float64 quantity at the points over which the lines run.
        inlier_weight: (N,) weight 0…1 of each point.
    """
    distance, near = nearest_points(points, nodes, min(NEIGHBOURS, len(points)))
    closeness = distance.clamp_min(_AT_A_POINT_PX).pow(-POWER)
    weight = closeness * (inlier_weight[near] + _OUTLIER_WEIGHT)
    weight = weight / weight.sum(dim=1, keepdim=True)
    # Weighted least squares with a ridge, of all nodes at once: (M, neighbours) each.
    x = regressor[near]
    y = residual[near]
    mean_x = (weight * x).sum(dim=1, keepdim=True)
    mean_y = (weight * y).sum(dim=1, keepdim=True)
    covariance = (weight * (x - mean_x) * (y - mean_y)).sum(dim=1, keepdim=True)
    variance = (weight * (x - mean_x).square()).sum(dim=1, keepdim=True)
    slope = covariance / (variance + RIDGE)
    return (mean_y - slope * mean_x)[:, 0], slope[:, 0]


def by_lines(residuals: Residuals, queries: SparsePoints | None = None) -> Tensor:
    """Returns the residual by local lines over the predicted log depth, through the points.

    It is (H, W) float32 at every pixel, or (M,) at the coordinates of M queries.
    """
    log_depth = residuals.features[LOG_DEPTH]
    xy = None
    if queries is not None:
        log_depth = queries.sample(log_depth)
        xy = queries.xy
    at_points = residuals.point_features[:, LOG_DEPTH].double()
    weights = torch.ones_like(residuals.residual)
    shift, slope = local_lines(residuals.points, xy, residuals.residual, at_points, weights)
    return (shift + slope * log_depth).float()


def by_gaussian_process(residuals: Residuals, queries: SparsePoints | None = None) -> Tensor:
    """Returns the mean residual of the Gaussian process whose kernel fits the points best.

    It is (H, W) float32 at every pixel, or (M,) at the coordinates of M queries.
    """
    return gaussian_process.predict(residuals.fitted, queries)
