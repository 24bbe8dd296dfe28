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

_HULL_MARGIN_PX = 0.25
"""Pixels; a pixel that is no farther outside the points' hull still counts as inside."""
_NODES = 2
"""Nodes for each point, at most, of a grid that points lie on: at least half have a point."""
_FEW = 50
"""Points for each position, at least, from which on only the triangles at positions are made."""
_CHUNK = 1 << 18
"""Positions that are interpolated at once, which bounds the memory."""

# Instead of a triangle's number:
_OUTSIDE = -1
_IN_SQUARE = -2

# What was computed of points, kept as long as these points are in use.
_TRIANGULATIONS = WeakKeyDictionary[SparsePoints, "Triangulation"]()
_DISTINCT = WeakKeyDictionary[SparsePoints, SparsePoints]()
_NEIGHBOURS = WeakKeyDictionary[SparsePoints, Tensor]()


def nearest(points: SparsePoints) -> Tensor:
    """Returns (H, W) float32 metres: at every pixel the depth of the point nearest in the image.

    Of several points at the same coordinates the one of least depth counts.

    Raises:
        NoPointsError: There is no point.
    """
    points = distinct(points)
    _, number = nearest_points(points, pixels_of(points.size), 1)
    return points.depth[number[:, 0].to(points.depth.device)].reshape(points.size)


def linear(points: SparsePoints, xy: Tensor | None = None, *, space: str = "depth") -> Tensor:
    """Returns depth that is linear between the points, in metres; see `Triangulation`.

    Args:
        points: The points.
        xy: Pixel coordinates (M, 2) where depth (M,) is wanted. None: every pixel, (H, W).
        space: Quantity of depth that is linear, one of `choices.SPACES`.

    Raises:
        NoPointsError: There is no point.
    """
    triangulation = triangulation_of(points)
    return triangulation.dense(space) if xy is None else triangulation.at(xy, space)


def triangulation_of(points: SparsePoints) -> Triangulation:
    """Returns the triangulation of the points, the same one as long as these points are in use.

    Several steps of a refinement interpolate in it.
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
        self._grid = _Grid.of(self._xy)  # None: the points are on no grid
        self._dense: dict[str, Tensor] = {}  # depth at every pixel, by what is linear
        self._last: tuple[Tensor, _Located] | None = None
        """The last coordinates that `at` was given, and where they lie."""

    def dense(self, space: str = "depth") -> Tensor:
        """Returns depth (H, W) float32 metres at every pixel, computed once for each space.

        Args:
            space: Quantity of depth that is linear, one of `choices.SPACES`.
        """
        if space not in self._dense:
            pixels = pixels_of(self._points.size).numpy()
            depth = self._depth(pixels, self._locate_pixels(), space)
            self._dense[space] = depth.reshape(self._points.size)
        return self._dense[space]

    def at(self, xy: Tensor, space: str = "depth") -> Tensor:
        """Returns depth (M,) float32 metres at pixel coordinates (M, 2).

        Where the last coordinates lie is remembered, as several steps ask for the same ones.

        Args:
            xy: The coordinates.
            space: Quantity of depth that is linear, one of `choices.SPACES`.
        """
        coordinates = xy.cpu().double().numpy()
        if self._last is None or self._last[0] is not xy:
            positions, number = Positions.of(coordinates)
            # Of many points and few positions, only the triangles at the positions are made.
            are_few = len(self._rim) > _FEW * len(coordinates)
            triangles = self._triangles_at(coordinates) if are_few else self._triangles
            self._last = (xy, self._locate(coordinates, triangles, positions, number))
        _, located = self._last
        return self._depth(coordinates, located, space)

    @functools.cached_property
    def _rim(self) -> Numbers:
        """Numbers of the points that are triangulated: all but those that only squares meet at."""
        return np.arange(len(self._xy)) if self._grid is None else self._grid.rim()

    @functools.cached_property
    def _triangles(self) -> Numbers:
        """(T, 3) numbers of the points at the corners of all triangles.

        Some may lie in squares; there the square is interpolated.
        """
        return self._rim[delaunay(self._xy[self._rim])]

    def _triangles_at(self, xy: Floats) -> Numbers:
        """(T, 3) as `_triangles`, but only those that hold any of the positions (M, 2)."""
        if self._grid is not None:
            xy = xy[~self._grid.squares(xy).inside]
        return self._rim[delaunay_at(self._xy[self._rim], xy)]

    def _locate_pixels(self) -> _Located:
        """Where each pixel of the frame lies, row after row."""
        height, width = self._points.size
        pixels = pixels_of(self._points.size).numpy()
        positions = Positions(columns=np.arange(float(width)), rows=np.arange(float(height)))
        return self._locate(pixels, self._triangles, positions)

    def _locate(
        self,
        xy: Floats,
        triangles: Numbers,
        positions: Positions,
        number: Numbers | slice = slice(None),
    ) -> _Located:
        """In which triangle or square, or near which point, each of M coordinates lies.

        Args:
            xy: The coordinates (M, 2).
            triangles: Triangles (T, 3) that are looked in, numbers of the points at the corners.
            positions: The coordinates without repetition.
            number: Number (M,) of the one among `positions` that each coordinate is. Without it,
                they are the coordinates themselves, in their order.
        """
        # The number of the triangle of each, or what stands for a square or for outside.
        triangle = cover(self._xy[triangles], positions)[number]
        if self._grid is not None:
            triangle = np.where(self._grid.squares(xy).inside, _IN_SQUARE, triangle)
        outside = torch.from_numpy(xy[triangle == _OUTSIDE])
        nearest = np.empty(0, np.intp)
        if len(outside):
            _, near = nearest_points(self._points, outside, 1)
            nearest = near[:, 0].numpy()
        # Kept for the next call, in half of the memory.
        return _Located(triangles, triangle.astype(np.int32), nearest)

    def _depth(self, xy: Floats, located: _Located, space: str) -> Tensor:
        """Depth (M,) float32 metres at coordinates (M, 2).

        Args:
            xy: The coordinates.
            located: Where they lie.
            space: Quantity of depth that is linear, one of `choices.SPACES`.
        """
        depth = self._points.depth.cpu().double()
        value = to_space(depth, space).numpy()
        # Means of the values at the corners of triangles and squares; any number outside both.
        means = np.empty(len(xy))
        for first in range(0, len(means), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            mean = means[chunk]  # a view, to be filled
            number = located.number[chunk]
            in_triangle = number >= 0
            corners = located.triangles[number[in_triangle]]
            weights = barycentric(self._xy[corners], xy[chunk][in_triangle])
            mean[in_triangle] = (weights * value[corners]).sum(axis=1)
            if self._grid is not None:
                squares = self._grid.squares(xy[chunk])
                mean[squares.inside] = (squares.weights * value[squares.corners]).sum(axis=1)
        # As depth; outside, the depth of the nearest point takes the place of that number.
        dense = from_space(torch.from_numpy(means), space)
        is_outside = torch.from_numpy(located.number == _OUTSIDE)
        dense[is_outside] = depth[torch.from_numpy(located.nearest)]
        return dense.float().to(self._points.depth.device)


class _Located(NamedTuple):
    """Where M positions lie."""

    triangles: Numbers
    """(T, 3) numbers of the points at the corners of triangles."""
    number: NDArray[np.int32]
    """(M,) number of the triangle that holds each position, or `_IN_SQUARE`, or `_OUTSIDE`."""
    nearest: Numbers
    """(K,) number of the point nearest to each of the K positions outside."""


class _Squares(NamedTuple):
    """Which of M positions are in full squares of a grid, and what is interpolated in these."""

    inside: NDArray[np.bool_]
    """(M,) true for K positions."""
    corners: Numbers
    """(K, 4) numbers of the points at the corners."""
    weights: Floats
    """(K, 4) weights of these in bilinear interpolation."""


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
        """Returns the grid of points (N, 2); None if they are on none or leave most of it empty.

        None also if no square of the grid has points at its four corners.
        """
        # Every x of a point is a column of nodes, every y a row.
        columns, column = np.unique(xy[:, 0], return_inverse=True)
        rows, row = np.unique(xy[:, 1], return_inverse=True)
        if len(columns) * len(rows) > _NODES * len(xy):  # most nodes have no point
            return None
        number = np.full((len(rows), len(columns)), -1)
        number[row, column] = np.arange(len(xy))
        # The squares with a point at each corner: upper left, upper right, lower left, lower right.
        known = number >= 0
        full = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
        if not full.any():
            return None
        return cls(columns=columns, rows=rows, number=number, full=full)

    def rim(self) -> Numbers:
        """Returns the numbers of the points that are not surrounded by four full squares."""
        padded = np.pad(self.full, 1)  # (R + 1, C + 1): a node's upper left square is at its index
        is_inner = padded[:-1, :-1] & padded[:-1, 1:] & padded[1:, :-1] & padded[1:, 1:]
        return self.number[(self.number >= 0) & ~is_inner]

    def squares(self, xy: Floats) -> _Squares:
        """Returns which positions (M, 2) are in full squares, with corners and weights.

        A square is full if there is a point at each of its corners.
        """
        # The square of each position, and how far it lies in that: 0…1, NaN outside the grid.
        column, right = _between(self.columns, xy[:, 0])
        row, down = _between(self.rows, xy[:, 1])
        inside = self.full[row, column] & ~np.isnan(right) & ~np.isnan(down)
        row = row[inside]
        column = column[inside]
        right = right[inside]
        down = down[inside]
        # Upper left, upper right, lower left, lower right.
        corners = [
            self.number[row, column],
            self.number[row, column + 1],
            self.number[row + 1, column],
            self.number[row + 1, column + 1],
        ]
        weights = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
        return _Squares(inside, np.stack(corners, axis=1), np.stack(weights, axis=1))


def _between(nodes: Floats, coordinate: Floats) -> tuple[Numbers, Floats]:
    """Between which two nodes of an axis each of M coordinates lies.

    Args:
        nodes: The nodes (R,), ascending, two or more.
        coordinate: The coordinates (M,).

    Returns:
        Number (M,) of the node at or before the coordinate, and the fraction (M,) 0…1 of the way
        from it to the next; NaN before the first and behind the last node.
    """
    number = np.searchsorted(nodes, coordinate, "right").clip(1, len(nodes) - 1) - 1
    fraction = (coordinate - nodes[number]) / (nodes[number + 1] - nodes[number])
    return number, np.where((fraction >= 0) & (fraction <= 1), fraction, np.nan)


def in_hull(points: SparsePoints) -> Tensor:
    """Returns bool (H, W), whether each pixel lies in the convex hull of the points.

    No pixel does if there are fewer than three points, or all are on one line.
    """
    pixels = pixels_of(points.size)
    inside = torch.ones(len(pixels), dtype=torch.bool)
    try:
        planes = ConvexHull(points.xy.cpu().double().numpy()).equations
    except QhullError:  # SciPy's, of points without an area
        return torch.zeros(points.size, dtype=torch.bool, device=points.depth.device)
    # Each side of the hull is a line; x, y is its unit normal, so this is the distance outside.
    for x, y, offset in planes.tolist():
        inside &= x * pixels[:, 0] + y * pixels[:, 1] + offset <= _HULL_MARGIN_PX
    return inside.reshape(points.size).to(points.depth.device)


def distinct(points: SparsePoints) -> SparsePoints:
    """Returns the points ordered by coordinates; of several at the same ones that of least depth.

    They are the same object as long as these points are in use, so that all that is computed of
    them, such as neighbours, is computed once.

    Raises:
        NoPointsError: There is no point.
    """
    ordered = _DISTINCT.get(points)
    if ordered is None:
        ordered = _DISTINCT[points] = _order(points)
    return ordered


def neighbours_of(points: SparsePoints, count: int) -> Tensor:
    """Returns the numbers (N, count) of the points nearest to each point, itself left out.

    The nearest comes first. The largest count is remembered as long as the points are in use.

    Args:
        points: The N points, no two at the same coordinates.
        count: Number of neighbours of each, fewer than N.
    """
    neighbours = _NEIGHBOURS.get(points)
    if neighbours is None or neighbours.shape[1] < count:
        _, near = nearest_points(points, points.xy.double(), count + 1)
        neighbours = _NEIGHBOURS[points] = near[:, 1:]  # the nearest is the point itself
    return neighbours[:, :count]


def _order(points: SparsePoints) -> SparsePoints:
    """The points ordered by coordinates, that of least depth of several at the same ones.

    Raises:
        NoPointsError: There is no point.
    """
    if not len(points):
        raise NoPointsError("there is no sparse point to interpolate; give at least one")
    xy = points.xy.cpu().numpy()
    depth = points.depth.cpu().numpy()
    order = np.lexsort(xy.T[::-1])  # by x, then by y; faster than torch.unique
    xy = xy[order]
    depth = depth[order]
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
    height, width = size
    rows = torch.arange(height, dtype=torch.float64)
    columns = torch.arange(width, dtype=torch.float64)
    return torch.cartesian_prod(rows, columns).flip(1)


def nearest_points(points: SparsePoints, xy: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Returns the distances in pixels and the numbers of the points nearest to each position.

    Both are (M, count), the nearest point first.

    Args:
        points: The points.
        xy: Pixel coordinates (M, 2) of the positions, on the CPU.
        count: Number of points for each position, at most all.
    """
    distance, number = points.tree.query(xy.numpy(), np.arange(1, count + 1), workers=-1)
    return torch.from_numpy(distance), torch.from_numpy(number)
