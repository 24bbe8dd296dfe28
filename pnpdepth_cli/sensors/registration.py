"""The motion between two scans, corrected until their surfaces coincide.

Point-to-plane registration (Chen and Medioni, "Object modelling by registration of multiple range
images", 1992) with the weights of Geman and McClure. Each point is compared with the nearest one in
the image. Distances are fractions of the depth, as errors of the sensor and of the pose are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.sparse import Mask, Points

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Floats = NDArray[np.float64]

MIN_PLANES = 200
"""Pairs of a point and a plane; with fewer the motion is not corrected."""

_STEPS = 8
_NEIGHBOURS = 8  # points that a plane is fitted to,
_NEAR = 0.1  # whose depth differs by this fraction at most,
_FLAT = 0.02  # and whose smallest variance is below this fraction of the next
_REACH = 1.2  # mean spacings of the points, between a point and the one it is compared with
_LEAST_ERROR = 2e-4  # typical distance, fraction of the depth
_NORMAL_MEDIAN = 1.4826  # standard deviation over median of |x|, normal errors


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Points of a scan with the planes through their neighbours."""

    points: Points
    """Sparse depth."""
    xyz: Floats
    """(N, 3) metres in the camera's frame."""
    normal: Floats
    """(N, 3) unit normals."""
    flat: Mask
    """(N,) true where the neighbours lie on a plane."""
    tree: cKDTree
    """Of the pixel coordinates."""

    @property
    def spacing_px(self) -> float:
        """Side of the square that each point has in the mean, in pixels."""
        height, width = self.points.size
        return float(np.sqrt(height * width / len(self.points)))


def surface_of(points: Points, camera: Camera) -> Surface:
    """Returns the points with a plane through the neighbours of each."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points.xy)
    _, near = tree.query(points.xy, k=min(_NEIGHBOURS, len(points)))
    near = near.reshape(len(points), -1)
    xyz = camera.unproject(points.xy, points.depth)
    around = xyz[near] - xyz[near].mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    jump = np.abs(np.log(points.depth[near] / points.depth[:, None])).max(axis=1)
    return Surface(
        points=points,
        xyz=xyz,
        normal=axes[:, :, 0],
        flat=(variance[:, 0] < _FLAT * variance[:, 1]) & (jump < _NEAR),
        tree=tree,
    )


def registered(surface: Surface, xyz: Floats, motion: Floats, camera: Camera) -> Floats:
    """Returns the motion (3, 4) that puts points on a surface; the given one if that fails.

    Args:
        surface: Of the frame.
        xyz: (M, 3) points, metres in the other camera's frame.
        motion: (3, 4) about from the other camera's frame to this one's.
        camera: Intrinsics of both.
    """
    from scipy.spatial.transform import Rotation

    best, least = motion, np.inf
    for _ in range(_STEPS + 1):
        moved = xyz @ motion[:, :3].T + motion[:, 3]
        moved, index = _pairs(surface, moved, camera)
        if len(index) < MIN_PLANES:
            return best
        normal, depth = surface.normal[index], surface.xyz[index, 2]
        distance = np.einsum("ij,ij->i", moved - surface.xyz[index], normal) / depth
        typical = max(_NORMAL_MEDIAN * float(np.median(np.abs(distance))), _LEAST_ERROR)
        if typical < least:
            best, least = motion, typical
        weight = (1 + (distance / (2 * typical)) ** 2) ** -2
        slope = np.column_stack([np.cross(moved, normal), normal]) / depth[:, None]
        weighted = slope * weight[:, None]
        step = -np.linalg.lstsq(weighted.T @ slope, weighted.T @ distance, rcond=None)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        motion = turn @ motion
        motion[:, 3] += step[3:]
    return best


def _pairs(surface: Surface, moved: Floats, camera: Camera) -> tuple[Floats, NDArray[np.intp]]:
    """The points in the image with a plane beside them, and the index of that plane."""
    moved = moved[moved[:, 2] > 0]
    xy = camera.pixels_of(moved)
    inside = in_frame(xy, surface.points.size)
    moved, xy = moved[inside], xy[inside]
    distance, index = surface.tree.query(xy, distance_upper_bound=_REACH * surface.spacing_px)
    near = np.isfinite(distance)
    near[near] &= surface.flat[index[near]]
    return moved[near], index[near]
