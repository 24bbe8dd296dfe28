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

# All points predict every pixel
_MAX_EXACT = 128  # of so many points at most,
_MAX_EXACT_SMALL = 256  # or so many where the image is small:
_MAX_EXACT_PRODUCT = 40_000_000  # points × pixels, at most
_AT_ONCE = 1 << 19  # covariances computed at once: what bounds the memory

# The kernel of many points is chosen
_NEIGHBOURHOODS = 24  # in so many neighbourhoods,
_INNER = 16  # by the points in the middle of each, left out one by one
_MIN_SCORED_WEIGHT = 1e-6  # the weight of a point that predicts nothing

# A block of pixels
_IN_BLOCK = 3  # contains at most 1/3 of the points that predict it,
_CROWDED = 0.05  # except for blocks with this fraction of all points,
_MIN_BLOCK_PX = 8  # and has at least this side
_BLOCK_SHRINKS = 1.4  # factor between sides that are tried

# The grid on which the residual is predicted
_WORTH_A_GRID = 1 << 16  # pixels; of fewer, every pixel is predicted
_NODES_BETWEEN = 6  # nodes of the grid between two points,
_NODES_BETWEEN_LINES = 2  # or rows of nodes between two scan lines,
_MAX_STEP_PX = 4  # most between two nodes: on real frames as good as every pixel

DEPTH = 2
"""Position of the predicted log depth among the features."""
_FLAT_DEPTH = 1e-3  # added to the standard deviation of log depth: a flat one has no edges
_FLAT_COLOUR = 1.0  # added to that of CIELAB, likewise
_LEAST_XYZ = 1e-6  # of which the cube root is taken: below it is not used, and below 0 is NaN
_XYZ_OF_RGB = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)  # IEC 61966-2-1


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """The residual at N points of an image, and the kernel of its Gaussian process."""

    features: Tensor  # (3 or 6, H, W), see `features_of`
    points: SparsePoints  # the points at pixel coordinates of the image, on the CPU
    point_features: Tensor  # (N, 3 or 6), features at the points
    residual: Tensor  # (N,) float64, log measured − log predicted depth
    # Covariance of a Gaussian process; `gaussian_process.fit` chooses it.
    depth_length: float = 2.5  # length scale of the predicted log depth
    colour_length: float = 8.0  # length scale of the colour
    noise: float = 1e-3  # variance of the noise

    @functools.cached_property
    def fitted(self) -> Residuals:
        """The residuals with the kernel of smallest leave-one-out error."""
        return fit(self)

    @functools.cached_property
    def leave_one_out_error(self) -> float:
        """The mean |error| of log depth at points, each predicted from the others."""
        error, _ = leave_one_out(self.fitted, neighbourhoods(self, _MAX_EXACT))
        return float(error.abs().mean())

    def scaled(self, features: Tensor) -> Tensor:
        """Returns features (..., 3 or 6) divided by their length scales."""
        lengths = [1.0, 1.0, self.depth_length]
        lengths += [self.colour_length] * (features.shape[-1] - 3)
        return features / features.new_tensor(lengths)

    def select(self, mask: Tensor) -> Residuals:
        """Returns the field with only the points where mask (N,) is true."""
        return replace(
            self,
            points=self.points.select(mask),
            point_features=self.point_features[mask],
            residual=self.residual[mask],
        )


def residuals_of(prediction: Tensor, points: SparsePoints, rgb: Tensor | None) -> Residuals:
    """Returns the residuals at the points that lie in the image and have a prediction.

    Of several points at the same coordinates the nearest counts.

    Args:
        prediction: (H, W) metres; not positive or not finite is unknown.
        rgb: (3, H, W) in 0…1, or None.

    Raises:
        NoPointsError: No point has a prediction.
    """
    prediction = prediction.detach().cpu()
    # The points that count.
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
    """Returns (3 or 6, H, W) float32: x and y, predicted log depth, CIELAB colour.

    x and y are in units of the longer side; depth and colour in standard deviations over the image.

    Args:
        log_depth: (H, W), NaN where unknown.
        rgb: (3, H, W) in 0…1, or None.
    """
    height, width = log_depth.shape
    y, x = (torch.arange(float(side)) / max(height, width) for side in (height, width))
    # u: known log depth, of mean 0 and standard deviation 1; 0 where it is unknown.
    known = log_depth.isfinite()
    values = log_depth if bool(known.all()) else log_depth[known]  # picking pixels is slow
    values = values.double().flatten()
    mean = values.mean()
    std = (values.dot(values) / len(values) - mean.square()).clamp_min(0).sqrt()
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
    """CIELAB (3, H, W), its mean 0 and its standard deviation over the image about 1.

    Remembered for the last image, whose residuals are propagated several times, and for a grey one.
    """
    lab = cielab(rgb)
    lab = lab - lab.mean(dim=(1, 2), keepdim=True)
    return lab / (lab.square().sum(dim=0).mean().sqrt() + _FLAT_COLOUR)


def cielab(rgb: Tensor) -> Tensor:
    """Returns (3, H, W) CIELAB (CIE 1976, white D65) of an sRGB image (3, H, W) in 0…1."""
    # The numbers are those of sRGB (IEC 61966-2-1) and of CIELAB.
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055).clamp_min(0) ** 2.4)
    matrix = rgb.new_tensor(_XYZ_OF_RGB)
    # Each row's sum is the white point's, of which XYZ is a fraction here.
    xyz = torch.einsum("ij,jhw->ihw", matrix / matrix.sum(dim=1, keepdim=True), linear)
    root = xyz.clamp_min(_LEAST_XYZ).pow(1 / 3)
    x, y, z = torch.where(xyz > 216 / 24389, root, xyz * (24389 / 27 / 116) + 16 / 116)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def fit(field: Residuals) -> Residuals:
    """Returns the field with the kernel of smallest leave-one-out error.

    The length scales are chosen first, then the noise: on rendered frames as good as all together.
    With fewer than 5 points the kernel stays.
    """
    if len(field.points) < MIN_POINTS:
        return field
    near = neighbourhoods(field, _MAX_EXACT)

    def error(candidate: Residuals) -> float:
        errors, _ = leave_one_out(candidate, near)
        return float(errors.abs().mean())

    colours = LENGTHS_COLOUR if field.point_features.shape[1] > 3 else LENGTHS_COLOUR[:1]
    lengths = product(LENGTHS_DEPTH, colours)
    best = min((replace(field, depth_length=d, colour_length=c) for d, c in lengths), key=error)
    noises = [replace(best, noise=noise) for noise in NOISES if noise != best.noise]
    return min([best, *noises], key=error)


def predict(field: Residuals, queries: SparsePoints | None = None) -> Tensor:
    """Returns the mean residual (H, W) float32 at every pixel, or (M,) at M points' coordinates.

    It is smooth where the prediction is not, so that every pixel's is predicted on a coarser grid.
    """
    if queries is not None:
        features = _sample(field.features, queries)
        if _is_exact(field) or len(field.points) <= NEIGHBOURS:
            return _solve(field, _all_points(field), features[None])[0]
        _, near = nearest_points(field.points, queries.xy.double(), NEIGHBOURS)
        return _solve(field, near, features[:, None])[:, 0]
    # At every pixel, on a grid.
    size = field.points.size
    rows, columns = _steps(field.points)
    if rows == columns == 1:
        return _predict_grid(field)
    coarse = (max(1, round(size[0] / rows)), max(1, round(size[1] / columns)))
    features = F.interpolate(field.features[None], coarse, mode="area")[0]
    grid = replace(field, features=features, points=field.points.resized(*coarse))
    values = _predict_grid(grid)[None, None]
    return F.interpolate(values, size, mode="bilinear", align_corners=False)[0, 0]


def leave_one_out(
    field: Residuals, near: Tensor, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Returns error and variance (B, ≤ k) at points predicted from their neighbourhood's others.

    Computed without solving again: Rasmussen and Williams, eq. 5.12.

    Args:
        near: (B, k) numbers of points of each neighbourhood.
        weight: (N,) 0…1 of each point as a predictor; one of 0 predicts nothing.
    """
    # A point counts less by more noise of its own.
    covariance = _systems(field, near).covariance
    weight = torch.ones_like(field.residual) if weight is None else weight
    extra_noise = field.noise * (weight[near].clamp_min(_MIN_SCORED_WEIGHT) ** -2 - 1)
    covariance.diagonal(dim1=1, dim2=2).add_(extra_noise)
    # Errors of all points at once, from the inverse.
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
    variance = 1 / inverse.diagonal(dim1=1, dim2=2)
    error = (inverse @ field.residual[near][..., None])[..., 0] * variance
    # The points at the edge of a neighbourhood have others outside of it.
    inner = _INNER if near.shape[0] > 1 else None
    return error[:, :inner], (variance - extra_noise)[:, :inner]


def neighbourhoods(field: Residuals, max_exact: int) -> Tensor:
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
    spacing_px = math.sqrt(points.size[0] * points.size[1] / len(points))
    columns = min(_MAX_STEP_PX, max(1, int(spacing_px / _NODES_BETWEEN)))
    _, across_px = scan_pattern(points.xy, points.size) or (0.0, 0.0)
    rows = min(_MAX_STEP_PX, max(columns, int(across_px / _NODES_BETWEEN_LINES)))
    return rows, columns


def _predict_grid(field: Residuals) -> Tensor:
    """The residual (H, W) of the Gaussian process at every pixel of the field's features."""
    height, width = field.points.size
    if _is_exact(field):
        queries = field.features.flatten(1).T.contiguous()[None]
        return _solve(field, _all_points(field), queries).reshape(height, width)
    # Two layers of blocks, each of which counts where the other one has its seams.
    side = _block_side(field.points)
    values, weight = _predict_blocks(field, side, 0)
    shifted_values, shifted_weight = _predict_blocks(field, side, side // 2)
    total = weight + shifted_weight
    return values * (weight / total) + shifted_values * (shifted_weight / total)


def _solve(field: Residuals, near: Tensor, queries: Tensor) -> Tensor:
    """(B, Q) float32: the mean at B × Q features, from points near (B, k)."""
    blocks, count = near.shape
    per_block = queries.shape[1]
    result = queries.new_empty(blocks, per_block)
    # Some blocks at once, or some queries of one block, so that the memory is bounded.
    blocks_at_once = max(1, _AT_ONCE // (per_block * count))
    queries_at_once = max(1, _AT_ONCE // (blocks_at_once * count))
    for first in range(0, blocks, blocks_at_once):
        some_blocks = slice(first, first + blocks_at_once)
        # α of these blocks, and from it the mean of β₀ and β₁.
        systems = _systems(field, near[some_blocks])
        factor = torch.linalg.cholesky(systems.covariance)
        alpha = torch.cholesky_solve(field.residual[near[some_blocks]][..., None], factor)
        constant = (CONSTANT * alpha[..., 0].sum(1)).float()[:, None]
        slope = (SLOPE * (systems.u * alpha[..., 0]).sum(1)).float()[:, None]
        # mean = k·α + β₀ + β₁·u
        for start in range(0, per_block, queries_at_once):
            some_queries = slice(start, start + queries_at_once)
            features = queries[some_blocks, some_queries]
            k = _covariance(field.scaled(features), systems.at.float())
            mean = (k @ alpha.float())[..., 0] + constant
            result[some_blocks, some_queries] = mean + slope * features[..., DEPTH]
    return result


class _Systems(NamedTuple):
    """The equations of B blocks with k points each."""

    at: Tensor
    """(B, k, F) features of the points over their length scales."""
    u: Tensor
    """(B, k) predicted log depth."""
    covariance: Tensor
    """(B, k, k) covariances of r, with β₀, β₁ and the noise."""


def _systems(field: Residuals, near: Tensor) -> _Systems:
    """The equations of blocks whose points are near (B, k)."""
    features = field.point_features[near].double()
    at = field.scaled(features)
    u = features[..., DEPTH]
    covariance = _covariance(at, at).double()
    covariance.baddbmm_(u[:, :, None], u[:, None, :], alpha=SLOPE).add_(CONSTANT)
    covariance.diagonal(dim1=1, dim2=2).add_(field.noise)
    return _Systems(at, u, covariance)


def _covariance(a: Tensor, b: Tensor) -> Tensor:
    """exp(−|a − b|) (B, Q, k) float32 of a (B, Q, F) and b (B, k, F), in B blocks."""
    # Small numbers, so that the squares cancel well in |a|² + |b|² − 2a·b.
    middle = b.mean(dim=1, keepdim=True)
    a = a - middle
    b = b - middle
    squares = torch.baddbmm(b.square().sum(dim=2)[:, None, :], a, b.transpose(1, 2), alpha=-2)
    squares += a.square().sum(dim=2)[:, :, None]
    closeness: Tensor = squares.float().clamp_min_(0).sqrt_().neg_().exp_()
    return closeness


def _all_points(field: Residuals) -> Tensor:
    """(1, N): one block, which has all points."""
    return torch.arange(len(field.points))[None]


def _is_exact(field: Residuals) -> bool:
    """Whether every pixel is predicted from all points."""
    count = len(field.points)
    height, width = field.points.size
    small = count <= _MAX_EXACT_SMALL and count * height * width <= _MAX_EXACT_PRODUCT
    return small or count <= _MAX_EXACT


def _predict_blocks(field: Residuals, side: int, shift: int) -> tuple[Tensor, Tensor]:
    """(H, W): the mean, predicted block by block, and the pixels' weights.

    Blocks of side × side pixels, the first of which begins `shift` pixels before the image. A
    pixel's weight is its distance to the edge of its block.
    """
    height, width = field.points.size
    rows = math.ceil((height + shift) / side)
    columns = math.ceil((width + shift) / side)
    # The features (rows, columns, side, side, F), block by block; border pixels are repeated.
    padding = (shift, columns * side - shift - width, shift, rows * side - shift - height)
    padded = F.pad(field.features[None], padding, mode="replicate")[0]
    blocks = padded.reshape(-1, rows, side, columns, side).permute(1, 3, 2, 4, 0)
    # The mean in each block, from the points nearest to its middle.
    middles = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).flip(1).double()
    _, near = nearest_points(field.points, (middles + 0.5) * side - 0.5 - shift, NEIGHBOURS)
    values = _solve(field, near, blocks.reshape(rows * columns, side * side, -1))
    # The blocks side by side.
    values = values.reshape(rows, columns, side, side).permute(0, 2, 1, 3)
    values = values.reshape(rows * side, columns * side)
    # How far pixels are inside their blocks.
    position = torch.arange(float(side)) + 0.5
    inside = torch.minimum(position, side - position)
    y = inside.repeat(rows)[shift:]
    x = inside.repeat(columns)[shift:]
    weight = torch.minimum(y[:height, None], x[None, :width])
    return values[shift : shift + height, shift : shift + width], weight


def _block_side(points: SparsePoints) -> int:
    """The largest side in pixels for which nearly no block has too many points."""
    side = max(points.size)
    x, y = points.xy.unbind(1)
    while side > _MIN_BLOCK_PX:
        cell = (y / side).floor().clamp_min(0) * points.size[1] + (x / side).floor().clamp_min(0)
        count = torch.bincount(cell.long())
        crowded = count[count > NEIGHBOURS / _IN_BLOCK].sum()
        if float(crowded) <= _CROWDED * len(points):
            break
        side = max(_MIN_BLOCK_PX, round(side / _BLOCK_SHRINKS))
    return side
