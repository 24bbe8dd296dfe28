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

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion.alignment import where_predicted
from pnpdepth_cli.completion.interpolation import distinct, nearest_points
from pnpdepth_cli.points import SparsePoints, in_frame
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
DEPTH = 2
"""Position of the predicted log depth among the features."""
_FLAT_DEPTH, _FLAT_COLOUR = 1e-3, 1.0  # added to standard deviations: a flat image has no edges
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
    at: Tensor  # (N, 3 or 6), features at the points
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
        points, at, residual = self.points.select(mask), self.at[mask], self.residual[mask]
        return replace(self, points=points, at=at, residual=residual)


def residuals_of(prediction: Tensor, points: SparsePoints, rgb: Tensor | None) -> Residuals:
    """Returns the residuals at the points that lie in the image and have a prediction.

    Of several points at the same coordinates the nearest counts.

    Args:
        prediction: (H, W) metres; not positive or not finite is unknown.
        rgb: (3, H, W) in 0…1, or None.

    Raises:
        NoPointsError: No point has a prediction.
    """
    prediction, points = prediction.detach().cpu(), points.tensors()
    inside = in_frame(points.xy, points.size, closed=True)
    known, points = where_predicted(prediction, points.where(inside))
    points = distinct(points)
    features = features_of(
        torch.where(known, prediction, torch.nan).log(), None if rgb is None else rgb.cpu()
    )
    predicted = points.sample(torch.where(known, prediction, 1.0)).double()
    return Residuals(
        features=features,
        points=points,
        at=_sample(features, points),
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
    y, x = (torch.arange(float(n)) / max(height, width) for n in (height, width))
    known = log_depth.isfinite()
    values = log_depth if bool(known.all()) else log_depth[known]  # picking them is slow
    values = values.double().flatten()
    mean = values.mean()
    std = (values.dot(values) / len(values) - mean.square()).clamp_min(0).sqrt()
    u = torch.where(known, (log_depth - mean) / (std + _FLAT_DEPTH), 0.0)
    maps = x.expand(height, width), y[:, None].expand(height, width), u.float()
    return torch.stack(maps if rgb is None else (*maps, *_colour(rgb)))


def _sample(features: Tensor, points: SparsePoints) -> Tensor:
    """The features (N, 3 or 6) at the coordinates of the points."""
    return torch.stack([points.sample(one) for one in features], dim=1)


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
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055).clamp_min(0) ** 2.4)
    matrix = rgb.new_tensor(_XYZ_OF_RGB)
    xyz = torch.einsum("ij,jhw->ihw", matrix / matrix.sum(dim=1, keepdim=True), linear)
    root = xyz.clamp_min(1e-6).pow(1 / 3)
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

    colours = LENGTHS_COLOUR if field.at.shape[1] > 3 else LENGTHS_COLOUR[:1]
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
    _, _, system = _systems(field, near)
    weight = torch.ones_like(field.residual) if weight is None else weight
    extra_noise = field.noise * (weight[near].clamp_min(_MIN_SCORED_WEIGHT) ** -2 - 1)
    system.diagonal(dim1=1, dim2=2).add_(extra_noise)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(system))
    variance = 1 / inverse.diagonal(dim1=1, dim2=2)
    error = (inverse @ field.residual[near][..., None])[..., 0] * variance
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
    spacing = math.sqrt(points.size[0] * points.size[1] / len(points))
    step = min(_MAX_STEP, max(1, int(spacing / _NODES_BETWEEN)))
    _, across_px = scan_pattern(points.xy, points.size) or (0.0, 0.0)
    return min(_MAX_STEP, max(step, int(across_px / _NODES_BETWEEN_LINES))), step


def _predict_grid(field: Residuals) -> Tensor:
    """The same, predicted at every pixel of the field's features."""
    height, width = field.points.size
    if _is_exact(field):
        queries = field.features.flatten(1).T.contiguous()[None]
        return _solve(field, _all_points(field), queries).reshape(height, width)
    side = _block_side(field.points)
    layers = [_predict_blocks(field, side, shift) for shift in (0, side // 2)]
    total = layers[0][1] + layers[1][1]
    return sum((values * (weight / total) for values, weight in layers), torch.zeros(()))


def _solve(field: Residuals, near: Tensor, queries: Tensor) -> Tensor:
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
            k = _covariance(field.scaled(part), at.float())
            mean = (k @ alpha.float())[..., 0] + beta.float()[0, :, None]
            result[some, start : start + step] = mean + beta.float()[1, :, None] * part[..., 2]
    return result


def _systems(field: Residuals, near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Scaled features, u, and the covariances of r, of points near (B, k)."""
    at = field.at[near].double()
    scaled, u = field.scaled(at), at[..., 2]
    system = _covariance(scaled, scaled).double()
    system.baddbmm_(u[:, :, None], u[:, None, :], alpha=SLOPE).add_(CONSTANT)
    system.diagonal(dim1=1, dim2=2).add_(field.noise)
    return scaled, u, system


def _covariance(a: Tensor, b: Tensor) -> Tensor:
    """exp(−|a − b|) (B, Q, k) float32 of a (B, Q, F) and b (B, k, F), in B blocks."""
    middle = b.mean(dim=1, keepdim=True)  # small numbers, so that the squares cancel well
    a, b = a - middle, b - middle
    squares = torch.baddbmm(b.square().sum(dim=2)[:, None, :], a, b.transpose(1, 2), alpha=-2)
    squares += a.square().sum(dim=2)[:, :, None]
    closeness: Tensor = squares.float().clamp_min_(0).sqrt_().neg_().exp_()
    return closeness


def _all_points(field: Residuals) -> Tensor:
    return torch.arange(len(field.points))[None]


def _is_exact(field: Residuals) -> bool:
    """Whether every pixel is predicted from all points."""
    count, (height, width) = len(field.points), field.points.size
    small = count <= _MAX_EXACT_SMALL and count * height * width <= _MAX_EXACT_PRODUCT
    return small or count <= _MAX_EXACT


def _predict_blocks(field: Residuals, side: int, shift: int) -> tuple[Tensor, Tensor]:
    """(H, W): the mean, predicted block by block, and the pixels' weights.

    Blocks of side × side pixels, the first of which begins `shift` pixels before the image. A
    pixel's weight is its distance to the edge of its block.
    """
    height, width = field.points.size
    rows, columns = (math.ceil((n + shift) / side) for n in (height, width))
    padding = (shift, columns * side - shift - width, shift, rows * side - shift - height)
    padded = F.pad(field.features[None], padding, mode="replicate")[0]
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
