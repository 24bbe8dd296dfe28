"""Depth that neighbouring views agree on.

A pixel's point is seen in another view, whose own depth there gives a point that is seen back in
the first view. Both agree if it comes back to nearly the same pixel with nearly the same depth (as
MVSNet fuses depth maps: Yao et al., 2018, section 4.2).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.sparse import Floats, pixel_index

_NEIGHBOURS = 8
_WIDEST_DEG = 60.0
"""Between the axes of two cameras that see the same surfaces."""

_RETURN_PX = 2.0
_RETURN_DEPTH = 0.03
"""Largest differences of a pixel and of its depth, as a fraction, that agree."""


@dataclass(frozen=True, kw_only=True)
class View:
    """A depth map with its camera."""

    depth: NDArray[np.float32]
    """(H, W), 0 = unknown."""
    camera: Camera
    pose: Floats
    """(3, 4) from the camera's frame to the world's."""


def neighbouring_views(poses: Floats, index: int) -> list[int]:
    """Returns the views, of poses (N, 3, 4), nearest to one that look about the same way."""
    distance = np.linalg.norm(poses[:, :, 3] - poses[index, :, 3], axis=1)
    alike = poses[:, :, 2] @ poses[index, :, 2] > np.cos(np.radians(_WIDEST_DEG))
    alike[index] = False
    nearest = np.argsort(np.where(alike, distance, np.inf), kind="stable")
    return [int(each) for each in nearest[: min(_NEIGHBOURS, np.count_nonzero(alike))]]


def consistent_depth(here: View, others: Iterable[View], min_views: int) -> NDArray[np.float32]:
    """Returns the mean depth of the views that agree with one, 0 where they are fewer.

    `min_views` have to agree, this one included.
    """
    known = (here.depth > 0) & np.isfinite(here.depth)
    rows, columns = np.nonzero(known)
    xy, depth = np.column_stack([columns, rows]).astype(np.float64), here.depth[known].astype(float)
    world = _moved(here.camera.unproject(xy, depth), here.pose)
    total, count = depth.copy(), np.ones(len(depth))
    for other in others:
        index, back = _seen_back(world, here, other)
        away = np.linalg.norm(here.camera.pixels_of(back) - xy[index], axis=1)
        same = np.abs(back[:, 2] - depth[index]) <= _RETURN_DEPTH * depth[index]
        agrees = (away <= _RETURN_PX) & same
        total[index[agrees]] += back[agrees, 2]
        count[index[agrees]] += 1
    result = np.zeros(here.depth.shape, np.float32)
    result[known] = np.where(count >= min_views, total / count, 0)
    return result


def _seen_back(world: Floats, here: View, other: View) -> tuple[NDArray[np.intp], Floats]:
    """The points that another view has a depth of, and its own points there in this one's frame."""
    seen = _moved_back(world, other.pose)
    index = np.flatnonzero(seen[:, 2] > 0)
    xy = other.camera.pixels_of(seen[index])
    size = (other.depth.shape[0], other.depth.shape[1])
    inside = in_frame(xy, size)
    index, xy = index[inside], xy[inside]
    depth = other.depth.ravel()[pixel_index(xy, size)]
    has_depth = (depth > 0) & np.isfinite(depth)
    index, points = index[has_depth], other.camera.unproject(xy[has_depth], depth[has_depth])
    back = _moved_back(_moved(points, other.pose), here.pose)
    return index[back[:, 2] > 0], back[back[:, 2] > 0]


def _moved(points: Floats, pose: Floats) -> Floats:
    return np.asarray(points @ pose[:, :3].T + pose[:, 3])


def _moved_back(points: Floats, pose: Floats) -> Floats:
    return np.asarray((points - pose[:, 3]) @ pose[:, :3])
