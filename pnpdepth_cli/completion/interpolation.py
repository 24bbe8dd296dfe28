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
_OUTSIDE, _IN_SQUARE = -1, -2  # instead of a triangle's number
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
    known = _TRIANGULATIONS.get(points)
    if known is None:
        known = _TRIANGULATIONS[points] = Triangulation(points)
    return known


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
            depth = self._depth(pixels, self._pixels(), space)
            self._dense[space] = depth.reshape(self._points.size)
        return self._dense[space]

    def at(self, xy: Tensor, space: str = "depth") -> Tensor:
        """Returns depth (M,) float32 metres at pixel coordinates (M, 2).

        Where the last coordinates lie is remembered: an expert, the baseline and the standard
        deviation ask for the same validation points.
        """
        here = xy.cpu().double().numpy()
        if self._asked is None or self._asked[0] is not xy:
            positions, number = Positions.of(here)
            few = len(self._rim) > _FEW * len(here)
            triangles = self._triangles_at(here) if few else self._triangles
            self._asked = xy, self._located(here, triangles, positions, number)
        return self._depth(here, self._asked[1], space)

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
            inside, _, _ = self._grid.squares(xy)
            xy = xy[~inside]
        return self._rim[delaunay_at(self._xy[self._rim], xy)]

    def _pixels(self) -> _Located:
        """Where each pixel lies, row after row."""
        rows, columns = (np.arange(float(count)) for count in self._points.size)
        pixels = pixels_of(self._points.size).numpy()
        return self._located(pixels, self._triangles, Positions(columns=columns, rows=rows))

    def _located(
        self,
        xy: Floats,
        triangles: Numbers,
        positions: Positions,
        number: Numbers | slice = slice(None),  # of the position of each of xy
    ) -> _Located:
        """In which triangle or square, or near which point, each position (M, 2) lies."""
        held = cover(self._xy[triangles], positions)[number]
        if self._grid is not None:
            held = np.where(self._grid.squares(xy)[0], _IN_SQUARE, held)
        outside = torch.from_numpy(xy[held == _OUTSIDE])
        nearest = np.empty(0, np.intp)
        if len(outside):
            nearest = nearest_points(self._points, outside, 1)[1][:, 0].numpy()
        return _Located(triangles, held.astype(np.int32), nearest)

    def _depth(self, xy: Floats, where: _Located, space: str) -> Tensor:
        """(M,) metres at positions (M, 2) that are located."""
        depth = self._points.depth.cpu().double()
        value, result = to_space(depth, space).numpy(), np.empty(len(xy))
        for first in range(0, len(result), _CHUNK):
            some = slice(first, first + _CHUNK)
            at, number, part = xy[some], where.number[some], result[some]
            in_triangle = number >= 0
            corners = where.triangles[number[in_triangle]]
            shares = barycentric(self._xy[corners], at[in_triangle])
            part[in_triangle] = (shares * value[corners]).sum(axis=1)
            if self._grid is not None:
                in_square, corners, shares = self._grid.squares(at)
                part[in_square] = (shares * value[corners]).sum(axis=1)
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
        return cls(columns=columns, rows=rows, number=number, full=full) if full.any() else None

    def rim(self) -> Numbers:
        """Returns the numbers of the points that are not surrounded by four full squares."""
        around = np.pad(self.full, 1)
        inner = around[:-1, :-1] & around[:-1, 1:] & around[1:, :-1] & around[1:, 1:]
        return self.number[(self.number >= 0) & ~inner]

    def squares(self, xy: Floats) -> tuple[NDArray[np.bool_], Numbers, Floats]:
        """Returns which positions (M, 2) are in full squares; the corners of these, and weights.

        The corners are points' numbers (K, 4), the weights (K, 4) those of bilinear interpolation.
        """
        (column, right), (row, down) = (
            _between(nodes, at) for nodes, at in zip((self.columns, self.rows), xy.T, strict=True)
        )
        inside = self.full[row, column] & ~np.isnan(right + down)
        row, column, right, down = row[inside], column[inside], right[inside], down[inside]
        corners = [self.number[row + i, column + j] for i in (0, 1) for j in (0, 1)]
        shares = [y * x for y in (1 - down, down) for x in (1 - right, right)]
        return inside, np.stack(corners, axis=1), np.stack(shares, axis=1)


def _between(nodes: Floats, at: Floats) -> tuple[Numbers, Floats]:
    """Number (M,) of the node at or before a coordinate, and how far it is to the next, 0…1.

    NaN before the first and behind the last node.
    """
    number = np.searchsorted(nodes, at, "right").clip(1, len(nodes) - 1) - 1
    part = (at - nodes[number]) / (nodes[number + 1] - nodes[number])
    return number, np.where((part >= 0) & (part <= 1), part, np.nan)


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
    known = _DISTINCT.get(points)
    if known is None:
        known = _DISTINCT[points] = _ordered(points)
    return known


def neighbours_of(points: SparsePoints, count: int) -> Tensor:
    """Returns the numbers (N, count) of the points nearest to each point, itself left out.

    The largest count is remembered as long as the points are in use.
    """
    known = _NEIGHBOURS.get(points)
    if known is None or known.shape[1] < count:
        _, near = nearest_points(points, points.xy.double(), count + 1)
        known = _NEIGHBOURS[points] = near[:, 1:]
    return known[:, :count]


def _ordered(points: SparsePoints) -> SparsePoints:
    """The points ordered by coordinates, the nearest of several at the same ones."""
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
