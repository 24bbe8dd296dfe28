"""Points of a scan that are occluded in the camera's image by something nearer.

Scanner and camera are at different positions, so the scanner sees past edges that occlude the
camera's view. A point behind such an edge projects onto the foreground. Its beam passed the
foreground's depth at another pixel, displaced by the parallax between the two depths. An occluded
point therefore has foreground near the segment between these two pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import UsageError

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class OcclusionFilter:
    """When a point counts as occluded by another."""

    nearer: float = 0.08
    """Foreground is nearer by more than this fraction of the point's depth."""

    margin_deg: float = 0.24
    """Largest distance of the foreground from the middle of the parallax segment.

    About half the gap between scan lines, as foreground is measured only on them.
    """

    stretch: float = 1.5
    """Multiple of half the parallax that is added to the margin."""

    reach_deg: float = 0.8
    """Foreground is searched up to this far to each side."""

    def __post_init__(self) -> None:
        if not 0 < self.nearer < 1 or min(self.margin_deg, self.stretch, self.reach_deg) < 0:
            raise UsageError(f"{self} makes no sense; give 0 < nearer < 1 and nothing negative")


def hidden_points(
    xy: Floats,
    depth: Floats,
    size: tuple[int, int],
    *,
    focal_px: float,
    scanner: Floats,
    settings: OcclusionFilter,
) -> NDArray[np.bool_]:
    """Returns (N,) true for the points that are occluded by something nearer.

    Args:
        xy: (N, 2) pixel coordinates inside the image, at most one point per pixel.
        depth: (N,) z in metres.
        size: (H, W) of the image.
        focal_px: Focal length in pixels.
        scanner: (3,) the scanner's origin in homogeneous pixel coordinates, u·z v·z z.
        settings: When a point counts as occluded.
    """
    reach = max(1, round(np.radians(settings.reach_deg) * focal_px))
    margin = np.radians(settings.margin_deg) * focal_px
    columns, rows = np.floor(xy + 0.5).astype(np.intp).T + reach
    grid = np.full((size[0] + 2 * reach, size[1] + 2 * reach), np.inf, np.float32)
    grid[rows, columns] = depth
    limit = depth * (1 - settings.nearer)
    nearest = _window_minimum(grid, reach)[rows - reach, columns - reach].astype(np.float64)
    suspects = np.flatnonzero(nearest < limit)
    beam = _beam_at(nearest[suspects], xy[suspects], depth[suspects], scanner) - xy[suspects]
    farthest = margin + 0.5 * (1 + settings.stretch) * np.hypot(beam[:, 0], beam[:, 1])
    window = np.minimum(np.ceil(farthest), reach).astype(np.intp)
    which, cell = _neighbours(grid, rows[suspects] * grid.shape[1] + columns[suspects], window)
    near = grid.ravel()[cell].astype(np.float64)
    nearer = near < limit[suspects[which]]
    point, near, cell = suspects[which[nearer]], near[nearer], cell[nearer]
    beam = _beam_at(near, xy[point], depth[point], scanner) - xy[point]
    down, right = np.divmod(cell, grid.shape[1])
    away = np.hypot(
        right - columns[point] - 0.5 * beam[:, 0], down - rows[point] - 0.5 * beam[:, 1]
    )
    hides = away <= margin + settings.stretch * 0.5 * np.hypot(beam[:, 0], beam[:, 1])
    hidden = np.zeros(len(depth), bool)
    hidden[point[hides]] = True
    return hidden


def _neighbours(
    grid: NDArray[np.float32], cells: NDArray[np.intp], window: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of a position in `cells` and a finite cell at most `window` (N,) rows and columns away.

    The cell itself is among them.
    """
    known = np.isfinite(grid).ravel()
    before = np.concatenate([[0], np.cumsum(known)])  # known cells before each, row by row
    line_of, line = _ranges(-window, 2 * window + 1)
    left = cells[line_of] + line * grid.shape[1] - window[line_of]
    first = before[left]
    span, position = _ranges(first, before[left + 2 * window[line_of] + 1] - first)
    return line_of[span], np.flatnonzero(known)[position]


def _ranges(
    first: NDArray[np.intp], count: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The values of the ranges first … first + count − 1, and the index of each one's range."""
    which = np.repeat(np.arange(len(count)), count)
    return which, np.arange(len(which)) + np.repeat(first - np.cumsum(count) + count, count)


def _beam_at(near: Floats, xy: Floats, depth: Floats, scanner: Floats) -> Floats:
    """(M, 2) pixel coordinates at which the beam to each point passes the depth `near` (M,).

    The point's own where the beam starts beyond that depth.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = (near - scanner[2]) / (depth - scanner[2])
        passed = (fraction > 0) & (fraction < 1)
        at = (1 - fraction)[:, None] * scanner[:2] + (fraction * depth)[:, None] * xy
        return np.where(passed[:, None], at / near[:, None], xy)


def _window_minimum(grid: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """The minimum of each (2·reach + 1)² window that lies within the grid, by its corner."""
    for axis in (0, 1):
        covered, wanted = 1, 2 * reach + 1
        while covered < wanted:
            step = min(covered, wanted - covered)
            lower, upper = [slice(None)] * 2, [slice(None)] * 2
            lower[axis], upper[axis] = slice(None, -step), slice(step, None)
            grid = np.minimum(grid[tuple(lower)], grid[tuple(upper)])
            covered += step
    return grid
