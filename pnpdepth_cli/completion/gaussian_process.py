"""What is left at the points, spread over the picture by a Gaussian process (kriging).

The residual r in log depth is the value of a random field at the points,

    r(p) = β₀ + β₁·u(p) + f(p) + noise,   cov f(p), f(q) = exp(−|φ(p) − φ(q)|),

β₀ and β₁ normal with variances 100 and 1, u the predicted log depth. φ holds the place in the
picture, u, and the colour in CIELAB, each over a length: what looks alike, is predicted alike and
is near has about the same residual, and an edge of the picture or the prediction stops it. The mean
and the variance of r anywhere, given the points, are

    mean = k·α,   α = (K + N)⁻¹ r,    variance = k(p, p) − k·(K + N)⁻¹·k,

K of all covariances among the points, k of those with p, N diagonal of the noise (Rasmussen and
Williams, "Gaussian Processes for Machine Learning", 2006, sections 2.2 and 2.7; universal kriging
in Cressie, "Statistics for Spatial Data", 1993, section 3.4). The lengths are those of a few that
tell each point best from the others, which costs no more than solving once (ibid., eq. 5.12).

With many points every block of the picture is told by the points nearest to it, all blocks at once;
two layers of blocks, half a block apart, are blended so that no seam is seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.completion.local_alignment import trust
from pnpdepth_cli.points import SparsePoints

CONSTANT, SLOPE = 100.0, 1.0
"""Variances of β₀ and β₁, those of f being 1."""
LENGTHS_DEPTH = (1.0, 2.5, 8.0, 25.0)
LENGTHS_COLOUR = (2.5, 8.0, 25.0)
NOISES = (1e-4, 1e-3, 1e-2, 1.0)
"""Lengths in standard deviations over the picture (of the place, in longer sides: 1), and variance
of the noise. Chosen on rendered frames, with predictions of three networks; the longest lengths
and the least and most noise are there for frames unlike those."""
NEIGHBOURS = 48

_EXACT = 128  # points up to which all of them tell every pixel,
_EXACT_MOST = 256  # and up to which they do where the picture is small:
_EXACT_PRODUCT = 40_000_000  # points × pixels
_AT_ONCE = 1 << 19  # covariances made at once: what bounds the memory
_ASKED = 24  # neighbourhoods in which the lengths are tried out, when there are many points,
_INNER = 16  # and points of each that are left out: the middle ones
_IN_BLOCK = 3  # a block has at most 1/3 of the points that tell it,
_SMALLEST = 8  # pixels, a block's side
_CROWDED = 0.05  # but for so many of all points
_WRONG = (4.0, 4.0, 5.0, 6.0, 8.0)  # times the usual error, beyond which a point is wrong, in turn
_NOTHING = 1e-6  # the weight of a point that tells nothing
_DOUBTED = 0.05  # weight of 0…1; points with less are left out,
_AROUND, _MOST_DOUBTED, _HALF = 6, 4, 3  # neighbours: of a fifth of wrong points 2 % have 4 such
_FAR_BETTER = 0.5  # if that makes the others' errors at most so much of what they were,
_FAR_BETTER_MANY = 0.65  # or so much where there are many points, whose errors are well known
_LEAST = 1e-3  # of the usual error over its standard deviation if f had 1; less is none
_NORMAL_MEDIAN = 1.4826  # standard deviation over median of |x|, normal errors
_FEW = 5  # points; fewer cannot tell which lengths are best
_UNTOLD = 0.2  # standard deviation of f where nothing tells it: what networks are off by
_WITHIN = 0.68  # share within ± one standard deviation


@dataclass(frozen=True, kw_only=True)
class Kernel:
    """Lengths of the predicted log depth and of the colour, and the variance of the noise."""

    depth: float = 2.5
    colour: float = 8.0
    noise: float = 1e-3

    def scaled(self, features: Tensor) -> Tensor:
        """Features (..., 3 or 6) over their lengths."""
        lengths = [1.0, 1.0, self.depth, *[self.colour] * (features.shape[-1] - 3)]
        return features / features.new_tensor(lengths)


@dataclass(frozen=True, kw_only=True)
class Field:
    """A residual known at points of a picture.

    features: (H, W, 3 or 6) of `propagation.features_of`. at: (N, 3 or 6), those of the points.
    residual: (N,) float64. kernel: the covariances. scale: standard deviation of f.
    """

    features: Tensor
    points: SparsePoints
    at: Tensor
    residual: Tensor
    kernel: Kernel = Kernel()
    scale: float = 1.0

    def select(self, mask: Tensor) -> Field:
        """The field of the points where mask (N,) is true."""
        points, at, residual = self.points.select(mask), self.at[mask], self.residual[mask]
        return replace(self, points=points, at=at, residual=residual)


def believed(field: Field) -> Tensor:
    """(N,) bool: the points that are not wrong; all of them, unless some clearly are.

    Each point is weighted by how well its neighbours tell it: loosely by `trust`, then, unless
    there are very many, by the process, told by the others as they are weighted. A point on a small
    thing is as alone as a wrong one; but only where there are wrong ones do the others tell each
    other far better without all that are alone. Where those lie together they are not wrong, but
    what the network has not seen: a corridor behind a door.
    """
    weight, near = trust(field.points, field.residual), _neighbourhoods(field, _EXACT_MOST)
    if len(near) == 1 and near.shape[1] >= _FEW:
        for many in _WRONG:
            error, variance = _left_out(field, near, weight)
            beyond = error[0].abs() / variance[0].sqrt()
            usual = max(_NORMAL_MEDIAN * float(beyond.median()), _LEAST)
            weight = (1 - (beyond / (many * usual)).square()).clamp_min(0).square()
    kept = weight > _DOUBTED
    kept = kept | _together(field.points, ~kept)
    weight = torch.where(kept, weight.clamp_min(_DOUBTED), weight)
    if bool(kept.all()) or not bool(kept.any()):
        return torch.ones_like(kept)
    with_all, without = (
        float((error.abs() * weight[near[:, : error.shape[1]]]).sum())
        for error, _ in (_left_out(field, near), _left_out(field, near, weight))
    )
    enough = _FAR_BETTER if len(near) == 1 else _FAR_BETTER_MANY
    return kept if without < enough * with_all else torch.ones_like(kept)


def _together(points: SparsePoints, doubted: Tensor) -> Tensor:
    """(N,) bool: the doubted points most of whose neighbours are doubted, and those beside such."""
    if len(points) <= _AROUND or not bool(doubted.any()):
        return torch.zeros_like(doubted)
    _, near = nearest_points(points, points.xy.double(), _AROUND + 1)
    near = near[:, 1:]
    found = doubted & (doubted[near].sum(dim=1) >= _MOST_DOUBTED)
    while True:
        more = found | (doubted & (found[near].sum(dim=1) >= _HALF))
        if torch.equal(more, found):
            return found
        found = more


def fitted(field: Field) -> Field:
    """The field with the kernel that tells each point best from the others, and its scale.

    First the lengths, then the noise: on rendered frames as good as all of them together. Fewer
    than 5 points cannot choose: the kernel stays, and the scale is a usual one.
    """
    if len(field.points) < _FEW:
        return replace(field, scale=_UNTOLD)
    near = _neighbourhoods(field, _EXACT)

    def tried(kernel: Kernel) -> tuple[float, float, Kernel]:
        error, variance = _left_out(replace(field, kernel=kernel), near)
        scale = (error.abs() / variance.sqrt()).flatten().quantile(_WITHIN)
        return float(error.abs().mean()), float(scale), kernel

    colours = LENGTHS_COLOUR if field.at.shape[1] > 3 else LENGTHS_COLOUR[:1]
    lengths = product(LENGTHS_DEPTH, colours)
    best = min((tried(Kernel(depth=d, colour=c)) for d, c in lengths), key=lambda one: one[0])
    others = [noise for noise in NOISES if noise != best[2].noise]
    noises = (tried(replace(best[2], noise=noise)) for noise in others)
    _, scale, kernel = min([best, *noises], key=lambda one: one[0])
    return replace(field, kernel=kernel, scale=scale)


def spread(field: Field, *, sigma: bool = False) -> tuple[Tensor, Tensor | None]:
    """The residual in every pixel (H, W), and its standard deviation if asked for; float32."""
    height, width = field.points.size
    if _all_tell(field):
        queries = field.features.reshape(1, height * width, -1)
        told = _told(field, _everyone(field), queries, sigma).reshape(-1, height, width)
    else:
        side = _block_side(field.points)
        parts = [_layer(field, side, shift, sigma) for shift in (0, side // 2)]
        total = parts[0][1] + parts[1][1]
        told = torch.stack([told * (weight / total) for told, weight in parts]).sum(dim=0)
    return told[0], (told[1].clamp_min(0).sqrt() * field.scale if sigma else None)


def at_places(field: Field, places: Tensor, at: Tensor) -> Tensor:
    """The residual (M,) at places (M, 2) xy in pixels with these features (M, 3 or 6)."""
    if _all_tell(field) or len(field.points) <= NEIGHBOURS:
        return _told(field, _everyone(field), at[None], False)[0, 0]
    _, near = nearest_points(field.points, places.double(), NEIGHBOURS)
    return _told(field, near, at[:, None], False)[0, :, 0]


def _told(field: Field, near: Tensor, queries: Tensor, sigma: bool) -> Tensor:
    """(1 or 2, B, Q) float32: mean and variance at B × Q features, told by points near (B, k)."""
    (blocks, count), asked = near.shape, queries.shape[1]
    found = queries.new_empty(1 + sigma, blocks, asked)
    many = max(1, _AT_ONCE // (asked * count))
    step = max(1, _AT_ONCE // (many * count))
    for first in range(0, blocks, many):
        some = slice(first, first + many)
        at, u, system = _systems(field, near[some])
        factor = torch.linalg.cholesky(system + _trend(u))
        alpha = torch.cholesky_solve(field.residual[near[some]][..., None], factor)
        beta = torch.stack([CONSTANT * alpha[..., 0].sum(1), SLOPE * (u * alpha[..., 0]).sum(1)])
        if sigma:
            root = torch.linalg.cholesky(system)
        for start in range(0, asked, step):
            part = queries[some, start : start + step]
            v = part[..., 2]
            k = _covariance(field.kernel.scaled(part), at.float())
            mean = (k @ alpha.float())[..., 0] + beta.float()[0, :, None]
            found[0, some, start : start + step] = mean + beta.float()[1, :, None] * v
            if sigma:
                variance = _variance(root, u, k, v) + field.kernel.noise
                found[1, some, start : start + step] = variance
    return found


def _systems(field: Field, near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Features over their lengths, u, and the covariances of f and noise, of points near (B, k)."""
    at = field.at.double()[near]
    scaled = field.kernel.scaled(at)
    noise = field.kernel.noise * torch.eye(near.shape[1], dtype=at.dtype)
    return scaled, at[..., 2], _covariance(scaled, scaled) + noise


def _trend(u: Tensor) -> Tensor:
    """Covariances (B, k, k) of β₀ + β₁·u."""
    trend: Tensor = CONSTANT + SLOPE * u[:, :, None] * u[:, None, :]
    return trend


def _variance(root: Tensor, u: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """(B, Q) of r without its noise (Rasmussen and Williams, eq. 2.42, the trend apart from f:

    the large variance of β₀ then cancels nowhere). root: Cholesky factor of f's and the noise's.
    """
    lines = torch.stack([torch.ones_like(u), u], dim=2)
    lines = torch.linalg.solve_triangular(root, lines, upper=False)
    prior = torch.diag(torch.tensor([1 / CONSTANT, 1 / SLOPE], dtype=u.dtype))
    rest = torch.linalg.inv(prior + lines.transpose(1, 2) @ lines).float()
    inverse = torch.linalg.solve_triangular(
        root, torch.eye(u.shape[1], dtype=u.dtype).expand_as(root), upper=False
    )
    told = inverse.float() @ k.transpose(1, 2)
    left = torch.stack([torch.ones_like(v), v], dim=1) - lines.float().transpose(1, 2) @ told
    variance: Tensor = 1 - told.square().sum(dim=1) + (left * (rest @ left)).sum(dim=1)
    return variance


def _covariance(a: Tensor, b: Tensor) -> Tensor:
    """exp(−|a − b|) (B, Q, k) of a (B, Q, F) and b (B, k, F)."""
    middle = b.mean(dim=1, keepdim=True)  # small numbers, so that the squares cancel well
    a, b = a - middle, b - middle
    squares = torch.baddbmm(b.square().sum(dim=2)[:, None, :], a, b.transpose(1, 2), alpha=-2)
    squares += a.square().sum(dim=2)[:, :, None]
    closeness: Tensor = squares.clamp_min_(0).sqrt_().neg_().exp_()
    return closeness


def _left_out(field: Field, near: Tensor, weight: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Error and variance (B, ≤ k) at points, each told by the others of its neighbourhood.

    Without solving again: Rasmussen and Williams, eq. 5.12. weight: (N,) 0…1 of what the others
    tell; one of 0 tells nothing.
    """
    _, u, system = _systems(field, near)
    weight = torch.ones_like(field.residual) if weight is None else weight
    more = field.kernel.noise * (weight[near].clamp_min(_NOTHING) ** -2 - 1)
    system = system + torch.diag_embed(more)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(system + _trend(u)))
    variance = 1 / inverse.diagonal(dim1=1, dim2=2)
    error = (inverse @ field.residual[near][..., None])[..., 0] * variance
    inner = _INNER if near.shape[0] > 1 else None
    return error[:, :inner], (variance - more)[:, :inner]


def _neighbourhoods(field: Field, most: int) -> Tensor:
    """Numbers (B, k) of points near each other, the middle one first; all of them up to most."""
    count = len(field.points)
    if count <= most:
        return _everyone(field)
    middles = torch.linspace(0, count - 1, _ASKED).long()
    _, near = nearest_points(field.points, field.points.xy[middles].double(), NEIGHBOURS)
    return near


def _everyone(field: Field) -> Tensor:
    return torch.arange(len(field.points))[None]


def _all_tell(field: Field) -> bool:
    """True if every pixel is told by all points."""
    count, (height, width) = len(field.points), field.points.size
    small = count <= _EXACT_MOST and count * height * width <= _EXACT_PRODUCT
    return small or count <= _EXACT


def _layer(field: Field, side: int, shift: int, sigma: bool) -> tuple[Tensor, Tensor]:
    """(1 or 2, H, W) mean and variance, told block by block, and the pixels' weights (H, W).

    Blocks of side × side pixels, the first of which begins `shift` pixels before the picture. A
    pixel's weight is its distance to the edge of its block.
    """
    height, width = field.points.size
    rows, columns = (math.ceil((n + shift) / side) for n in (height, width))
    padding = (shift, columns * side - shift - width, shift, rows * side - shift - height)
    padded = F.pad(field.features.permute(2, 0, 1)[None], padding, mode="replicate")[0]
    blocks = padded.reshape(-1, rows, side, columns, side).permute(1, 3, 2, 4, 0)
    middles = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).flip(1).double()
    _, near = nearest_points(field.points, (middles + 0.5) * side - 0.5 - shift, NEIGHBOURS)
    told = _told(field, near, blocks.reshape(rows * columns, side * side, -1), sigma)
    told = told.reshape(-1, rows, columns, side, side).permute(0, 1, 3, 2, 4)
    told = told.reshape(-1, rows * side, columns * side)
    place = torch.arange(float(side)) + 0.5
    inside = torch.minimum(place, side - place)
    y, x = (inside.repeat(n)[shift:] for n in (rows, columns))
    weight = torch.minimum(y[:height, None], x[None, :width])
    return told[:, shift : shift + height, shift : shift + width], weight


def _block_side(points: SparsePoints) -> int:
    """The largest side in pixels for which nearly no block has too many points."""
    side = max(points.size)
    x, y = points.xy.unbind(1)
    while side > _SMALLEST:
        cell = (y / side).floor().clamp_min(0) * points.size[1] + (x / side).floor().clamp_min(0)
        count = torch.bincount(cell.long())
        crowded = count[count > NEIGHBOURS / _IN_BLOCK].sum()
        if float(crowded) <= _CROWDED * len(points):
            break
        side = max(_SMALLEST, round(side / 1.4))
    return side
