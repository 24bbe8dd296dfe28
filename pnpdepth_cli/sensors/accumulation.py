"""Points of neighbouring scans, moved into a frame by the camera's motion.

The motion is corrected until the surfaces of both scans coincide, by point-to-plane registration
(Chen and Medioni, "Object modelling by registration of multiple range images", 1992) with the
weights of Geman and McClure. Distances are fractions of the depth, as errors of the sensor and of
the pose are.

A moved point is compared with the measured points of the frame. It is kept where the nearest, or
two of the nearest four, have about the same depth, and where none close by contradicts it. So three
kinds of points are dropped: of something that has moved since, occluded in the frame, and seen
through by the frame's own scanner. Scans nearer in time count more. A point is dropped where a
point of the frame, or of a scan nearer in time, lies within as many pixels as frames are between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.pixels import Floats, Mask, Points

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_TOLERANCE = 0.05
"""Difference of log depth to a measured point; chosen on frames 2 and 4 of a KITTI drive."""
_CONTRADICTION = 0.1
"""Difference of log depth that contradicts; chosen, as `_CLOSE`, on frames 0, 2, 4, 6 of it."""
_CLOSE = (0.55, 0.37)
"""Distance across and down within which a measured point contradicts, in mean spacings. Down it is
less, as the next scan line of a LiDAR lies at another depth."""

_COMPARED, _AGREEING = 4, 2  # measured points beside a moved one, of which so many agree
_CONTRADICTING = 12  # nearest measured points, of which none contradicts

_MIN_PLANES = 200  # pairs of a point and a plane; with fewer the motion is not corrected
_STEPS = 8
_NEIGHBOURS = 8  # points that a plane is fitted to,
_NEAR = 0.1  # whose depth differs by this fraction at most,
_FLAT = 0.02  # and whose smallest variance is below this fraction of the next
_REACH = 1.2  # mean spacings of the points, between a point and the one it is compared with
_LEAST_ERROR = 2e-4  # typical distance, fraction of the depth
_NORMAL_MEDIAN = 1.4826  # standard deviation over median of |x|, normal errors


@dataclass(frozen=True, kw_only=True)
class NeighbourScan:
    """The points of another frame of the sequence."""

    points: Points  # in the other frame's image
    motion: Floats  # (3, 4) from the other camera's coordinates to this one's, metres
    apart: int  # frames between the two, at least 1


@dataclass(frozen=True, kw_only=True)
class Surface:
    """N points of a scan with the planes through their neighbours."""

    points: Points
    xyz: Floats  # (N, 3) metres in the camera's coordinates
    normal: Floats  # (N, 3) unit vectors
    flat: Mask  # (N,) where the neighbours lie on a plane
    tree: cKDTree  # of the pixel coordinates

    @property
    def spacing_px(self) -> float:
        """Side of the square that each point has in the mean, in pixels."""
        height, width = self.points.size
        return float(np.sqrt(height * width / len(self.points)))


def accumulate(points: Points, neighbours: Sequence[NeighbourScan], camera: Camera) -> Points:
    """Returns the frame's own points followed by those of its neighbours that agree with them."""
    surface, result = surface_of(points, camera), points
    for apart in sorted({scan.apart for scan in neighbours}):
        moved = []
        for scan in neighbours:
            if scan.apart == apart:
                xyz = unproject(camera, scan.points.xy, scan.points.depth)
                motion = refine_motion(surface, xyz, scan.motion, camera)
                moved.append(xyz @ motion[:, :3].T + motion[:, 3])
        result = _add(result, np.concatenate(moved), surface, camera, apart)
    return result


def _add(known: Points, xyz: Floats, surface: Surface, camera: Camera, apart: int) -> Points:
    """The points known so far, joined by those of `xyz` (M, 3) that agree with measured ones."""
    from scipy.spatial import cKDTree

    xyz, xy = _in_image(xyz, camera, known.size)
    depth = xyz[:, 2]
    agrees = _agrees(xy, depth, surface)
    xy, depth = xy[agrees], depth[agrees]
    free = cKDTree(known.xy).query(xy)[0] >= apart
    return replace(
        known,
        xy=np.concatenate([known.xy, xy[free].astype(np.float32)]),
        depth=np.concatenate([known.depth, depth[free].astype(np.float32)]),
    )


def _in_image(xyz: Floats, camera: Camera, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """The points (M, 3) that the camera sees, and their pixel coordinates."""
    xyz = xyz[xyz[:, 2] > 0]
    xy = pixels_of(camera, xyz)
    inside = in_frame(xy, size)
    return xyz[inside], xy[inside]


def _agrees(xy: Floats, depth: Floats, surface: Surface) -> Mask:
    """(M,) true where a moved point agrees with the measured points around it."""
    measured = surface.points
    _, near = surface.tree.query(xy, k=min(_CONTRADICTING, len(measured)))
    near = near.reshape(len(xy), -1)
    apart = np.abs(np.log(depth[:, None] / measured.depth[near]))
    alike = apart[:, :_COMPARED] <= _TOLERANCE
    offset = np.abs(measured.xy[near] - xy[:, None]) / surface.spacing_px
    contradicted = ((offset <= _CLOSE).all(axis=2) & (apart > _CONTRADICTION)).any(axis=1)
    agrees: Mask = (alike[:, 0] | (alike.sum(axis=1) >= _AGREEING)) & ~contradicted
    return agrees


def surface_of(points: Points, camera: Camera) -> Surface:
    """Returns the points with a plane through the neighbours of each."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points.xy)
    _, near = tree.query(points.xy, k=min(_NEIGHBOURS, len(points)))
    near = near.reshape(len(points), -1)
    xyz = unproject(camera, points.xy, points.depth)
    around = xyz[near] - xyz[near].mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    jump = np.abs(np.log(points.depth[near] / points.depth[:, None])).max(axis=1)
    flat = (variance[:, 0] < _FLAT * variance[:, 1]) & (jump < _NEAR)
    return Surface(points=points, xyz=xyz, normal=axes[:, :, 0], flat=flat, tree=tree)


def refine_motion(surface: Surface, xyz: Floats, motion: Floats, camera: Camera) -> Floats:
    """Returns the motion (3, 4) that puts points (M, 3) on a surface; the given one if that fails.

    Points are in the other camera's coordinates. The motion leads from there to the surface's.
    """
    from scipy.spatial.transform import Rotation

    given = motion
    for _ in range(_STEPS):
        # Pairs of a moved point and a plane, and how far apart they are.
        moved, index = _pairs(surface, xyz @ motion[:, :3].T + motion[:, 3], camera)
        if len(index) < _MIN_PLANES:
            return given
        normal, depth = surface.normal[index], surface.xyz[index, 2]
        distance = np.einsum("ij,ij->i", moved - surface.xyz[index], normal) / depth
        # A step of weighted least squares towards the planes.
        typical = max(_NORMAL_MEDIAN * float(np.median(np.abs(distance))), _LEAST_ERROR)
        weight = (1 + (distance / (2 * typical)) ** 2) ** -2
        slope = np.column_stack([np.cross(moved, normal), normal]) / depth[:, None]
        weighted = slope * weight[:, None]
        step = -np.linalg.lstsq(weighted.T @ slope, weighted.T @ distance, rcond=None)[0]
        motion = Rotation.from_rotvec(step[:3]).as_matrix() @ motion
        motion[:, 3] += step[3:]
    return motion


def _pairs(surface: Surface, moved: Floats, camera: Camera) -> tuple[Floats, NDArray[np.intp]]:
    """The points in the image with a plane beside them, and the index of that plane."""
    moved, xy = _in_image(moved, camera, surface.points.size)
    distance, index = surface.tree.query(xy, distance_upper_bound=_REACH * surface.spacing_px)
    near = np.isfinite(distance)
    near[near] &= surface.flat[index[near]]
    return moved[near], index[near]
