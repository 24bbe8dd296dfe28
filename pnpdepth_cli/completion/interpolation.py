"""Dense depth from sparse points alone: what a network has to beat.

`nearest` and `linear` take points at any coordinates and return positive depth (H, W) float32
metres of their frame. Of points at the same coordinates the nearest counts; the order of the points
has no effect. One point gives its depth everywhere. Without any, NoPointsError is raised.

`Triangulation` is what `linear` interpolates in, for several spaces and sets of positions.
"""

from __future__ import annotations

import functools
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from pnpdepth_cli.completion.alignment import from_space, to_space
from pnpdepth_cli.completion.triangles import (
    Floats,
    Numbers,
    Positions,
    barycentric,
    cover,
    delaunay,
    delaunay_at,
)
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import SparsePoints

_AT_A_POINT = 0.25  # pixels; closer than this, a point is as close as can be
_NODES = 2  # a point, at most, of a grid that squares are sought in
_FEW = 50  # points a position, at least, where only the triangles at the positions are made
_CHUNK = 1 << 18  # positions that are interpolated at once: bounds the memory

# Instead of a triangle's number:
_OUTSIDE = -1
_IN_SQUARE = -2

# What is found of points, as long as these points are in use.
_TRIANGULATIONS = WeakKeyDictionary[SparsePoints, "Triangulation"]()
_DISTINCT = WeakKeyDictionary[SparsePoints, SparsePoints]()
_NEIGHBOURS = WeakKeyDictionary[SparsePoints, Tensor]()


def nearest(points: SparsePoints) -> Tensor:
    """Returns the depth of the nearest point in the image."""
    points = distinct(points)
    _, number = nearest_points(points, pixels_of(points.size), 1)
    return points.depth[number[:, 0].to(points.depth.device)].reshape(points.size)


def linear(points: SparsePoints, xy: Tensor | None = None, *, space: str = "depth") -> Tensor:
    """Returns linear interpolation in the Delaunay triangles of the points; see `Triangulation`.

    Args:
        xy: (M, 2) pixel coordinates where depth (M,) is wanted. None: every pixel.
        space: The quantity that is linear, one of `choices.SPACES`.
    """
    triangulation = triangulation_of(points)
    return triangulation.dense(space) if xy is None else triangulation.at(xy, space)


def triangulation_of(points: SparsePoints) -> Triangulation:
    """Returns the triangulation of the points, the same one as long as these points are in use.

    An expert, its validation, the baseline and the standard deviation interpolate in it.
    """
    triangulation = _TRIANGULATIONS.get(points)
    if triangulation is None:
        triangulation = _TRIANGULATIONS[points] = Triangulation(points)
    return triangulation


class Triangulation:
    """Delaunay's triangles of points, made when they are first needed, and depth linear in them.

    The quantity that is linear is `space`, one of `choices.SPACES`. The nearest point's depth is
    taken outside the points' hull, and everywhere if all are on one line.

    Most pixels of a depth map lie in squares of four points. A square is two of Delaunay's
    triangles, divided by either diagonal; it is interpolated bilinearly instead. So only the points
    around holes are triangulated.

    Raises:
        NoPointsError: There is no point.
    """

    def __init__(self, points: SparsePoints):
        self._points = distinct(points)
        self._xy = self._points.xy.cpu().double().numpy()
        self._grid = _Grid.of(self._xy)
        self._dense: dict[str, Tensor] = {}
        self._asked: tuple[Tensor, _Located] | None = None  # the last coordinates

    def dense(self, space: str = "depth") -> Tensor:
        """Returns depth (H, W) float32 metres at every pixel, computed once."""
        if space not in self._dense:
            pixels = pixels_of(self._points.size).numpy()
            depth = self._depth(pixels, self._locate_pixels(), space)
            self._dense[space] = depth.reshape(self._points.size)
        return self._dense[space]

    def at(self, xy: Tensor, space: str = "depth") -> Tensor:
        """Returns depth (M,) float32 metres at pixel coordinates (M, 2).

        Where the last coordinates lie is remembered: an expert, the baseline and the standard
        deviation ask for the same validation points.
        """
        coordinates = xy.cpu().double().numpy()
        if self._asked is None or self._asked[0] is not xy:
            positions, number = Positions.of(coordinates)
            is_few = len(self._rim) > _FEW * len(coordinates)
            triangles = self._triangles_at(coordinates) if is_few else self._triangles
            self._asked = (xy, self._locate(coordinates, triangles, positions, number))
        _, located = self._asked
        return self._depth(coordinates, located, space)

    @functools.cached_property
    def _rim(self) -> Numbers:
        """Numbers of the points that not only squares meet at: those that are triangulated."""
        return np.arange(len(self._xy)) if self._grid is None else self._grid.rim()

    @functools.cached_property
    def _triangles(self) -> Numbers:
        """(T, 3) numbers of the points at the corners; in squares they are of no account."""
        return self._rim[delaunay(self._xy[self._rim])]

    def _triangles_at(self, xy: Floats) -> Numbers:
        """Those of the same triangles that hold any of the positions (M, 2)."""
        if self._grid is not None:
            xy = xy[~self._grid.squares(xy).inside]
        return self._rim[delaunay_at(self._xy[self._rim], xy)]

    def _locate_pixels(self) -> _Located:
        """Where each pixel lies, row after row."""
        rows, columns = (np.arange(float(count)) for count in self._points.size)
        pixels = pixels_of(self._points.size).numpy()
        return self._locate(pixels, self._triangles, Positions(columns=columns, rows=rows))

    def _locate(
        self,
        xy: Floats,
        triangles: Numbers,
        positions: Positions,
        number: Numbers | slice = slice(None),  # of the position of each of xy
    ) -> _Located:
        """In which triangle or square, or near which point, each position (M, 2) lies."""
        triangle = cover(self._xy[triangles], positions)[number]
        if self._grid is not None:
            triangle = np.where(self._grid.squares(xy).inside, _IN_SQUARE, triangle)
        outside = torch.from_numpy(xy[triangle == _OUTSIDE])
        nearest = np.empty(0, np.intp)
        if len(outside):
            _, near = nearest_points(self._points, outside, 1)
            nearest = near[:, 0].numpy()
        return _Located(triangles, triangle.astype(np.int32), nearest)

    def _depth(self, xy: Floats, where: _Located, space: str) -> Tensor:
        """(M,) metres at positions (M, 2) that are located."""
        depth = self._points.depth.cpu().double()
        value = to_space(depth, space).numpy()
        # Means of the values at the corners of triangles and squares.
        result = np.empty(len(xy))
        for first in range(0, len(result), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            mean = result[chunk]  # a view, to be filled
            number = where.number[chunk]
            in_triangle = number >= 0
            corners = where.triangles[number[in_triangle]]
            shares = barycentric(self._xy[corners], xy[chunk][in_triangle])
            mean[in_triangle] = (shares * value[corners]).sum(axis=1)
            if self._grid is not None:
                squares = self._grid.squares(xy[chunk])
                mean[squares.inside] = (squares.shares * value[squares.corners]).sum(axis=1)
        # As depth, which outside is that of the nearest point.
        dense = from_space(torch.from_numpy(result), space)
        dense[torch.from_numpy(where.number == _OUTSIDE)] = depth[torch.from_numpy(where.nearest)]
        return dense.float().to(self._points.depth.device)


class _Located(NamedTuple):
    """Where M positions lie."""

    triangles: Numbers
    """(T, 3) numbers of the points at the corners of triangles."""
    number: NDArray[np.int32]
    """(M,) of the triangle that holds the position, or `_IN_SQUARE`, or `_OUTSIDE`."""
    nearest: Numbers
    """Number of the point nearest to each position outside."""


class _Squares(NamedTuple):
    """Which of M positions are in full squares of a grid, and what is interpolated in these."""

    inside: NDArray[np.bool_]
    """(M,) true for K positions."""
    corners: Numbers
    """(K, 4) numbers of the points at the corners."""
    shares: Floats
    """(K, 4) weights of bilinear interpolation."""


class _Grid(NamedTuple):
    """Points on the nodes of a grid, such as the pixels of a depth map, most of them known."""

    columns: Floats
    """(C,) x of the nodes, ascending."""
    rows: Floats
    """(R,) y of the nodes, ascending."""
    number: Numbers
    """(R, C) number of the point at each node, −1 for none."""
    full: NDArray[np.bool_]
    """(R − 1, C − 1) whether there are points at the four corners of each square between nodes."""

    @classmethod
    def of(cls, xy: Floats) -> _Grid | None:
        """Returns the grid of points (N, 2); None if they are on none or leave most of it empty."""
        columns, column = np.unique(xy[:, 0], return_inverse=True)
        rows, row = np.unique(xy[:, 1], return_inverse=True)
        if len(columns) * len(rows) > _NODES * len(xy):
            return None
        number = np.full((len(rows), len(columns)), -1)
        number[row, column] = np.arange(len(xy))
        known = number >= 0
        full = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
        if not full.any():
            return None
        return cls(columns=columns, rows=rows, number=number, full=full)

    def rim(self) -> Numbers:
        """Returns the numbers of the points that are not surrounded by four full squares."""
        around = np.pad(self.full, 1)
        inner = around[:-1, :-1] & around[:-1, 1:] & around[1:, :-1] & around[1:, 1:]
        return self.number[(self.number >= 0) & ~inner]

    def squares(self, xy: Floats) -> _Squares:
        """Returns which positions (M, 2) are in full squares, with corners and weights."""
        column, right = _between(self.columns, xy[:, 0])
        row, down = _between(self.rows, xy[:, 1])
        inside = self.full[row, column] & ~np.isnan(right + down)
        row, column, right, down = row[inside], column[inside], right[inside], down[inside]
        # Upper left, upper right, lower left, lower right.
        corners = [self.number[row + i, column + j] for i in (0, 1) for j in (0, 1)]
        shares = [y * x for y in (1 - down, down) for x in (1 - right, right)]
        return _Squares(inside, np.stack(corners, axis=1), np.stack(shares, axis=1))


def _between(nodes: Floats, at: Floats) -> tuple[Numbers, Floats]:
    """Number (M,) of the node at or before a coordinate, and how far it is to the next, 0…1.

    NaN before the first and behind the last node.
    """
    number = np.searchsorted(nodes, at, "right").clip(1, len(nodes) - 1) - 1
    fraction = (at - nodes[number]) / (nodes[number + 1] - nodes[number])
    return number, np.where((fraction >= 0) & (fraction <= 1), fraction, np.nan)


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

    They are the same object as long as these points are in use, so that all that is found of them,
    such as neighbours, is found once.

    Raises:
        NoPointsError: There is no point.
    """
    ordered = _DISTINCT.get(points)
    if ordered is None:
        ordered = _DISTINCT[points] = _order(points)
    return ordered


def neighbours_of(points: SparsePoints, count: int) -> Tensor:
    """Returns the numbers (N, count) of the points nearest to each point, itself left out.

    The largest count is remembered as long as the points are in use.
    """
    neighbours = _NEIGHBOURS.get(points)
    if neighbours is None or neighbours.shape[1] < count:
        _, near = nearest_points(points, points.xy.double(), count + 1)
        neighbours = _NEIGHBOURS[points] = near[:, 1:]  # the nearest is the point itself
    return neighbours[:, :count]


def _order(points: SparsePoints) -> SparsePoints:
    """The points ordered by coordinates, the nearest of several at the same ones."""
    if not len(points):
        raise NoPointsError("there is no sparse point to interpolate; give at least one")
    xy = points.xy.cpu().numpy()
    depth = points.depth.cpu().numpy()
    order = np.lexsort(xy.T[::-1])  # faster than torch.unique
    xy, depth = xy[order], depth[order]
    # The first of each run of equal coordinates, and the least depth of the run.
    is_first = np.append(True, (xy[1:] != xy[:-1]).any(axis=1))
    (first,) = is_first.nonzero()
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
