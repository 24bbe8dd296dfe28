"""Sparse depth maps that hold a projected LiDAR scan, such as KITTI's `velodyne_raw`.

Such a map comes without calibration and mostly with the occluded points of the scan: the scanner
sees past edges that occlude the camera's view. It is recognised by its pattern: points are close
together along a scan line and farther apart across, and some points lie between points of a nearer
surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.scan_pattern import scan_pattern
from pnpdepth_cli.sensors.occlusion import OcclusionFilter, hidden_points
from pnpdepth_cli.sensors.sparse import Mask, Points, as_depth_image

MIN_POINTS = 1000
"""Maps with fewer points are not filtered: each point matters."""

MARGIN_IN_LINES = 0.57
"""Radius of the filter over the spacing of scan lines, chosen on three KITTI frames."""

_LINE_SPACING_PX = (3.0, 8.0)  # farther apart, lines say little of what is between them
_INTERLEAVED = 0.003  # least fraction of points that lie between points of a nearer surface
_INTERLEAVED_REACH = (4, 2)  # pixels to each side, and half the width, of the area compared
_AT_CAMERA = np.zeros(3)  # no parallax is known; the margin stands for it


def occluded_in_map(points: Points) -> Mask | None:
    """Returns (N,) true for points of a projected scan that are occluded by something nearer.

    A point is occluded if a point nearer by more than `OcclusionFilter.nearer` lies within a
    fraction of the spacing of scan lines. Scanner and focal length are unknown.

    Args:
        points: Points of a depth map, on whole pixel coordinates.

    Returns:
        The mask; None for points that are no projected scan, or whose occluded points are removed
        already.
    """
    if len(points) < MIN_POINTS or bool((points.xy != np.floor(points.xy)).any()):
        return None
    depth = as_depth_image(points)
    pattern = scan_pattern(points.xy, points.size)
    low, high = _LINE_SPACING_PX
    if not (pattern.has_scan_lines and low <= pattern.across_px <= high):
        return None
    settings = OcclusionFilter()
    if interleaved(depth, settings.nearer).sum() < _INTERLEAVED * len(points):
        return None
    margin_px = MARGIN_IN_LINES * pattern.across_px
    return hidden_points(
        points.xy.astype(np.float64),
        points.depth.astype(np.float64),
        points.size,
        focal_px=margin_px / np.radians(settings.margin_deg),
        scanner=_AT_CAMERA,
        settings=settings,
    )


def interleaved(depth: NDArray[np.float32], nearer: float) -> Mask:
    """Returns (H, W) true for points with nearer points on two opposite sides.

    Args:
        depth: (H, W) metres, 0 = unknown.
        nearer: Fraction of a point's depth by which the others are nearer.
    """
    known = np.where(depth > 0, depth, np.float32(np.inf))
    limit = np.where(depth > 0, depth * np.float32(1 - nearer), 0)
    sides = [np.rot90(_nearest_above(np.rot90(known, turn)), -turn) < limit for turn in range(4)]
    opposite: Mask = (sides[0] & sides[2]) | (sides[1] & sides[3])
    return opposite


def _nearest_above(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The smallest depth in the rows above each pixel and the columns beside it."""
    reach, half = _INTERLEAVED_REACH
    height, width = depth.shape
    padded = np.pad(depth, ((reach, 0), (half, half)), constant_values=np.inf)
    row = padded[:, :width]
    for right in range(1, 2 * half + 1):
        row = np.minimum(row, padded[:, right : right + width])
    nearest = row[:height]
    for below in range(1, reach):
        nearest = np.minimum(nearest, row[below : below + height])
    return nearest
