"""Depth that neighbouring views agree on.

A pixel's point is seen in another view, whose own depth there gives a point that is seen back in
the first view. Both agree if it comes back to nearly the same pixel with nearly the same depth (as
MVSNet fuses depth maps: Yao et al., 2018, section 4.2).
"""

from __future__ import annotations

import functools
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

    @functools.cached_property
    def known(self) -> NDArray[np.intp]:
        """(N,) row-major indices of the pixels with known depth."""
        return np.flatnonzero((self.depth > 0) & np.isfinite(self.depth))

    @functools.cached_property
    def points(self) -> NDArray[np.float32]:
        """(H·W, 3) point of each pixel in the camera's frame, 0 where unknown."""
        rows, columns = np.divmod(self.known, self.depth.shape[1])
        points = np.zeros((self.depth.size, 3), np.float32)
        xy, depth = np.column_stack([columns, rows]), self.depth.ravel()[self.known]
        points[self.known] = self.camera.unproject(xy, depth)
        return points


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
    rows, columns = np.divmod(here.known, here.depth.shape[1])
    xy, depth = np.column_stack([columns, rows]), here.depth.ravel()[here.known].astype(float)
    world = _moved(here.points[here.known], here.pose)
    total, count = depth.copy(), np.ones(len(depth))
    for other in others:
        index, back = _seen_back(world, here, other)
        away = np.linalg.norm(here.camera.pixels_of(back) - xy[index], axis=1)
        same = np.abs(back[:, 2] - depth[index]) <= _RETURN_DEPTH * depth[index]
        agrees = (away <= _RETURN_PX) & same
        total[index[agrees]] += back[agrees, 2]
        count[index[agrees]] += 1
    result = np.zeros(here.depth.size, np.float32)
    result[here.known] = np.where(count >= min_views, total / count, 0)
    return result.reshape(here.depth.shape)


def _seen_back(world: Floats, here: View, other: View) -> tuple[NDArray[np.intp], Floats]:
    """The points that another view has a depth of, and its own points there in this one's frame."""
    seen = _moved_back(world, other.pose)
    index = np.flatnonzero(seen[:, 2] > 0)
    xy = other.camera.pixels_of(seen[index])
    size = (other.depth.shape[0], other.depth.shape[1])
    inside = in_frame(xy, size)
    index, points = index[inside], other.points[pixel_index(xy[inside], size)]
    back = _moved_back(_moved(points, other.pose), here.pose)
    usable = (points[:, 2] > 0) & (back[:, 2] > 0)
    return index[usable], back[usable]


def _moved(points: NDArray[np.floating], pose: Floats) -> Floats:
    return np.asarray(points @ pose[:, :3].T + pose[:, 3])


def _moved_back(points: Floats, pose: Floats) -> Floats:
    return np.asarray((points - pose[:, 3]) @ pose[:, :3])
