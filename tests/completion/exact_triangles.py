"""Points on quarters of pixels, and their Delaunay triangles by exact arithmetic."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from hypothesis import strategies as st

from pnpdepth_cli.completion.triangles import (
    Floats,
)

# On quarters of pixels, points on one line or one circle are frequent, and arithmetic is exact.
QUARTERS = st.integers(-4, 28).map(lambda quarter: quarter / 4)


POINTS = st.lists(st.tuples(QUARTERS, QUARTERS), min_size=3, max_size=9, unique=True)


def in_quarters(points: Floats) -> list[list[int]]:
    """Coordinates as whole numbers, for exact arithmetic."""
    return [[round(4 * number) for number in point] for point in points.tolist()]


def doubled_area(a: Floats, b: Floats, c: Floats) -> int:
    (ax, ay), (bx, by), (cx, cy) = in_quarters(np.array([a, b, c]))
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def is_delaunay(xy: Floats, triangle: tuple[int, ...]) -> bool:
    """Whether no point is inside the circle of a triangle, exactly."""
    points = in_quarters(xy)
    a, b, c = (points[corner] for corner in triangle)
    if doubled_area(*xy[list(triangle)]) < 0:
        b, c = c, b
    for x, y in points:
        (ax, ay), (bx, by), (cx, cy) = ((px - x, py - y) for px, py in (a, b, c))
        inside = (
            (ax * ax + ay * ay) * (bx * cy - by * cx)
            - (bx * bx + by * by) * (ax * cy - ay * cx)
            + (cx * cx + cy * cy) * (ax * by - ay * bx)
        )
        if inside > 0:
            return False
    return True


def holds(xy: Floats, triangle: tuple[int, ...], position: Floats) -> bool:
    """Whether a position is in a triangle or on its edge, exactly."""
    a, b, c = (xy[corner] for corner in triangle)
    areas = [doubled_area(p, q, position) for p, q in ((a, b), (b, c), (c, a))]
    return min(areas) >= 0 or max(areas) <= 0


def all_delaunay(xy: Floats) -> list[tuple[int, ...]]:
    """Every triangle that a Delaunay triangulation may have, by trying all."""
    return [
        triangle
        for triangle in combinations(range(len(xy)), 3)
        if doubled_area(*xy[list(triangle)]) != 0 and is_delaunay(xy, triangle)
    ]
