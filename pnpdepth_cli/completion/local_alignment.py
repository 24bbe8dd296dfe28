"""A network's depth brought to the points by a line of its own in every part of the picture.

A global alignment reads the network's numbers as a·x + b everywhere; here a and b change over the
picture, from the points around each place:

    min over a, b of  Σ_i w_i·(y_i − a·x_i − b)² + ridge·(a − a_global)²,   w_i = 1 / distance_i³

over the points nearest to the place, y their depth and x the globally aligned prediction. Moving
least squares (Lancaster and Salkauskas 1981) of the depth against the prediction, as in locally
weighted alignment of monocular depth (Xu et al. 2022), but with weights that go through the
points instead of a bandwidth: that was far better on rendered frames from 20 points to LiDAR.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion.alignment import align, to_space, where_predicted
from pnpdepth_cli.completion.interpolation import distinct, nearest_points
from pnpdepth_cli.completion.outliers import inlier_weights
from pnpdepth_cli.points import SparsePoints

# Chosen on rendered frames, with predictions of three networks and of a synthetic one.
NEIGHBOURS = 12
POWER = 3.0
RIDGE = 0.03
"""Against the variance of x among the points of a place, in units of its variance among all."""

_NODES = 400_000  # places with a line of their own; with more pixels the lines are interpolated
_AT_A_POINT = 0.5  # pixels; closer than this, a point is as close as can be
_OUTLIER_WEIGHT = 1e-6  # what an outlier counts where no other point is near


def locally_aligned(
    prediction: Tensor, points: SparsePoints, places: Tensor | None = None, *, space: str = "depth"
) -> Tensor:
    """Depth (H, W) float32: the prediction, near points as they say, else as the network has it.

    prediction: (H, W) depth, metric or not; what is not positive and finite is unknown, and so is
    the result there (0). places: (M, 2) pixel coordinates where the depth (M,) is wanted, in place
    of all pixels. space: in which of `alignment.SPACES` the lines are fitted. Never nearer or
    farther than a global alignment's bounds. NoPointsError if no point has a prediction.
    """
    device, prediction, points = prediction.device, prediction.detach().cpu(), points.tensors()
    known, points = where_predicted(prediction, points)
    points = distinct(points)
    x = to_space(torch.where(known, prediction, 1.0).double(), space)
    made = align(points.sample(x), points, (space,), "auto")
    start, reading = made.scale * x + made.shift, replace(made, scale=1.0, shift=0.0)
    at_points = points.sample(start)
    std = at_points.std(correction=0) + 1e-9 * at_points.abs().mean()
    z, z_at_points = ((y - at_points.mean()) / std for y in (start, at_points))
    residual = to_space(points.depth.double(), space) - at_points
    weights = inlier_weights(points, points.depth.double().log() - reading.depth(at_points).log())
    if places is not None:
        there = SparsePoints(xy=places.cpu(), depth=torch.ones(len(places)), size=points.size)
        known = there.sample(torch.where(known, 1.0, torch.nan)).isfinite()
        start, z = there.sample(start), there.sample(z)
    shift, slope = _lines(points, places, residual, z_at_points, weights)
    depth = reading.depth(start + shift + slope * z)
    return torch.where(known, depth, 0.0).float().to(device)


def _lines(
    points: SparsePoints, places: Tensor | None, residual: Tensor, z: Tensor, inlier_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Shift and slope of the line through residual (N,) over z (N,) around every place or pixel."""
    if places is not None:
        return _lines_at(places.double().cpu(), points, residual, z, inlier_weight)
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
    weight = distance.clamp_min(_AT_A_POINT).pow(-POWER)
    weight = weight / weight.sum(dim=1, keepdim=True) * (inlier_weight[near] + _OUTLIER_WEIGHT)
    weight = weight / weight.sum(dim=1, keepdim=True)
    z, residual = z[near], residual[near]
    mean_z, mean = ((weight * v).sum(dim=1, keepdim=True) for v in (z, residual))
    slope = (weight * (z - mean_z) * (residual - mean)).sum(dim=1, keepdim=True) / (
        (weight * (z - mean_z).square()).sum(dim=1, keepdim=True) + RIDGE
    )
    return (mean - slope * mean_z)[:, 0], slope[:, 0]
