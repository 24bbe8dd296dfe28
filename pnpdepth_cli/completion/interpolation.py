"""Dense depth from sparse points alone: what a network has to beat.

Each function takes points at any coordinates and returns positive depth (H, W) float32 metres of
their frame, or with `xy` (M, 2) depth (M,) at those pixel coordinates. Of points at the same
coordinates the nearest counts; the order of the points has no effect. One point gives its depth
everywhere. Without any, NoPointsError is raised.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree
from torch import Tensor

from pnpdepth_cli.completion.alignment import from_space, to_space
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import SparsePoints

FILL_SHARE = 0.03
"""Fraction of the pixels with a point for which the kernels of `morphological` are as published."""

_MOST_REMEMBERED = 1 << 16  # coordinate pairs up to which a result is remembered
_IDW_PIXELS = 1 << 18  # pixels looked up at once: what bounds the memory
_IDW_NEIGHBOURS, _IDW_POWER = 6, 4.0
_AT_A_POINT = 0.25  # pixels; closer than this, a point is as close as can be
_WORTH_THREADS = 1 << 15  # neighbours; for fewer, threads cost more than they save
_DIAMOND = np.array(
    [[abs(x) + abs(y) <= 2 for x in range(-2, 3)] for y in range(-2, 3)], dtype=np.uint8
)
_BLUR_SIGMA = 1.1  # pixels; what OpenCV makes of the 5 × 5 Gaussian kernel of the paper's code


def nearest(points: SparsePoints, xy: Tensor | None = None) -> Tensor:
    """Returns the depth of the nearest point in the image."""
    points = distinct(points)
    _, number = nearest_points(points, _queries(points, xy), 1)
    return _reshape(points.depth.cpu()[number[:, 0]], points, xy)


def linear(points: SparsePoints, xy: Tensor | None = None, *, space: str = "depth") -> Tensor:
    """Returns linear interpolation in the Delaunay triangles of the points.

    The quantity that is linear is `space`, one of `choices.SPACES`. The nearest point's depth is
    taken outside the points' hull, and everywhere if all are on one line.
    """
    points = distinct(points)
    pixels = _queries(points, xy)
    dense = torch.full((len(pixels),), torch.nan, dtype=torch.float64)
    triangles = _triangles(_bytes_of(points))
    if triangles is not None:
        value = to_space(points.depth.cpu().double(), space)
        within = LinearNDInterpolator(triangles, value.numpy())
        dense = from_space(torch.from_numpy(within(pixels.numpy())), space)
    outside = dense.isnan()
    _, number = nearest_points(points, pixels[outside], 1)
    dense[outside] = points.depth.cpu().double()[number[:, 0]]
    return _reshape(dense, points, xy)


def in_hull(points: SparsePoints) -> Tensor:
    """Returns bool (H, W), whether each pixel lies in the convex hull of the points."""
    pixels = pixels_of(points.size)
    inside = torch.ones(len(pixels), dtype=torch.bool)
    try:
        planes = ConvexHull(points.xy.cpu().double().numpy()).equations
    except QhullError:  # fewer than three points, or all on one line
        return torch.zeros(points.size, dtype=torch.bool, device=points.depth.device)
    for x, y, offset in planes.tolist():
        inside &= x * pixels[:, 0] + y * pixels[:, 1] + offset <= _AT_A_POINT
    return inside.reshape(points.size).to(points.depth.device)


def inverse_distance(points: SparsePoints, xy: Tensor | None = None) -> Tensor:
    """Returns the mean log depth of the six nearest points, weighted by 1 / distance⁴, as depth.

    Shepard, "A two-dimensional interpolation function for irregularly-spaced data", 1968, of the
    nearest points only.
    """
    points = distinct(points)
    value = points.depth.cpu().double().log()
    pixels, means = _queries(points, xy), []
    for some in torch.split(pixels, _IDW_PIXELS):
        distance, number = nearest_points(points, some, min(_IDW_NEIGHBOURS, len(points)))
        weight = distance.clamp_min(_AT_A_POINT).pow(-_IDW_POWER)
        means.append((weight * value[number]).sum(dim=1) / weight.sum(dim=1))
    return _reshape(torch.cat(means).exp(), points, xy)


def morphological(points: SparsePoints) -> Tensor:
    """Returns depth filled by morphology: near depth grows over far depth, holes are closed.

    The steps are those of Ku, Harakeh, Waslander, "In Defense of Classical Image Processing: Fast
    Depth Completion on the CPU", 2018: dilation by a 5 × 5 diamond, closing by 5 × 5, holes filled
    by a 7 × 7 dilation, median and Gaussian blur of 5 × 5. The kernels are for a LiDAR's density;
    with fewer points the grid is coarser in proportion. The paper fills other holes by a 31 × 31
    dilation and by each column's topmost value. Here the nearest depth fills them, which is better.
    """
    from scipy.ndimage import distance_transform_edt

    points = distinct(points)
    height, width = points.size
    shrink = min(1.0, math.sqrt(len(points) / (FILL_SHARE * height * width)))
    coarse = points.resized(max(1, round(height * shrink)), max(1, round(width * shrink)))
    # Points outside the image are moved onto its outermost pixels.
    last = coarse.xy.new_tensor([coarse.size[1] - 1, coarse.size[0] - 1])
    coarse = replace(coarse, xy=torch.minimum(coarse.xy.clamp_min(0), last))
    sparse = coarse.scatter().cpu()[0, 0]
    # Of minus depth the maximum is the nearest, and minus infinity is unknown.
    value = torch.where(sparse > 0, -sparse, -torch.inf).numpy()
    # Dilation, closing, and small holes.
    five, seven = (np.ones((side, side), np.uint8) for side in (5, 7))
    value = _dilate(value, _DIAMOND)
    value = -_dilate(-_dilate(value, five), five)
    value = np.where(np.isinf(value), _dilate(value, seven), value)
    # The nearest depth in what is left.
    nearest_known = distance_transform_edt(
        np.isinf(value), return_distances=False, return_indices=True
    )
    smooth = torch.from_numpy(cv2.medianBlur(value[tuple(nearest_known)], 5))
    # The blur, and the image's own size.
    kernel = torch.exp(-0.5 * (torch.arange(-2.0, 3.0) / _BLUR_SIGMA) ** 2)
    kernel = (kernel / kernel.sum()).reshape(1, 1, 1, 5)
    padded = F.pad(smooth[None, None], (2, 2, 2, 2), mode="replicate")
    dense = -F.conv2d(F.conv2d(padded, kernel), kernel.transpose(2, 3))
    dense = F.interpolate(dense, points.size, mode="bilinear", align_corners=False)
    return dense[0, 0].to(points.depth.device)


def distinct(points: SparsePoints) -> SparsePoints:
    """Returns the points ordered by coordinates; of several at the same coordinates the nearest.

    Raises:
        NoPointsError: There is no point.
    """
    if not len(points):
        raise NoPointsError("there is no sparse point to interpolate; give at least one")
    xy, depth = points.xy.cpu().numpy(), points.depth.cpu().numpy()
    order = np.lexsort(xy.T[::-1])  # faster than torch.unique
    xy, depth = xy[order], depth[order]
    new = np.append(True, (xy[1:] != xy[:-1]).any(axis=1))
    (first,) = new.nonzero()
    return SparsePoints(
        xy=torch.from_numpy(xy[first]).to(points.xy.device),
        depth=torch.from_numpy(np.minimum.reduceat(depth, first)).to(points.depth.device),
        size=points.size,
    )


def _queries(points: SparsePoints, xy: Tensor | None) -> Tensor:
    """(M, 2) float64: the coordinates, or those of every pixel of the frame."""
    return pixels_of(points.size) if xy is None else xy.cpu().double()


def pixels_of(size: tuple[int, int]) -> Tensor:
    """Returns x and y of every pixel of a frame (H, W), row after row, (HW, 2) float64."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in size)
    return torch.cartesian_prod(rows, columns).flip(1)


def _reshape(values: Tensor, points: SparsePoints, xy: Tensor | None) -> Tensor:
    """The values (M,) in the shape that was asked for, on the points' device."""
    shape = points.size if xy is None else (len(xy),)
    return values.float().reshape(shape).to(points.depth.device)


def nearest_points(points: SparsePoints, xy: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Returns distance in pixels and number, (M, count) each, of the points nearest to xy (M, 2).

    The nearest point comes first. The results are shared with other calls and must not be changed.
    """
    find = _nearest if len(points) + len(xy) <= _MOST_REMEMBERED else _nearest.__wrapped__
    distance, number = find(_bytes_of(points), xy.numpy().tobytes(), count)
    return torch.from_numpy(distance), torch.from_numpy(number)


# The default method asks several times for the same neighbours and triangles, which are remembered
# by the bytes of coordinates (N, 2) float64.


@functools.lru_cache(8)
def _nearest(points: bytes, xy: bytes, count: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Distances and numbers of the points nearest to xy."""
    many = len(xy) // 16 * count > _WORTH_THREADS
    among, workers = np.arange(1, count + 1), -1 if many else 1
    distance, number = _tree(points).query(_coordinates(xy), among, workers=workers)
    return distance, number


@functools.lru_cache(2)
def _tree(points: bytes) -> cKDTree:
    return cKDTree(_coordinates(points))


@functools.lru_cache(2)
def _triangles(points: bytes) -> Delaunay | None:
    """The points' triangulation; None if there is no triangle."""
    try:
        return Delaunay(_coordinates(points))
    except QhullError:  # fewer than three points, or all on one line
        return None


def _bytes_of(points: SparsePoints) -> bytes:
    return points.xy.cpu().double().numpy().tobytes()


def _coordinates(values: bytes) -> NDArray[np.float64]:
    return np.frombuffer(values).reshape(-1, 2)


def _dilate(value: NDArray[np.float32], kernel: NDArray[np.uint8]) -> NDArray[np.float32]:
    # What lies outside has no effect: a replicated pixel is below the kernel itself.
    return np.asarray(cv2.dilate(value, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)
