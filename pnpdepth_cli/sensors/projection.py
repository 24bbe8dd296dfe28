"""LiDAR scans in a camera's image, and which of their points the camera cannot see.

Scanner and camera are at different positions, so the scanner sees past edges that occlude the
camera's view. A point behind such an edge projects onto the foreground. Its beam passed the
foreground's depth at another pixel, displaced by the parallax between the two depths. An occluded
point therefore has foreground near the segment between these two pixels.

A depth map that holds a projected scan, such as KITTI's `velodyne_raw`, comes without calibration
and mostly with the occluded points. It is recognised by its pattern: points are close together
along a scan line and farther apart across, and some lie between points of a nearer surface.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnpdepth_cli.camera import Camera, Extrinsics, Floats
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import Size, SparsePoints, in_frame
from pnpdepth_cli.scan_pattern import scan_pattern
from pnpdepth_cli.sensors.lens import pixels_of

Mask = NDArray[np.bool_]

Points = SparsePoints[NDArray[np.float32]]
"""Sparse depth in numpy arrays."""

NEARER = 0.08
"""Foreground is nearer by more than this fraction of the point's depth."""

_MARGIN_DEG = 0.24
"""Largest distance of the foreground from the middle of the parallax segment: about half the gap
between scan lines, as foreground is measured only on them."""

_STRETCH = 1.5  # multiple of half the parallax segment that is added to the margin
_REACH_DEG = 0.8  # angle to each side in which foreground is searched

MIN_POINTS = 1000
"""Maps with fewer points are not filtered: each point matters."""

_MARGIN_IN_LINES = 0.57
"""Margin around a point in which foreground counts, over the spacing of scan lines, where no
calibration is known; chosen on three KITTI frames."""

_LINE_SPACING_PX = (3.0, 8.0)
"""Spacings of scan lines for which a map is filtered; farther apart, lines say little of what is
between them."""
_INTERLEAVED = 0.003  # least fraction of points that lie between points of a nearer surface
_INTERLEAVED_REACH_PX = 4  # to each side, in which points of a nearer surface are searched
_INTERLEAVED_HALF_WIDTH_PX = 2  # half the width of that area


def as_depth_image(points: Points) -> NDArray[np.float32]:
    """Returns (H, W) float32 metres, 0 = unknown: each point on its pixel, the nearest wins."""
    flat = np.full(points.size[0] * points.size[1], np.inf, np.float32)
    np.minimum.at(flat, pixel_index(points.xy, points.size), points.depth)
    return np.where(np.isinf(flat), np.float32(0), flat).reshape(points.size)


def pixel_index(xy: NDArray[np.floating], size: Size) -> NDArray[np.intp]:
    """Returns the row-major indices (N,) of the pixels that points lie in.

    Args:
        xy: (N, 2) pixel coordinates inside the image.
        size: (H, W) of the image.
    """
    # Pixels reach half a pixel to each side of their centres.
    column, row = np.floor(np.asarray(xy, np.float64) + 0.5).astype(np.intp).T
    index: NDArray[np.intp] = row * size[1] + column
    return index


class DropCounter:
    """How many points each step of a projection dropped."""

    def __init__(self) -> None:
        self.dropped: dict[str, int] = {}
        """Numbers of points by the reason, in the order of the steps."""

    def keep(self, mask: Mask, otherwise: str) -> Mask:
        """Returns the mask itself, and counts the points where it is false as dropped.

        Args:
            mask: (N,) true for points that are kept.
            otherwise: Reason why the others are dropped, such as "behind the camera".
        """
        self.dropped[otherwise] = int(len(mask) - np.count_nonzero(mask))
        return mask

    def keep_seen(self, xyz: Floats, camera: Camera, size: Size) -> tuple[Floats, Floats]:
        """Returns the points that are the nearest of their pixel, and their pixel coordinates.

        The others, and points outside the image, are counted as dropped.

        Args:
            xyz: (N, 3) points in the camera's coordinates, z > 0.
            camera: The camera of the image.
            size: (H, W) of the image.

        Returns:
            (M, 3) the points, and (M, 2) their pixel coordinates.
        """
        xy = pixels_of(camera, xyz)
        inside = self.keep(in_frame(xy, size), "outside the image")
        xyz, xy = xyz[inside], xy[inside]
        # Sorted by pixel, then by depth, the first point of each pixel is the nearest.
        pixel = pixel_index(xy, size)
        order = np.lexsort((xyz[:, 2], pixel))
        is_first = np.diff(pixel[order], prepend=-1) > 0
        is_nearest = np.zeros(len(xy), bool)
        is_nearest[order[is_first]] = True
        self.keep(is_nearest, "behind another in their pixel")
        return xyz[is_nearest], xy[is_nearest]

    def points(self, xyz: Floats, xy: Floats, size: Size) -> Points:
        """Returns the points that are left as sparse depth, with the counts of those dropped.

        Args:
            xyz: (N, 3) points in the camera's coordinates, metres.
            xy: (N, 2) their pixel coordinates.
            size: (H, W) of the image.
        """
        return Points(
            xy=xy.astype(np.float32),
            depth=xyz[:, 2].astype(np.float32),
            size=size,
            dropped=self.dropped,
        )

    def __str__(self) -> str:
        return describe_dropped(self.dropped)


def describe_dropped(dropped: Mapping[str, int]) -> str:
    """Returns a text of how many points were dropped and why; empty if none were.

    Args:
        dropped: Numbers of points by the reason.
    """
    return ", ".join(f"{count:,} {why}" for why, count in dropped.items() if count)


def project_velodyne(
    points: NDArray[np.floating],
    camera: Camera,
    scanner: Extrinsics,
    size: Size,
    *,
    keep_occluded: bool = False,
    has_scanner: bool = True,
) -> Points:
    """Returns the scan as sparse depth in an image, in the scan's order.

    Args:
        points: (N, 3) or more columns, x y z in metres in the scanner's coordinates.
        camera: The camera of the image.
        scanner: The scanner's pose beside the camera.
        size: (H, W) of the image.
        keep_occluded: Whether points behind the foreground stay.
        has_scanner: Whether the points were measured from their origin. If not, only their own
            positions tell which of them are hidden.

    Raises:
        NoPointsError: No point is visible in the image.
    """
    xyz = np.asarray(points)[:, :3]
    drops = DropCounter()
    # Points in front of the camera, inside the image, the nearest of their pixel.
    seen = scanner.apply(xyz)
    seen = seen[drops.keep(seen[:, 2] > 0, "behind the camera")]
    seen, xy = drops.keep_seen(seen, camera, size)
    # Of these, what the camera sees past nearer points.
    if not keep_occluded:
        if has_scanner:
            focal_px = float(camera.intrinsics[0, 0])
            origin = np.asarray(camera.intrinsics @ scanner.translation)  # in pixels times z
            hidden = hidden_points(xy, seen[:, 2], size, focal_px=focal_px, scanner=origin)
        else:
            hidden = hidden_among(xy, seen[:, 2], size)
        visible = drops.keep(~hidden, "hidden by foreground")
        seen, xy = seen[visible], xy[visible]
    if not len(xy):
        raise NoPointsError(
            f"none of the scan's {len(xyz):,} points lies in the image ({drops}); check that"
            " scan and calibration belong to this camera, the scanner's translation is in metres,"
            " and a quaternion has w last"
        )
    return drops.points(seen, xy, size)


def points_in_image(xyz: Floats, camera: Camera, size: Size) -> tuple[Floats, Floats]:
    """Returns the points (M, 3) that project into a camera's image, and their pixels (M, 2).

    Points behind others are among them.

    Args:
        xyz: (N, 3) points in the camera's coordinates.
        camera: The camera.
        size: (H, W) of the image.
    """
    xyz = xyz[xyz[:, 2] > 0]
    xy = pixels_of(camera, xyz)
    inside = in_frame(xy, size)
    return xyz[inside], xy[inside]


def hidden_points(
    xy: Floats, depth: Floats, size: Size, *, focal_px: float, scanner: Floats
) -> Mask:
    """Returns (N,) true for the points that are occluded by something nearer.

    The beam that measured a point leads from the scanner to the point. Where it passes the
    foreground's depth, the camera sees it at another pixel than at its end. A point is hidden if
    foreground was measured near the middle of the segment between these pixels.

    Args:
        xy: (N, 2) pixel coordinates inside the image, at most one point per pixel.
        depth: (N,) z in metres.
        size: (H, W) of the image.
        focal_px: Focal length in pixels.
        scanner: (3,) the scanner's origin in homogeneous pixel coordinates: u·z, v·z and z, where u
            is its column, v its row and z its depth in metres. All 0: it is at the camera's place,
            so that there is no parallax.
    """
    reach_px = max(1, round(np.radians(_REACH_DEG) * focal_px))
    margin_px = np.radians(_MARGIN_DEG) * focal_px
    # Suspects are points with something nearer within reach.
    cells = np.floor(xy + 0.5).astype(np.intp)  # the pixels, column and row
    columns, rows = cells.T
    grid = np.full(size, np.inf, np.float32)
    grid[rows, columns] = depth
    window = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    nearest = cv2.erode(grid, window)[rows, columns].astype(np.float64)  # the least in the window
    limit = depth * (1 - NEARER)
    suspects = np.flatnonzero(nearest < limit)
    # Pairs of a suspect and a neighbour, no farther apart than the last test allows: that is half
    # the segment, to its middle, and the largest distance from there. `segment` leads from the
    # suspect to where its beam passed the depth of the foreground.
    segment = _beam_at(nearest[suspects], xy[suspects], depth[suspects], scanner) - xy[suspects]
    half_px = 0.5 * np.hypot(*segment.T)
    farthest_px = half_px + margin_px + _STRETCH * half_px
    half_sides = np.minimum(np.ceil(farthest_px), reach_px)  # of a square around each suspect
    around = cKDTree(cells).query_ball_point(cells[suspects], half_sides, p=np.inf)
    suspect = np.repeat(suspects, [len(neighbours) for neighbours in around])
    neighbour = np.fromiter(itertools.chain.from_iterable(around), np.intp, len(suspect))
    foreground = grid[rows[neighbour], columns[neighbour]].astype(np.float64)
    is_nearer = foreground < limit[suspect]
    suspect = suspect[is_nearer]
    neighbour = neighbour[is_nearer]
    foreground = foreground[is_nearer]
    # A suspect is hidden if a nearer neighbour lies near the middle of its segment. The longer the
    # segment is, the farther from its middle the neighbour may lie.
    segment = _beam_at(foreground, xy[suspect], depth[suspect], scanner) - xy[suspect]
    away_px = np.hypot(*(cells[neighbour] - cells[suspect] - 0.5 * segment).T)
    hides = away_px <= margin_px + _STRETCH * 0.5 * np.hypot(*segment.T)
    is_hidden = np.zeros(len(depth), bool)
    is_hidden[suspect[hides]] = True
    return is_hidden


def _beam_at(passed_depth: Floats, xy: Floats, depth: Floats, scanner: Floats) -> Floats:
    """(M, 2) pixel coordinates at which the camera sees each beam pass a depth, or its end.

    A beam leads from the scanner to a measured point, its end. The end stands for beams that do not
    pass the depth.

    Args:
        passed_depth: (M,) the depth that each beam is to pass, metres.
        xy: (M, 2) pixel coordinates of the measured points.
        depth: (M,) depths of the measured points, metres.
        scanner: (3,) the scanner's origin in homogeneous pixel coordinates: u·z, v·z and z, of its
            column u, row v and depth z.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        # The fraction of the way from scanner to point at which the depth is passed. u·z and v·z
        # of the beam are linear in it; divided by the depth they are pixels.
        fraction = (passed_depth - scanner[2]) / (depth - scanner[2])
        is_passed = (fraction > 0) & (fraction < 1)
        xy_times_depth = (1 - fraction)[:, None] * scanner[:2] + (fraction * depth)[:, None] * xy
        return np.where(is_passed[:, None], xy_times_depth / passed_depth[:, None], xy)


def hidden_among(xy: Floats, depth: Floats, size: Size) -> Mask:
    """Returns (N,) true for points of an unknown sensor that something nearer occludes.

    Foreground is looked for within twice the median distance from a point to the nearest other. On
    points of other views of ICL-NUIM and 7-Scenes, a quarter of them behind a wall, a fifth or less
    of the hidden points is not found. Of the visible ones 1 % (with 5,000 points) to 11 % (with
    200) are taken for hidden.

    Args:
        xy: (N, 2) pixel coordinates inside the image, at most one point per pixel.
        depth: (N,) z in any unit.
        size: (H, W) of the image.
    """
    if len(xy) < 2:
        return np.zeros(len(xy), bool)  # nothing is in front of a single point
    to_itself_and_next, _ = cKDTree(xy).query(xy, k=2)
    margin_px = 2 * float(np.median(to_itself_and_next[:, 1]))
    # `hidden_points` takes the margin as an angle: the focal length is the one that makes it these
    # pixels. With the scanner at the camera's place there is no parallax.
    focal_px = margin_px / np.radians(_MARGIN_DEG)
    return hidden_points(xy, depth, size, focal_px=focal_px, scanner=np.zeros(3))


def occluded_in_map(points: Points) -> Mask | None:
    """Returns (N,) true for points of a projected scan that are occluded by something nearer.

    A point is occluded if a point nearer by more than `NEARER` lies within a fraction of the
    spacing of scan lines. Scanner and focal length are unknown. None for points that are no
    projected scan on whole pixels, or whose occluded points are removed already.
    """
    # Whether the points are a scan with occluded points.
    if len(points) < MIN_POINTS or bool((points.xy != np.floor(points.xy)).any()):
        return None
    pattern = scan_pattern(points.xy, points.size)
    if pattern is None:
        return None
    _, across_px = pattern
    low, high = _LINE_SPACING_PX
    if not low <= across_px <= high:
        return None
    # Occluded points lie between points of a nearer surface; without such they are removed already.
    if interleaved(as_depth_image(points)).sum() < _INTERLEAVED * len(points):
        return None
    # `hidden_points` takes the margin as an angle: the focal length is the one that makes it the
    # pixels wanted. With the scanner at the camera's place there is no parallax.
    return hidden_points(
        points.xy.astype(np.float64),
        points.depth.astype(np.float64),
        points.size,
        focal_px=_MARGIN_IN_LINES * across_px / np.radians(_MARGIN_DEG),
        scanner=np.zeros(3),
    )


def behind_foreground(points: Points, window_px: int, metres: float) -> Mask:
    """Returns (N,) true for points behind the nearest point of any window that they share.

    The filter is that of Conti et al. 2022, as the completion papers of 2023 to 2025 use it. The
    nearest depth in the window around each point counts for all points in that window. Points
    farther than it by more than `metres` are behind.

    Args:
        points: Points on whole pixels.
        window_px: Side of the square window, odd.
        metres: Distance by which points may be farther.
    """
    depth = as_depth_image(points)
    window = np.ones((window_px, window_px), np.uint8)
    is_known = depth > 0
    nearest = np.where(is_known, depth, np.float32(np.inf))
    for _ in range(2):  # of the window of a point, and of all windows that a point lies in
        lowest = cv2.erode(nearest, window, borderType=cv2.BORDER_CONSTANT, borderValue=np.inf)
        nearest = np.where(is_known, lowest, np.float32(np.inf))
    column, row = points.xy.astype(np.intp).T
    return np.asarray(points.depth - nearest[row, column] > metres)


def interleaved(depth: NDArray[np.float32]) -> Mask:
    """Returns (H, W) true for points between nearer ones on two opposite sides.

    A nearer one is nearer by more than the fraction `NEARER`.

    Args:
        depth: (H, W) the points' depths at their pixels, 0 = no point.
    """
    known_depth = np.where(depth > 0, depth, np.float32(np.inf))
    limit = np.where(depth > 0, depth * np.float32(1 - NEARER), 0)
    # Whether a nearer point lies in an area above each pixel, 1 in the window; the same area is
    # turned to the left, below and to the right. An erosion gives the least depth in it.
    reach = _INTERLEAVED_REACH_PX
    half = _INTERLEAVED_HALF_WIDTH_PX
    above = np.zeros((2 * reach + 1, 2 * reach + 1), np.uint8)
    above[:reach, reach - half : reach + half + 1] = 1
    up, left, down, right = (
        cv2.erode(known_depth, np.rot90(above, quarter_turns)) < limit for quarter_turns in range(4)
    )
    opposite: Mask = (up & down) | (left & right)
    return opposite
