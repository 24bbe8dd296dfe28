"""Delaunay's triangles of points in the plane, and which of them holds a position.

All coordinates are float64 arrays (…, 2), x and y in pixels. Of points on one circle, as those of a
grid are, Delaunay leaves the choice. It is made by moving every point by up to `_MOVED_PX`, by a
number made of its own coordinates. So the triangles at a place depend on the points around it
alone, neither on their order nor on points elsewhere. All values are interpolated at the points'
true coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

Floats = NDArray[np.float64]
Numbers = NDArray[np.intp]

_MOVED_PX = 1e-6
"""Width in pixels of the range by which points are moved: less than float32 tells apart from 16 px
on."""
_SLIVER_PX = 1e-6
"""Height in pixels of a triangle that is left out, at most; its place is its neighbours'."""
_THIN_PX = 1e-3
"""Height in pixels, at most, of a triangle that holds only what no other one holds."""
_SPANS = 1 << 19
"""Spans that are made at once, about, which bounds the memory."""
_NEAREST = 16
"""Points around a position that are triangulated in the first trial; later ones add as many."""
_TRIALS = 8
"""Trials with some of the points, at most; then all are triangulated."""
_EMPTY = 1e-10
"""Fraction of a circle's radius by which a point may be inside through rounding."""

# Odd factors that mix bits well, as hash functions have them (SplitMix64, xxHash).
_FACTOR_OF_X = np.uint64(0x9E3779B97F4A7C15)
_FACTOR_OF_Y = np.uint64(0xC2B2AE3D27D4EB4F)
_FACTOR_OF_STATE = np.uint64(0xBF58476D1CE4E5B9)


@dataclass(frozen=True, kw_only=True)
class Positions:
    """Where triangles are sought: nodes of a grid of M positions or more, row after row."""

    columns: Floats
    """(C,) ascending x."""
    rows: Floats
    """(R,) ascending y."""
    nodes: Numbers | None = None
    """(M,) ascending row · C + column of the positions. None: all nodes."""

    @classmethod
    def of(cls, xy: Floats) -> tuple[Positions, Numbers]:
        """Returns the distinct ones of coordinates (M, 2), and which of these each of them is.

        The latter is the number (M,) of a position, in the order row after row.
        """
        columns, column = np.unique(xy[:, 0], return_inverse=True)
        rows, row = np.unique(xy[:, 1], return_inverse=True)
        nodes, number = np.unique(row * len(columns) + column, return_inverse=True)
        return cls(columns=columns, rows=rows, nodes=nodes), number

    def __len__(self) -> int:
        return len(self.columns) * len(self.rows) if self.nodes is None else len(self.nodes)

    def first_after(self, row: Numbers, column: Numbers) -> Numbers:
        """Returns the number (S,) of the first position at or behind each of S nodes of the grid.

        Nodes are in the order row after row. Positions are some of them, or all.

        Args:
            row: Rows (S,) of the nodes.
            column: Columns (S,) of the nodes; C stands for the end of the row.
        """
        node = row * len(self.columns) + column
        number: Numbers = node if self.nodes is None else np.searchsorted(self.nodes, node)
        return number


class Spans(NamedTuple):
    """Runs of positions in a row that a triangle holds."""

    triangle: Numbers
    """(S,) number of the triangle."""
    first: Numbers
    """(S,) the run's first position."""
    length: Numbers
    """(S,) how many positions it has."""

    def expanded(self) -> tuple[Numbers, Numbers]:
        """Returns the numbers of all positions, run after run, and of the triangle of each."""
        # Where each run begins in the result; there it counts from its own first position.
        start = self.length.cumsum() - self.length
        position = np.repeat(self.first - start, self.length) + np.arange(self.length.sum())
        return position, np.repeat(self.triangle, self.length)


def delaunay(xy: Floats) -> Numbers:
    """Returns the points' numbers (T, 3) at the corners of Delaunay's triangles of N points.

    There is no triangle of fewer than three points, or of points on one line. Thin triangles come
    first, so that `cover` prefers the others.

    Args:
        xy: Coordinates (N, 2) of the points.
    """
    try:
        triangles: Numbers = Delaunay(moved(xy)).simplices.astype(np.intp)
    except QhullError:  # SciPy's, of points without an area
        return np.empty((0, 3), np.intp)
    # The heights of triangles with corners a, b and c over their longest sides.
    a, b, c = np.moveaxis(xy[triangles], 1, 0)
    squared_sides = [((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))]
    longest = np.sqrt(np.max(squared_sides, axis=0))
    height = np.abs(_cross(b - a, c - a)) / longest
    # Slivers are left out.
    thin = triangles[(height > _SLIVER_PX) & (height <= _THIN_PX)]
    return np.concatenate([thin, triangles[height > _THIN_PX]])


def delaunay_at(xy: Floats, positions: Floats) -> Numbers:
    """Returns those of Delaunay's triangles (T, 3) of N points that hold any of a few positions.

    All of the triangles, if these are not found in `_TRIALS` trials.

    The points around the positions are triangulated, with the hull's. A triangle whose circle holds
    no other of all points is Delaunay's; where one's does, more points around it are taken.

    Args:
        xy: Coordinates (N, 2) of the points.
        positions: Coordinates (M, 2) of the positions.
    """
    moved_xy = moved(xy)
    tree = cKDTree(moved_xy)
    try:
        chosen = ConvexHull(moved_xy).vertices.astype(np.intp)
    except QhullError:  # SciPy's, of points without an area
        return np.empty((0, 3), np.intp)
    places = positions
    sought, _ = Positions.of(positions)
    for trial in range(1, _TRIALS + 1):
        # The triangles of points around these places that hold a position.
        ranks = np.arange(1, min(trial * _NEAREST, len(xy)) + 1)
        _, near = tree.query(places, ranks, workers=-1)
        chosen = np.union1d(chosen, near)
        triangles = chosen[delaunay(xy[chosen])]
        number = cover(xy[triangles], sought)
        triangles = triangles[np.unique(number[number >= 0])]
        # They are Delaunay's of all points if no point is inside their circles.
        centre, radius = circles(moved_xy[triangles])
        distance, _ = tree.query(centre, workers=-1)
        is_empty = distance >= radius * (1 - _EMPTY)
        if is_empty.all():
            return triangles
        # Else more points are taken around those circles, and in the middle of their triangles.
        places = np.concatenate([centre[~is_empty], xy[triangles[~is_empty]].mean(axis=1)])
    return delaunay(xy)


def moved(xy: Floats) -> Floats:
    """Returns coordinates (N, 2), moved by up to half of `_MOVED_PX` in x and in y.

    By how much follows from the point's own coordinates, through a hash: it looks random, and is
    the same for the same coordinates.
    """
    # The bits of x and y, mixed by multiplications; 0 is added so that −0 has the bits of 0.
    bits = (xy.astype(np.float32) + np.float32(0)).view(np.uint32).astype(np.uint64)
    state = bits[:, 0] * _FACTOR_OF_X + bits[:, 1] * _FACTOR_OF_Y
    for _ in range(2):
        state = (state ^ (state >> np.uint64(31))) * _FACTOR_OF_STATE
    # The upper and the lower half as two numbers from −½ to ½.
    halves = np.stack([state >> np.uint64(32), state & np.uint64(0xFFFFFFFF)], axis=1)
    return xy + _MOVED_PX * (halves.astype(np.float64) / 2**32 - 0.5)


def cover(corners: Floats, positions: Positions) -> Numbers:
    """Returns the number (M,) of the triangle that holds each position; −1 for none.

    Of several the last one holds it. A position on an edge is in either triangle. One that lies
    beside all of them by rounding, or in a sliver that was left out, is in one at most `_SLIVER_PX`
    away.

    Args:
        corners: Coordinates (T, 3, 2) of the triangles' corners.
        positions: The M positions.
    """
    number = np.full(len(positions), -1)
    for spans in _spans(corners, positions):
        position, triangle = spans.expanded()
        number[position] = triangle
    return number


def barycentric(corners: Floats, xy: Floats) -> Floats:
    """Returns the barycentric coordinates (M, 3), 0…1, of each position in a triangle of its own.

    They are the weights of the corners by which the position is their mean. A position beside its
    triangle by rounding is on its edge.

    Args:
        corners: Coordinates (M, 3, 2) of the triangles' corners.
        xy: Coordinates (M, 2) of the positions.
    """
    # A corner's weight is the area of the triangle of the position and the other two corners.
    a, b, c = np.moveaxis(corners - xy[:, None], 1, 0)
    areas = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
    # Positive for either order of the corners.
    areas = (areas * np.sign(areas.sum(axis=1, keepdims=True))).clip(min=0.0)
    weights: Floats = areas / areas.sum(axis=1, keepdims=True)
    return weights


def circles(corners: Floats) -> tuple[Floats, Floats]:
    """Returns the centre (T, 2) and the radius (T,) of the circles through triangles (T, 3, 2)."""
    # In coordinates in which the first corner is 0; the centre is as far from it as from b and c.
    a = corners[:, 0]
    b = corners[:, 1] - a
    c = corners[:, 2] - a
    square_b = (b**2).sum(axis=1)
    square_c = (c**2).sum(axis=1)
    x = c[:, 1] * square_b - b[:, 1] * square_c
    y = b[:, 0] * square_c - c[:, 0] * square_b
    centre = np.stack([x, y], axis=1) / (2 * _cross(b, c))[:, None]
    return a + centre, np.hypot(*centre.T)


def _spans(corners: Floats, positions: Positions) -> Iterator[Spans]:
    """Yields the runs of positions in a row that triangles hold, of some triangles at once.

    Triangles are taken larger by `_SLIVER_PX` on each side. Their order is kept.

    Args:
        corners: Coordinates (T, 3, 2) of the triangles' corners.
        positions: The positions.
    """
    # The corners of each triangle from the top: (x0, y0), (x1, y1), (x2, y2), each (T,).
    order = corners[:, :, 1].argsort(axis=1)
    (x0, y0), (x1, y1), (x2, y2) = np.moveaxis(
        np.take_along_axis(corners, order[:, :, None], axis=1), 0, 2
    )
    # Two edges bound it in each row: the long one from 0 to 2, and on its other side the upper one
    # from 0 to 1 or the lower one from 1 to 2. How far each goes to the right from row to row.
    long_slope = _slope(x2 - x0, y2 - y0)
    upper_slope = _slope(x1 - x0, y1 - y0)
    lower_slope = _slope(x2 - x1, y2 - y1)
    # The first row of positions that it reaches, and how many.
    top = np.searchsorted(positions.rows, y0 - _SLIVER_PX)
    rows = np.searchsorted(positions.rows, y2 + _SLIVER_PX, "right") - top
    # Triangles with about `_SPANS` rows together are taken at once.
    total = rows.cumsum()
    cuts = np.searchsorted(total, np.arange(_SPANS, total[-1] if len(total) else 0, _SPANS))
    for some in np.split(np.arange(len(corners)), cuts):
        # A span for each of these triangles and each of its rows: t is the triangle's number.
        t = np.repeat(some, rows[some])
        first_span = rows[some].cumsum() - rows[some]
        row = np.arange(len(t)) + np.repeat(top[some] - first_span, rows[some])
        # From where to where the triangle's edges cross the row.
        y = positions.rows[row].clip(y0[t], y2[t])
        on_long = x0[t] + (y - y0[t]) * long_slope[t]
        on_upper = x0[t] + (y - y0[t]) * upper_slope[t]
        on_lower = x1[t] + (y - y1[t]) * lower_slope[t]
        on_short = np.where(y < y1[t], on_upper, on_lower)
        left = np.minimum(on_long, on_short) - _SLIVER_PX
        right = np.maximum(on_long, on_short) + _SLIVER_PX
        # Which positions are between.
        first = positions.first_after(row, np.searchsorted(positions.columns, left))
        behind = positions.first_after(row, np.searchsorted(positions.columns, right, "right"))
        has_any = behind > first
        yield Spans(t[has_any], first[has_any], (behind - first)[has_any])


def _slope(dx: Floats, dy: Floats) -> Floats:
    """dx / dy (T,) of edges from top to bottom; 0 for edges along a row."""
    return np.divide(dx, dy, out=np.zeros_like(dx), where=dy > 0)


def _cross(a: Floats, b: Floats) -> Floats:
    """The area (…) of the parallelogram of vectors (…, 2), negated where a and b are exchanged."""
    area: Floats = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return area
