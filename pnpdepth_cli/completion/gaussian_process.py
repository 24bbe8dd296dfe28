"""A Gaussian process over the image that predicts the residual at the sparse points (kriging).

The residual r = log measured depth − log predicted depth is a random field observed at the points,

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

import functools
import math
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion.alignment import where_predicted
from pnpdepth_cli.completion.interpolation import distinct, nearest_points
from pnpdepth_cli.points import SparsePoints, in_frame
from pnpdepth_cli.scan_pattern import scan_pattern

CONSTANT = 100.0
"""Variance of β₀, in units of the variance of f."""
SLOPE = 1.0
"""Variance of β₁, in the same units."""

# What is compared was chosen on rendered frames with predictions of three networks; the longest
# lengths and the least and most noise are there for frames unlike those. The length scale of the
# position is 1 longer side of the image.
LENGTHS_DEPTH = (1.0, 2.5, 8.0, 25.0)
"""Length scales of u, in standard deviations over the image."""
LENGTHS_COLOUR = (2.5, 8.0, 25.0)
"""Length scales of the colour, in standard deviations over the image."""
NOISES = (1e-4, 1e-3, 1e-2, 1.0)
"""Variances of the noise, in units of the variance of f."""
NEIGHBOURS = 48
"""Points that predict a block, or a single pixel, where there are many points."""
MIN_POINTS = 5
"""Fewer points do not determine the length scales."""

# Whether all points predict every pixel.
_MAX_EXACT = 128  # points up to which they do
_MAX_EXACT_SMALL = 256  # points up to which they do in a small image
_MAX_EXACT_PRODUCT = 40_000_000  # points × pixels up to which an image is small
_AT_ONCE = 1 << 19  # covariances computed at once, which bounds the memory

# How the kernel of many points is chosen.
_NEIGHBOURHOODS = 24  # neighbourhoods whose points are left out one by one
_INNER = 16  # points in the middle of each that are left out
_MIN_SCORED_WEIGHT = 1e-6  # weight that stands for 0, whose noise would be infinite

# The blocks of pixels that are predicted from the same points.
_IN_BLOCK = 3  # a block with more than 1/3 of the points that predict it is crowded
_CROWDED = 0.05  # fraction of all points that crowded blocks may have
_MIN_BLOCK_PX = 8  # least side of a block
_BLOCK_SHRINKS = 1.4  # factor between sides that are tried

# The grid on which the residual is predicted.
_WORTH_A_GRID = 1 << 16  # pixels from which on there is one; of fewer, every pixel is predicted
_NODES_BETWEEN = 6  # nodes between two points
_NODES_BETWEEN_LINES = 2  # rows of nodes between two scan lines
_MAX_STEP_PX = 4  # most from node to node: on real frames as good as every pixel

LOG_DEPTH = 2
"""Index of the predicted log depth among the features."""
_FLAT_DEPTH = 1e-3  # added to the standard deviation of log depth: a flat one has no edges
_FLAT_COLOUR = 1.0  # added to the standard deviation of CIELAB: a plain image has no edges
_LEAST_XYZ = 1e-6  # of which the cube root is taken: below it is not used, and below 0 is NaN
_XYZ_OF_RGB = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)  # IEC 61966-2-1


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """The residual at N points of an image, and the kernel of its Gaussian process.

    The residual is log measured − log predicted depth. The kernel is the covariance of two places
    by their features; `gaussian_process.fit` chooses its numbers.
    """

    features: Tensor
    """(3 or 6, H, W) features of every pixel, see `features_of`."""
    points: SparsePoints
    """The points at pixel coordinates of the image, on the CPU."""
    point_features: Tensor
    """(N, 3 or 6) features at the points."""
    residual: Tensor
    """(N,) float64 residual at the points."""
    depth_length: float = 2.5
    """Length scale of the predicted log depth, in standard deviations over the image."""
    colour_length: float = 8.0
    """Length scale of the colour, in standard deviations over the image."""
    noise: float = 1e-3
    """Variance of the noise, in units of the variance of the Gaussian process."""

    @functools.cached_property
    def fitted(self) -> Residuals:
        """The same residuals with the kernel of smallest leave-one-out error."""
        return fit(self)

    @functools.cached_property
    def leave_one_out_error(self) -> float:
        """The mean |error| of log depth at points, each predicted from the others."""
        error, _ = leave_one_out(self.fitted, neighbourhoods(self, _MAX_EXACT))
        return float(error.abs().mean())

    def scaled(self, features: Tensor) -> Tensor:
        """Returns features (..., 3 or 6) divided by their length scales."""
        lengths = [1.0, 1.0, self.depth_length]  # of x, y and log depth
        colours = features.shape[-1] - len(lengths)  # 3, or 0 without an image
        lengths += [self.colour_length] * colours
        return features / features.new_tensor(lengths)

    def select(self, mask: Tensor) -> Residuals:
        """Returns the residuals at only the points where mask, (N,) bool, is true."""
        return replace(
            self,
            points=self.points.select(mask),
            point_features=self.point_features[mask],
            residual=self.residual[mask],
        )


def residuals_of(prediction: Tensor, points: SparsePoints, rgb: Tensor | None) -> Residuals:
    """Returns log measured − log predicted depth at the points in the image with a prediction.

    The features of the image and the default kernel of a Gaussian process come with it. Of several
    points at the same coordinates the one of least depth counts.

    Args:
        prediction: Depth (H, W) in metres; not positive or not finite is unknown.
        points: The points, in pixels of the image.
        rgb: Image (3, H, W) in 0…1; None: colour is no feature.

    Raises:
        NoPointsError: No point has a prediction.
    """
    prediction = prediction.detach().cpu()
    # The points that count. Those on the right and the bottom edge of the image are inside, too.
    points = points.tensors()
    inside = in_frame(points.xy, points.size, closed=True)
    known, points = where_predicted(prediction, points.where(inside))
    points = distinct(points)
    # The features, and the residual at the points.
    log_depth = torch.where(known, prediction, torch.nan).log()
    features = features_of(log_depth, None if rgb is None else rgb.cpu())
    predicted = points.sample(torch.where(known, prediction, 1.0)).double()
    return Residuals(
        features=features,
        points=points,
        point_features=_sample(features, points),
        residual=points.depth.double().log() - predicted.log(),
    )


def features_of(log_depth: Tensor, rgb: Tensor | None) -> Tensor:
    """Returns the features (3 or 6, H, W) float32 by which pixels are near or alike.

    They are x, y, predicted log depth and, with an image, the three of CIELAB. x and y are in units
    of the longer side; depth and colour in standard deviations over the image.

    Args:
        log_depth: Predicted log depth (H, W), NaN where unknown.
        rgb: Image (3, H, W) in 0…1, or None.
    """
    height, width = log_depth.shape
    x = torch.arange(float(width)) / max(height, width)
    y = torch.arange(float(height)) / max(height, width)
    # u: known log depth, of mean 0 and standard deviation 1; 0 where it is unknown.
    known = log_depth.isfinite()
    known_values = log_depth if bool(known.all()) else log_depth[known]  # picking pixels is slow
    known_values = known_values.double().flatten()
    # The standard deviation by a dot product, which is faster than `Tensor.std`.
    mean = known_values.mean()
    mean_square = known_values.dot(known_values) / len(known_values)
    std = (mean_square - mean.square()).clamp_min(0).sqrt()
    u = torch.where(known, (log_depth - mean) / (std + _FLAT_DEPTH), 0.0)
    maps = [x.expand(height, width), y[:, None].expand(height, width), u.float()]
    if rgb is not None:
        maps.extend(_colour(rgb))
    return torch.stack(maps)


def _sample(features: Tensor, points: SparsePoints) -> Tensor:
    """The features (N, 3 or 6) at the coordinates of the points."""
    return torch.stack([points.sample(feature) for feature in features], dim=1)


@functools.lru_cache(maxsize=2)
def _colour(rgb: Tensor) -> Tensor:
    """CIELAB (3, H, W) of an image (3, H, W), of mean 0 and standard deviation about 1.

    The standard deviation is the root of the sum of the three variances over the image.

    Remembered for the last two images, by identity: a frame's, whose residuals are propagated
    several times, and a grey one.
    """
    lab = cielab(rgb)
    lab = lab - lab.mean(dim=(1, 2), keepdim=True)
    return lab / (lab.square().sum(dim=0).mean().sqrt() + _FLAT_COLOUR)


def cielab(rgb: Tensor) -> Tensor:
    """Returns (3, H, W) CIELAB (CIE 1976, white D65) of an sRGB image (3, H, W) in 0…1."""
    # Linear light; the numbers are those of sRGB (IEC 61966-2-1).
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055).clamp_min(0) ** 2.4)
    # XYZ as fractions of those of white, which are the sums of the matrix's rows.
    matrix = rgb.new_tensor(_XYZ_OF_RGB)
    xyz = torch.einsum("ij,jhw->ihw", matrix / matrix.sum(dim=1, keepdim=True), linear)
    # CIELAB; the numbers are CIE 15's: a cube root, and a line where it would be steep.
    root = xyz.clamp_min(_LEAST_XYZ).pow(1 / 3)
    x, y, z = torch.where(xyz > 216 / 24389, root, xyz * (24389 / 27 / 116) + 16 / 116)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def fit(residuals: Residuals) -> Residuals:
    """Returns the same residuals with the kernel of smallest leave-one-out error.

    The length scales are chosen first, then the noise: on rendered frames as good as all together.
    With fewer than `MIN_POINTS` points the kernel stays.
    """
    if len(residuals.points) < MIN_POINTS:
        return residuals
    near = neighbourhoods(residuals, _MAX_EXACT)

    def error(candidate: Residuals) -> float:
        """The mean |error| of log depth at points, each predicted from the others."""
        errors, _ = leave_one_out(candidate, near)
        return float(errors.abs().mean())

    # The length scales; without colour, its length has no effect.
    has_colour = residuals.point_features.shape[1] > 3
    colour_lengths = LENGTHS_COLOUR if has_colour else LENGTHS_COLOUR[:1]
    by_lengths = [
        replace(residuals, depth_length=depth_length, colour_length=colour_length)
        for depth_length, colour_length in product(LENGTHS_DEPTH, colour_lengths)
    ]
    best = min(by_lengths, key=error)
    # The noise.
    by_noise = [replace(best, noise=noise) for noise in NOISES if noise != best.noise]
    return min([best, *by_noise], key=error)


def predict(residuals: Residuals, queries: SparsePoints | None = None) -> Tensor:
    """Returns the mean residual (H, W) float32 at every pixel, or (M,) at M points' coordinates.

    The residual is smooth even where the prediction is not. So every pixel's is interpolated from
    a coarser grid of pixels.

    Args:
        residuals: The residuals at the points, with the kernel of a Gaussian process.
        queries: Points at whose coordinates the residual is wanted. None: every pixel.
    """
    if queries is not None:
        features = _sample(residuals.features, queries)  # (M, 3 or 6)
        if _uses_all_points(residuals) or len(residuals.points) <= NEIGHBOURS:
            return _solve(residuals, _all_points(residuals), features[None])[0]
        # Each query is predicted from its own nearest points: M blocks of one place each.
        _, near = nearest_points(residuals.points, queries.xy.double(), NEIGHBOURS)
        return _solve(residuals, near, features[:, None])[:, 0]
    # Every pixel's, on a grid with the mean features of several pixels.
    height, width = residuals.points.size
    row_step, column_step = _steps(residuals.points)
    if row_step == 1 and column_step == 1:
        return _predict_grid(residuals)
    grid_size = (max(1, round(height / row_step)), max(1, round(width / column_step)))
    features = F.interpolate(residuals.features[None], grid_size, mode="area")[0]
    grid = replace(residuals, features=features, points=residuals.points.resized(*grid_size))
    on_grid = _predict_grid(grid)[None, None]
    return F.interpolate(on_grid, (height, width), mode="bilinear", align_corners=False)[0, 0]


def leave_one_out(
    residuals: Residuals, near: Tensor, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Returns error and variance of points, each predicted from the others of its neighbourhood.

    Both are (B, k) float64, or (B, `_INNER`) of the points in the middle where there are several
    neighbourhoods. The error is the residual minus the predicted one. The variance is that of this
    error, with a point's noise as if its weight were 1, in units of the variance of the Gaussian
    process. They are computed without solving again: Rasmussen and Williams, eq. 5.12.

    Args:
        residuals: The residuals at N points, with the kernel of a Gaussian process.
        near: Numbers (B, k) of the points of each neighbourhood, the middle one first.
        weight: Weight (N,) 0…1 of each point as a predictor; one of 0 predicts nothing. None: 1.
    """
    # A point of less weight has more noise of its own: the noise over its squared weight.
    covariance = _systems(residuals, near).covariance
    weight = torch.ones_like(residuals.residual) if weight is None else weight
    extra_noise = residuals.noise * (weight[near].clamp_min(_MIN_SCORED_WEIGHT) ** -2 - 1)
    covariance.diagonal(dim1=1, dim2=2).add_(extra_noise)
    # Errors of all points at once, from the inverse.
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
    variance = 1 / inverse.diagonal(dim1=1, dim2=2)
    error = (inverse @ residuals.residual[near][..., None])[..., 0] * variance
    # Of several neighbourhoods the middle counts, as points at the edge have others outside.
    inner = _INNER if near.shape[0] > 1 else None
    # What a point counts for the others says nothing of its own error, so its extra noise is not
    # in the variance.
    variance = variance - extra_noise
    return error[:, :inner], variance[:, :inner]


def neighbourhoods(residuals: Residuals, max_exact: int) -> Tensor:
    """Returns the numbers (B, k) of the points of B neighbourhoods, the middle one first.

    Up to `max_exact` points it is one neighbourhood of all points, in their order.
    """
    count = len(residuals.points)
    if count <= max_exact:
        return _all_points(residuals)
    # Around points that are evenly spaced in the order of points.
    middles = torch.linspace(0, count - 1, _NEIGHBOURHOODS).long()
    _, near = nearest_points(residuals.points, residuals.points.xy[middles].double(), NEIGHBOURS)
    return near


def _steps(points: SparsePoints) -> tuple[int, int]:
    """(rows, columns) of pixels that one node of the grid stands for; (1, 1): each is a node.

    The grid is the one on which the residual is predicted, finer than the points.
    """
    height, width = points.size
    if height * width < _WORTH_A_GRID:
        return 1, 1
    spacing_px = math.sqrt(height * width / len(points))
    columns = min(_MAX_STEP_PX, max(1, int(spacing_px / _NODES_BETWEEN)))
    # Scan lines lie along rows, so that rows of nodes may be farther apart between them.
    rows = columns
    spacing = scan_pattern(points.xy, points.size)
    if spacing is not None:
        _, across_px = spacing
        rows = min(_MAX_STEP_PX, max(columns, int(across_px / _NODES_BETWEEN_LINES)))
    return rows, columns


def _predict_grid(residuals: Residuals) -> Tensor:
    """The mean residual (H, W) float32 at every pixel of `residuals.features`, without a grid."""
    height, width = residuals.points.size
    if _uses_all_points(residuals):
        queries = residuals.features.flatten(1).T.contiguous()[None]  # (1, HW, F)
        return _solve(residuals, _all_points(residuals), queries).reshape(height, width)
    # Square blocks of pixels, each predicted from the points nearest to it. There are two layers,
    # half a block apart: the weight of a pixel falls towards the seams of its layer, and where one
    # layer has seams the other counts.
    side = _block_side(residuals.points)
    values, weight = _predict_blocks(residuals, side, shift=0)
    shifted_values, shifted_weight = _predict_blocks(residuals, side, shift=side // 2)
    total = weight + shifted_weight
    return values * (weight / total) + shifted_values * (shifted_weight / total)


def _solve(residuals: Residuals, near: Tensor, queries: Tensor) -> Tensor:
    """The mean residual (B, Q) float32 at Q places of each of B blocks.

    Args:
        residuals: The residuals at the points, with the kernel of a Gaussian process.
        near: Numbers (B, k) of the points that predict each block.
        queries: Features (B, Q, F) of the places.
    """
    blocks, count = near.shape
    per_block = queries.shape[1]
    means = queries.new_empty(blocks, per_block)
    # Some blocks at once, or some queries of one block, so that the memory is bounded.
    blocks_at_once = max(1, _AT_ONCE // (per_block * count))
    queries_at_once = max(1, _AT_ONCE // (blocks_at_once * count))
    for first in range(0, blocks, blocks_at_once):
        some_blocks = slice(first, first + blocks_at_once)
        # α of these blocks, and from it the means of β₀ and β₁, the constant and the slope over u:
        # var β₀ · Σα and var β₁ · Σ u·α.
        systems = _systems(residuals, near[some_blocks])
        factor = torch.linalg.cholesky(systems.covariance)
        alpha = torch.cholesky_solve(residuals.residual[near[some_blocks]][..., None], factor)
        constant = (CONSTANT * alpha[..., 0].sum(1)).float()[:, None]
        slope = (SLOPE * (systems.u * alpha[..., 0]).sum(1)).float()[:, None]
        # mean = k·α + β₀ + β₁·u
        for start in range(0, per_block, queries_at_once):
            some_queries = slice(start, start + queries_at_once)
            features = queries[some_blocks, some_queries]
            k = _covariance(residuals.scaled(features), systems.features.float())
            mean = (k @ alpha.float())[..., 0] + constant
            means[some_blocks, some_queries] = mean + slope * features[..., LOG_DEPTH]
    return means


class _Systems(NamedTuple):
    """The linear equations (K + N) α = r of B blocks with k points each (see this module)."""

    features: Tensor
    """(B, k, F) features of the points over their length scales."""
    u: Tensor
    """(B, k) predicted log depth at the points, in its standard deviations."""
    covariance: Tensor
    """(B, k, k) K + N: covariances of the residual r, of β₀ and β₁ too, and the noise."""


def _systems(residuals: Residuals, near: Tensor) -> _Systems:
    """The equations (K + N) α = r of B blocks; `near` (B, k) are the numbers of their points."""
    features = residuals.point_features[near].double()
    u = features[..., LOG_DEPTH]
    scaled = residuals.scaled(features)
    covariance = _covariance(scaled, scaled).double()
    # Added in place: the variance of β₁ times u·uᵀ, that of β₀ everywhere, the noise at points.
    covariance.baddbmm_(u[:, :, None], u[:, None, :], alpha=SLOPE).add_(CONSTANT)
    covariance.diagonal(dim1=1, dim2=2).add_(residuals.noise)
    return _Systems(scaled, u, covariance)


def _covariance(a: Tensor, b: Tensor) -> Tensor:
    """exp(−|a − b|), (B, Q, k) float32, for every a and b of each block.

    Args:
        a: Features (B, Q, F) of Q places in each of B blocks, over their length scales.
        b: Features (B, k, F) of k points in each block, over their length scales.
    """
    # Small numbers, so that the squares cancel well in |a|² + |b|² − 2a·b.
    middle = b.mean(dim=1, keepdim=True)
    a = a - middle
    b = b - middle
    squares = torch.baddbmm(b.square().sum(dim=2)[:, None, :], a, b.transpose(1, 2), alpha=-2)
    squares += a.square().sum(dim=2)[:, :, None]
    closeness: Tensor = squares.float().clamp_min_(0).sqrt_().neg_().exp_()
    return closeness


def _all_points(residuals: Residuals) -> Tensor:
    """The numbers (1, N) of the points of one block that has all N."""
    return torch.arange(len(residuals.points))[None]


def _uses_all_points(residuals: Residuals) -> bool:
    """Whether points and pixels are so few that every pixel is predicted from all points."""
    count = len(residuals.points)
    height, width = residuals.points.size
    is_small = count * height * width <= _MAX_EXACT_PRODUCT
    return count <= _MAX_EXACT or (is_small and count <= _MAX_EXACT_SMALL)


def _predict_blocks(residuals: Residuals, side: int, shift: int) -> tuple[Tensor, Tensor]:
    """The mean residual (H, W), predicted block by block, and the weight (H, W) of each pixel.

    A pixel's weight is its distance to the edge of its block, in pixels.

    Args:
        residuals: The residuals at the points, with the kernel of a Gaussian process.
        side: Side of the square blocks in pixels.
        shift: Pixels by which the first block begins before the image, to the left and above.
    """
    height, width = residuals.points.size
    rows = math.ceil((height + shift) / side)
    columns = math.ceil((width + shift) / side)
    # The features (rows, columns, side, side, F), block by block; border pixels are repeated.
    behind = columns * side - shift - width
    below = rows * side - shift - height
    padded = F.pad(residuals.features[None], (shift, behind, shift, below), mode="replicate")[0]
    blocks = padded.reshape(-1, rows, side, columns, side).permute(1, 3, 2, 4, 0)
    # The mean in each block, from the points nearest to its middle (x, y).
    numbers = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).flip(1).double()
    middles = (numbers + 0.5) * side - 0.5 - shift
    _, near = nearest_points(residuals.points, middles, NEIGHBOURS)
    values = _solve(residuals, near, blocks.reshape(rows * columns, side * side, -1))
    # The blocks side by side.
    values = values.reshape(rows, columns, side, side).permute(0, 2, 1, 3)
    values = values.reshape(rows * side, columns * side)
    # How far pixels are inside their blocks, by rows, by columns and by both.
    position = torch.arange(float(side)) + 0.5
    inside = torch.minimum(position, side - position)
    by_row = inside.repeat(rows)[shift : shift + height]
    by_column = inside.repeat(columns)[shift : shift + width]
    weight = torch.minimum(by_row[:, None], by_column[None, :])
    return values[shift : shift + height, shift : shift + width], weight


def _block_side(points: SparsePoints) -> int:
    """The largest side in pixels of square blocks nearly none of which is crowded.

    A block is predicted from the `NEIGHBOURS` points nearest to its middle. It is crowded if it
    contains more points than that number / `_IN_BLOCK`. Crowded blocks may contain the fraction
    `_CROWDED` of all points.
    """
    side = max(points.size)
    x, y = points.xy.unbind(1)
    while side > _MIN_BLOCK_PX:
        # How many points are in each block; there are never more columns of blocks than of pixels.
        # Coordinates of the first pixel begin at −0.5, which belongs to the first block.
        row = (y / side).floor().clamp_min(0)
        column = (x / side).floor().clamp_min(0)
        count = torch.bincount((row * points.size[1] + column).long())
        points_in_crowds = count[count > NEIGHBOURS / _IN_BLOCK].sum()
        if float(points_in_crowds) <= _CROWDED * len(points):
            break
        side = max(_MIN_BLOCK_PX, round(side / _BLOCK_SHRINKS))
    return side
