"""Dense depth from sparse points alone: what a network has to beat.

Each function takes points at any coordinates and returns positive depth (H, W) float32 metres of
their frame, or with `xy` (M, 2) depth (M,) at those pixel coordinates. Of points at the same
coordinates the nearest counts; the order of the points has no effect. One point gives its depth
everywhere. Without any, NoPointsError is raised.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree
from torch import Tensor

from pnpdepth_cli.completion.alignment import from_space, to_space
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import SparsePoints

_MOST_REMEMBERED = 1 << 16  # coordinate pairs up to which a result is remembered
_AT_A_POINT = 0.25  # pixels; closer than this, a point is as close as can be
_WORTH_THREADS = 1 << 15  # neighbours; for fewer, threads cost more than they save


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
