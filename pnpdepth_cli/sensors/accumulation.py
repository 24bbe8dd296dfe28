"""Points of neighbouring scans, moved into a frame by the camera's motion.

A moved point is kept where the measured point of the frame nearest to it, or two of the nearest
four, have about the same depth, and where no measured point close by contradicts it. So a point of
something that has moved since is dropped, and one that is occluded in the frame or that the frame's
own scanner has seen through. Scans nearer in time count more: a point is dropped where a point of
the frame, or of a scan nearer in time, lies within as many pixels as frames are between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.registration import Surface, registered, surface_of
from pnpdepth_cli.sensors.sparse import DropCounter, Mask, Points

Floats = NDArray[np.float64]

TOLERANCE = 0.05
"""Difference of log depth to a measured point; chosen on frames 2 and 4 of a KITTI drive."""
CONTRADICTION = 0.1
"""Difference of log depth that contradicts; chosen, as `CLOSE`, on frames 0, 2, 4, 6 of it."""
CLOSE = (0.55, 0.37)
"""Mean spacings of the measured points, across and down, within which one contradicts. Down is
less, as the next scan line of a LiDAR lies at another depth."""

_COMPARED, _AGREEING = 4, 2  # measured points beside a moved one, of which so many agree
_CONTRADICTING = 12  # nearest measured points, of which none contradicts


@dataclass(frozen=True, kw_only=True)
class NeighbourScan:
    """The points of another frame of the sequence."""

    points: Points
    """In the other frame's image."""
    motion: Floats
    """(3, 4) from the other camera's frame to this one's, metres."""
    apart: int
    """Frames between the two, at least 1."""


def accumulated(points: Points, neighbours: Sequence[NeighbourScan], camera: Camera) -> Points:
    """Returns the frame's own points followed by those of its neighbours that agree with them.

    Args:
        points: The frame's own.
        neighbours: Other frames of the same camera.
        camera: Its intrinsics and distortion.
    """
    surface, result = surface_of(points, camera), points
    for apart in sorted({each.apart for each in neighbours}):
        moved = []
        for each in neighbours:
            if each.apart == apart:
                xyz = camera.unproject(each.points.xy, each.points.depth)
                motion = registered(surface, xyz, each.motion, camera)
                moved.append(xyz @ motion[:, :3].T + motion[:, 3])
        result = _added(result, np.concatenate(moved), surface, camera, apart)
    return result


def _added(known: Points, xyz: Floats, surface: Surface, camera: Camera, apart: int) -> Points:
    """The points known so far, and of these (M, 3) those that agree with measured ones."""
    from scipy.spatial import cKDTree

    drops = DropCounter(len(xyz))
    xyz = xyz[drops.keep(xyz[:, 2] > 0, "behind the camera")]
    xy = camera.pixels_of(xyz)
    inside = drops.keep(in_frame(xy, known.size), "outside the image")
    xy, depth = xy[inside], xyz[inside, 2]
    agrees = drops.keep(_agrees(xy, depth, surface), "moved, occluded or seen through")
    xy, depth = xy[agrees], depth[agrees]
    distance, _ = cKDTree(known.xy).query(xy)
    free = drops.keep(distance >= apart, "beside a point nearer in time")
    dropped = {
        why: known.dropped.get(why, 0) + drops.dropped.get(why, 0)
        for why in (*known.dropped, *(why for why in drops.dropped if why not in known.dropped))
    }
    return Points(
        xy=np.concatenate([known.xy, xy[free].astype(np.float32)]),
        depth=np.concatenate([known.depth, depth[free].astype(np.float32)]),
        size=known.size,
        dropped=dropped,
    )


def _agrees(xy: Floats, depth: Floats, surface: Surface) -> Mask:
    """(M,) true where a moved point agrees with the measured points around it."""
    measured = surface.points
    _, near = surface.tree.query(xy, k=min(_CONTRADICTING, len(measured)))
    near = near.reshape(len(xy), -1)
    apart = np.abs(np.log(depth[:, None] / measured.depth[near]))
    alike = apart[:, :_COMPARED] <= TOLERANCE
    offset = np.abs(measured.xy[near] - xy[:, None]) / surface.spacing_px
    contradicted = ((offset <= CLOSE).all(axis=2) & (apart > CONTRADICTION)).any(axis=1)
    agrees: Mask = (alike[:, 0] | (alike.sum(axis=1) >= _AGREEING)) & ~contradicted
    return agrees
