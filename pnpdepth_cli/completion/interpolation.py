"""Dense depth from sparse points alone: what a network has to beat.

`nearest` and `linear` take points at any coordinates and return positive depth (H, W) float32
metres of their frame. Of points at the same coordinates the nearest counts; the order of the points
has no effect. One point gives its depth everywhere. Without any, NoPointsError is raised.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import torch
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from pnpdepth_cli.completion.alignment import from_space, to_space
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import SparsePoints

_AT_A_POINT = 0.25  # pixels; closer than this, a point is as close as can be


def nearest(points: SparsePoints) -> Tensor:
    """Returns the depth of the nearest point in the image."""
    points = distinct(points)
    _, number = nearest_points(points, pixels_of(points.size), 1)
    return points.depth[number[:, 0].to(points.depth.device)].reshape(points.size)


def linear(points: SparsePoints, xy: Tensor | None = None, *, space: str = "depth") -> Tensor:
    """Returns linear interpolation in the Delaunay triangles of the points.

    The quantity that is linear is `space`, one of `choices.SPACES`. The nearest point's depth is
    taken outside the points' hull, and everywhere if all are on one line.

    Args:
        xy: (M, 2) pixel coordinates where depth (M,) is wanted. None: every pixel.
    """
    points = distinct(points)
    pixels = pixels_of(points.size) if xy is None else xy.cpu().double()
    depth = points.depth.cpu().double()
    dense = torch.full((len(pixels),), torch.nan, dtype=torch.float64)
    with suppress(QhullError):  # fewer than three points, or all on one line
        within = LinearNDInterpolator(
            points.xy.cpu().double().numpy(), to_space(depth, space).numpy()
        )
        dense = from_space(torch.from_numpy(within(pixels.numpy())), space)
    outside = dense.isnan()
    _, number = nearest_points(points, pixels[outside], 1)
    dense[outside] = depth[number[:, 0]]
    shape = points.size if xy is None else (len(xy),)
    return dense.float().reshape(shape).to(points.depth.device)


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


def pixels_of(size: tuple[int, int]) -> Tensor:
    """Returns x and y of every pixel of a frame (H, W), row after row, (HW, 2) float64."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in size)
    return torch.cartesian_prod(rows, columns).flip(1)


def nearest_points(points: SparsePoints, xy: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Returns distance in pixels and number, (M, count) each, of the points nearest to xy (M, 2).

    The nearest point comes first.
    """
    distance, number = points.tree.query(xy.numpy(), np.arange(1, count + 1), workers=-1)
    return torch.from_numpy(distance), torch.from_numpy(number)
