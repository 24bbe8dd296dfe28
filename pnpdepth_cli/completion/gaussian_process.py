"""A Gaussian process over the image that predicts the residual at the sparse points (kriging).

The residual r in log depth is a random field observed at the points,

    r(p) = β₀ + β₁·u(p) + f(p) + noise,   cov f(p), f(q) = exp(−|φ(p) − φ(q)|),

β₀ and β₁ normal with variances 100 and 1, u the predicted log depth. φ holds the position in the
image, u, and the colour in CIELAB, each divided by a length scale. So pixels that are near, look
alike and are predicted alike have about the same residual. An edge of the image or of the
prediction stops it. The mean of r anywhere, given the points, is

    mean = k·α,   α = (K + N)⁻¹ r,

K of all covariances among the points, k of those with p, N diagonal of the noise (Rasmussen and
Williams, "Gaussian Processes for Machine Learning", 2006, sections 2.2 and 2.7; universal kriging
in Cressie, "Statistics for Spatial Data", 1993, section 3.4). A few length scales are compared, and
those with the smallest leave-one-out error are taken. The error costs no more than solving once
(ibid., eq. 5.12).

With many points, each image block is predicted from its nearest points, all blocks at once. Two
layers of blocks, half a block apart, are blended so that no seam is seen.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.completion.residual_field import Kernel, ResidualField
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_pattern

CONSTANT, SLOPE = 100.0, 1.0
"""Variances of β₀ and β₁, in units of the variance of f."""
LENGTHS_DEPTH = (1.0, 2.5, 8.0, 25.0)
LENGTHS_COLOUR = (2.5, 8.0, 25.0)
NOISES = (1e-4, 1e-3, 1e-2, 1.0)
"""Length scales in standard deviations over the image (of the position, in longer sides: 1), and
variance of the noise. Chosen on rendered frames with predictions of three networks; the longest
lengths and the least and most noise are there for frames unlike those."""
NEIGHBOURS = 48
"""Points that predict a block, or a single pixel, where there are many points."""
MIN_POINTS = 5
"""Fewer points do not determine the length scales."""

_MAX_EXACT = 128  # points up to which all of them predict every pixel,
_MAX_EXACT_SMALL = 256  # and up to which they do where the image is small:
_MAX_EXACT_PRODUCT = 40_000_000  # points × pixels
_AT_ONCE = 1 << 19  # covariances computed at once: what bounds the memory
_NEIGHBOURHOODS = 24  # in which the length scales are tried, when there are many points,
_INNER = 16  # and points of each that are left out: the middle ones
_IN_BLOCK = 3  # a block contains at most 1/3 of the points that predict it,
_MIN_BLOCK = 8  # pixels, a block's side
_WORTH_A_GRID = 1 << 16  # pixels; for fewer, every pixel is predicted
_NODES_BETWEEN = 6  # nodes of the grid between two points,
_NODES_BETWEEN_LINES = 2  # or rows of nodes between two scan lines,
_MAX_STEP = 4  # and most pixels between two nodes: on real frames as good as every pixel
_CROWDED = 0.05  # except for this fraction of all points
_MIN_SCORED_WEIGHT = 1e-6  # the weight of a point that predicts nothing


def fit(field: ResidualField) -> ResidualField:
    """Returns the field with the kernel of smallest leave-one-out error.

    The length scales are chosen first, then the noise: on rendered frames as good as all together.
    With fewer than 5 points the kernel stays.
    """
    if len(field.points) < MIN_POINTS:
        return field
    near = neighbourhoods(field, _MAX_EXACT)

    def error(kernel: Kernel) -> float:
        errors, _ = leave_one_out(replace(field, kernel=kernel), near)
        return float(errors.abs().mean())

    colours = LENGTHS_COLOUR if field.at.shape[1] > 3 else LENGTHS_COLOUR[:1]
    lengths = [Kernel(depth=d, colour=c) for d, c in product(LENGTHS_DEPTH, colours)]
    best = min(lengths, key=error)
    noises = [replace(best, noise=noise) for noise in NOISES if noise != best.noise]
    return replace(field, kernel=min([best, *noises], key=error))


def predict(field: ResidualField) -> Tensor:
    """Returns the mean residual (H, W) float32 at every pixel.

    It is smooth where the prediction is not, so that it is predicted on a coarser grid.
    """
    size = field.points.size
    rows, columns = _steps(field.points)
    if rows == columns == 1:
        return _predict_grid(field)
    coarse = (max(1, round(size[0] / rows)), max(1, round(size[1] / columns)))
    features = F.interpolate(torch.stack(field.features)[None], coarse, mode="area")[0]
    grid = replace(field, features=features.unbind(), points=field.points.resized(*coarse))
    values = _predict_grid(grid)[None, None]
    return F.interpolate(values, size, mode="bilinear", align_corners=False)[0, 0]


def predict_at(field: ResidualField, xy: Tensor, features: Tensor) -> Tensor:
    """Returns the mean residual (M,) at single pixels.

    Args:
        xy: (M, 2) pixel coordinates.
    """
    if _is_exact(field) or len(field.points) <= NEIGHBOURS:
        return _solve(field, _all_points(field), features[None])[0]
    _, near = nearest_points(field.points, xy.double(), NEIGHBOURS)
    return _solve(field, near, features[:, None])[:, 0]


def leave_one_out(
    field: ResidualField, near: Tensor, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Returns error and variance (B, ≤ k) at points predicted from their neighbourhood's others.

    Computed without solving again: Rasmussen and Williams, eq. 5.12.

    Args:
        near: (B, k) numbers of points of each neighbourhood.
        weight: (N,) 0…1 of each point as a predictor; one of 0 predicts nothing.
    """
    _, _, system = _systems(field, near)
    weight = torch.ones_like(field.residual) if weight is None else weight
    extra_noise = field.kernel.noise * (weight[near].clamp_min(_MIN_SCORED_WEIGHT) ** -2 - 1)
    system.diagonal(dim1=1, dim2=2).add_(extra_noise)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(system))
    variance = 1 / inverse.diagonal(dim1=1, dim2=2)
    error = (inverse @ field.residual[near][..., None])[..., 0] * variance
    inner = _INNER if near.shape[0] > 1 else None
    return error[:, :inner], (variance - extra_noise)[:, :inner]


def neighbourhoods(field: ResidualField, max_exact: int) -> Tensor:
    """Returns (B, k) numbers of points near each other, the middle one first.

    One neighbourhood of all points, up to `max_exact` of them.
    """
    count = len(field.points)
    if count <= max_exact:
        return _all_points(field)
    middles = torch.linspace(0, count - 1, _NEIGHBOURHOODS).long()
    _, near = nearest_points(field.points, field.points.xy[middles].double(), NEIGHBOURS)
    return near


def _steps(points: SparsePoints) -> tuple[int, int]:
    """Rows and columns between the nodes of the grid on which the residual is predicted.

    Between scan lines, which lie along rows, the rows of nodes may be farther apart.
    """
    if points.size[0] * points.size[1] < _WORTH_A_GRID:
        return 1, 1
    spacing = math.sqrt(points.size[0] * points.size[1] / len(points))
    step = min(_MAX_STEP, max(1, int(spacing / _NODES_BETWEEN)))
    pattern = scan_pattern(points.xy, points.size)
    if pattern is None:
        return step, step
    return min(_MAX_STEP, max(step, int(pattern.across_px / _NODES_BETWEEN_LINES))), step


def _predict_grid(field: ResidualField) -> Tensor:
    """The same, predicted at every pixel of the field's features."""
    height, width = field.points.size
    if _is_exact(field):
        queries = torch.stack(field.features, dim=-1).reshape(1, height * width, -1)
        return _solve(field, _all_points(field), queries).reshape(height, width)
    side = _block_side(field.points)
    layers = [_predict_blocks(field, side, shift) for shift in (0, side // 2)]
    total = layers[0][1] + layers[1][1]
    return sum((values * (weight / total) for values, weight in layers), torch.zeros(()))


def _solve(field: ResidualField, near: Tensor, queries: Tensor) -> Tensor:
    """(B, Q) float32: the mean at B × Q features, from points near (B, k)."""
    (blocks, count), per_block = near.shape, queries.shape[1]
    result = queries.new_empty(blocks, per_block)
    many = max(1, _AT_ONCE // (per_block * count))
    step = max(1, _AT_ONCE // (many * count))
    for first in range(0, blocks, many):
        some = slice(first, first + many)
        at, u, system = _systems(field, near[some])
        factor = torch.linalg.cholesky(system)
        alpha = torch.cholesky_solve(field.residual[near[some]][..., None], factor)
        beta = torch.stack([CONSTANT * alpha[..., 0].sum(1), SLOPE * (u * alpha[..., 0]).sum(1)])
        for start in range(0, per_block, step):
            part = queries[some, start : start + step]
            k = _covariance(field.kernel.scaled(part), at.float())
            mean = (k @ alpha.float())[..., 0] + beta.float()[0, :, None]
            result[some, start : start + step] = mean + beta.float()[1, :, None] * part[..., 2]
    return result


def _systems(field: ResidualField, near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Scaled features, u, and the covariances of r, of points near (B, k)."""
    at = field.at[near].double()
    scaled, u = field.kernel.scaled(at), at[..., 2]
    system = _covariance(scaled, scaled).double()
    system.baddbmm_(u[:, :, None], u[:, None, :], alpha=SLOPE).add_(CONSTANT)
    system.diagonal(dim1=1, dim2=2).add_(field.kernel.noise)
    return scaled, u, system


def _covariance(a: Tensor, b: Tensor) -> Tensor:
    """exp(−|a − b|) (B, Q, k) float32 of a (B, Q, F) and b (B, k, F)."""
    middle = b.mean(dim=1, keepdim=True)  # small numbers, so that the squares cancel well
    a, b = a - middle, b - middle
    squares = torch.baddbmm(b.square().sum(dim=2)[:, None, :], a, b.transpose(1, 2), alpha=-2)
    squares += a.square().sum(dim=2)[:, :, None]
    closeness: Tensor = squares.float().clamp_min_(0).sqrt_().neg_().exp_()
    return closeness


def _all_points(field: ResidualField) -> Tensor:
    return torch.arange(len(field.points))[None]


def _is_exact(field: ResidualField) -> bool:
    """Whether every pixel is predicted from all points."""
    count, (height, width) = len(field.points), field.points.size
    small = count <= _MAX_EXACT_SMALL and count * height * width <= _MAX_EXACT_PRODUCT
    return small or count <= _MAX_EXACT


def _predict_blocks(field: ResidualField, side: int, shift: int) -> tuple[Tensor, Tensor]:
    """(H, W): the mean, predicted block by block, and the pixels' weights.

    Blocks of side × side pixels, the first of which begins `shift` pixels before the image. A
    pixel's weight is its distance to the edge of its block.
    """
    height, width = field.points.size
    rows, columns = (math.ceil((n + shift) / side) for n in (height, width))
    padding = (shift, columns * side - shift - width, shift, rows * side - shift - height)
    padded = F.pad(torch.stack(field.features)[None], padding, mode="replicate")[0]
    blocks = padded.reshape(-1, rows, side, columns, side).permute(1, 3, 2, 4, 0)
    middles = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).flip(1).double()
    _, near = nearest_points(field.points, (middles + 0.5) * side - 0.5 - shift, NEIGHBOURS)
    values = _solve(field, near, blocks.reshape(rows * columns, side * side, -1))
    values = values.reshape(rows, columns, side, side).permute(0, 2, 1, 3)
    values = values.reshape(rows * side, columns * side)
    position = torch.arange(float(side)) + 0.5
    inside = torch.minimum(position, side - position)
    y, x = (inside.repeat(n)[shift:] for n in (rows, columns))
    weight = torch.minimum(y[:height, None], x[None, :width])
    return values[shift : shift + height, shift : shift + width], weight


def _block_side(points: SparsePoints) -> int:
    """The largest side in pixels for which nearly no block has too many points."""
    side = max(points.size)
    x, y = points.xy.unbind(1)
    while side > _MIN_BLOCK:
        cell = (y / side).floor().clamp_min(0) * points.size[1] + (x / side).floor().clamp_min(0)
        count = torch.bincount(cell.long())
        crowded = count[count > NEIGHBOURS / _IN_BLOCK].sum()
        if float(crowded) <= _CROWDED * len(points):
            break
        side = max(_MIN_BLOCK, round(side / 1.4))
    return side
