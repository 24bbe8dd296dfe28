"""Dense depth as a coloured point cloud with normals, cut where depth jumps or views disagree.

A pixel's point is seen in another view, whose own depth there gives a point that is seen back in
the first view. Both agree if it comes back to nearly the same pixel with nearly the same depth (as
MVSNet fuses depth maps: Yao et al., 2018, section 4.2).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera, Floats
from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.lens import pixels_of, rays_of_image
from pnpdepth_cli.sensors.projection import Mask, pixel_index

_EDGE = 0.05
"""Second difference of inverse depth, over the inverse depth, from which on depth jumps. On depth
maps of indoor and street scenes, it cuts silhouettes and keeps floors down to a grazing angle of
about 5 degrees."""

_NEIGHBOURS = 8  # views that a view is compared with at most
_WIDEST_DEG = 60.0  # widest angle between the axes of two cameras that see the same surfaces
_RETURN_PX = 2.0  # farthest from its pixel that a point comes back
_RETURN_DEPTH = 0.03  # largest difference of the depth that comes back, a fraction
_STRIP_PIXELS = 1 << 20  # whose points and normals are in memory at once


class PointCloud(NamedTuple):
    """N points with normals and colours."""

    xyz: NDArray[np.float32]
    """(N, 3) in the unit of the depth, in the camera's or the world's coordinates."""
    normals: NDArray[np.float32]
    """(N, 3) unit vectors towards the camera; 0 where a point has no two neighbours."""
    rgb: NDArray[np.uint8] | None  # (N, 3) colours 0…255. None: without colours.

    def transform(self, pose: Floats) -> PointCloud:
        """Returns the cloud in the coordinates that a pose leads to, such as those of the world.

        Args:
            pose: (3, 4) or (4, 4) from the cloud's coordinates, such as a camera's pose in the
                world; its translation is in the unit of the cloud.
        """
        xyz = _apply(self.xyz, pose[:3])
        normals = self.normals @ pose[:3, :3].T
        return PointCloud(xyz.astype(np.float32), normals.astype(np.float32), self.rgb)


View = tuple[NDArray[np.float32], Camera, Floats]
"""The points (H, W, 3) of a depth map in its camera's coordinates, 0 where depth is unknown; the
camera; and its pose (3, 4) in the world."""


def cloud_from_depth(
    depth: NDArray[np.float32], camera: Camera, rgb: NDArray[np.float32] | None = None
) -> Iterator[PointCloud]:
    """Yields the points of a depth map in the camera's coordinates, some rows of pixels at a time.

    Pixels beside a jump of depth are left out. The cloud is in the unit of the depth.

    Args:
        depth: (H, W), 0 = unknown.
        camera: Intrinsics and distortion of the image that the depth belongs to.
        rgb: (H, W, 3) in 0…1, the colours. None: the cloud has none.
    """
    is_kept = kept_pixels(depth)
    height, width = depth.shape
    rays = rays_of_image(camera, (height, width))
    rows = max(1, _STRIP_PIXELS // width)
    for top in range(0, height, rows):
        # A strip of rows, and one more above and below, as normals take neighbours.
        strip = slice(top, top + rows)
        around = slice(max(0, top - 1), strip.stop + 1)
        points = _points(depth[around], is_kept[around], rays[around])
        normals = _normals(points, is_kept[around])
        # The rows of the strip among these.
        inner = slice(top - around.start, strip.stop - around.start)
        kept = is_kept[strip]
        colours: NDArray[np.uint8] | None = None
        if rgb is not None:
            colours = np.rint(np.clip(rgb[strip][kept], 0, 1) * 255).astype(np.uint8)
        yield PointCloud(
            xyz=points[inner][kept].astype(np.float32),
            normals=normals[inner][kept].astype(np.float32),
            rgb=colours,
        )


def kept_pixels(depth: NDArray[np.float32], keep: Mask | None = None) -> Mask:
    """Returns (H, W) true for pixels of known depth that are not beside a jump of depth.

    `cloud_from_depth` makes points of them.

    Args:
        depth: (H, W); not finite, or <= 0, is unknown.
        keep: (H, W) true for pixels that may be kept. None: all.
    """
    is_known = _known_pixels(depth)
    if keep is not None:
        is_known &= keep
    return is_known & ~depth_edges(np.where(is_known, depth, 0))


def _known_pixels(depth: NDArray[np.float32]) -> Mask:
    """(H, W) true where depth is finite and above 0."""
    return np.asarray((depth > 0) & np.isfinite(depth))


def depth_edges(depth: NDArray[np.float32]) -> Mask:
    """Returns (H, W) true for pixels beside a jump of depth, on both of its sides.

    A jump is a second difference of inverse depth that is large beside the inverse depth. A plane
    has none, whatever its slope: inverse depth is linear in the pixel coordinates. Unknown depth
    makes no jump.

    Args:
        depth: (H, W) in any unit, 0 = unknown.
    """
    is_known = depth > 0
    inverse = np.where(is_known, 1 / np.where(is_known, depth, 1), np.nan)
    is_edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        along_axis = np.moveaxis(inverse, axis, 0)
        middle = along_axis[1:-1]
        bend = np.abs(along_axis[2:] - 2 * middle + along_axis[:-2])  # second difference
        is_jump = bend > _EDGE * middle  # false beside unknown pixels, which are NaN
        np.moveaxis(is_edge, axis, 0)[1:-1] |= is_jump  # a view: writes into `is_edge`
    return is_edge


def depth_normals(depth: NDArray[np.float32], camera: Camera) -> Floats:
    """Returns (H, W, 3) unit normals towards the camera; 0 where depth is unknown."""
    return _normals(points_of_depth(depth, camera), _known_pixels(depth))


def points_of_depth(depth: NDArray[np.float32], camera: Camera) -> Floats:
    """Returns (H, W, 3) points in the camera's coordinates, 0 where depth is unknown."""
    rays = rays_of_image(camera, (depth.shape[0], depth.shape[1]))
    return _points(depth, _known_pixels(depth), rays)


def _points(depth: NDArray[np.float32], is_known: Mask, rays: Floats) -> Floats:
    """(H, W, 3) points in the camera's coordinates, in the unit of the depth; 0 where unknown.

    Args:
        depth: (H, W) z; it is not read where it is unknown.
        is_known: (H, W) true where it is known.
        rays: (H, W, 2) x / z and y / z of the directions of the pixels.
    """
    z = depth[is_known].astype(np.float64)
    points = np.zeros((*depth.shape, 3))
    points[is_known] = np.column_stack([rays[is_known] * z[:, None], z])
    return points


def _normals(points: Floats, is_known: Mask) -> Floats:
    """Unit normals (H, W, 3) towards the camera, from the differences of neighbouring pixels.

    0 where a pixel has no known neighbour in one of the two directions.

    Args:
        points: (H, W, 3) points in the camera's coordinates, 0 where unknown.
        is_known: (H, W) true where a point is known.
    """
    down = _difference(points, is_known, axis=0)
    across = _difference(points, is_known, axis=1)
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals /= np.where(length > 0, length, 1)
    # The camera is the origin: a normal along a point's ray points away from it, and is reversed.
    is_away = (normals * points).sum(axis=2, keepdims=True) > 0
    return np.where(is_away, -normals, normals)


def _difference(points: Floats, is_known: Mask, axis: int) -> Floats:
    """Difference (H, W, 3) of each point's two neighbours along an axis, later − earlier.

    The point itself stands for a neighbour that is unknown, so the difference is 0 where both are.

    Args:
        points: (H, W, 3) points, 0 where unknown.
        is_known: (H, W) true where a point is known.
        axis: 0 for the neighbours above and below, 1 for those on the left and right.
    """
    points = np.moveaxis(points, axis, 0)
    is_known = np.moveaxis(is_known, axis, 0)
    before = points.copy()
    after = points.copy()
    are_known = is_known[1:] & is_known[:-1]  # both of two neighbours
    before[1:][are_known] = points[:-1][are_known]
    after[:-1][are_known] = points[1:][are_known]
    return np.moveaxis(after - before, 0, axis)


def merge_in_voxels(clouds: Iterable[PointCloud], side: float) -> PointCloud:
    """Returns one point for each occupied cube of space, the mean of all points of clouds in it.

    Points are sorted by cube; they have colours if all clouds do.

    Args:
        clouds: Clouds in one coordinate system; one at a time is in memory.
        side: Side of a cube, in the unit of the clouds.
    """
    cubes = np.zeros((0, 3), np.int64)
    # Of each cube, over its points: x y z, red green blue, x y z of the normals, and their number.
    sums = np.zeros((0, 10))
    has_colours = True
    for cloud in clouds:
        has_colours &= cloud.rgb is not None
        rgb = np.zeros(cloud.xyz.shape) if cloud.rgb is None else cloud.rgb
        ones = np.ones((len(cloud.xyz), 1))
        # The sums so far are added up again with the points of this cloud.
        summands = np.concatenate([sums, np.hstack([cloud.xyz, rgb, cloud.normals, ones])])
        cube_of_point = np.floor(cloud.xyz / side).astype(np.int64)
        cubes, index = np.unique(
            np.concatenate([cubes, cube_of_point]), axis=0, return_inverse=True
        )
        sums = np.zeros((len(cubes), 10))
        np.add.at(sums, index.reshape(-1), summands)
    # Means; those of normals are made unit vectors.
    xyz, rgb, normals = np.split(sums[:, :9] / sums[:, 9:], 3, axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(
        xyz=xyz.astype(np.float32),
        normals=(normals / np.where(length > 0, length, 1)).astype(np.float32),
        rgb=np.rint(rgb).astype(np.uint8) if has_colours else None,
    )


def neighbouring_views(poses: Floats, index: int) -> list[int]:
    """Returns the numbers of the views nearest to a view that look about the same way.

    They are at most `_NEIGHBOURS`, the nearest first.

    Args:
        poses: (N, 3, 4) poses of the views' cameras in the world, camera to world.
        index: Number 0 … N − 1 of the view, which is not among those returned.
    """
    distance = np.linalg.norm(poses[:, :, 3] - poses[index, :, 3], axis=1)
    # The third column of a pose is the direction in which its camera looks.
    is_alike = poses[:, :, 2] @ poses[index, :, 2] > np.cos(np.radians(_WIDEST_DEG))
    is_alike[index] = False
    nearest = np.argsort(np.where(is_alike, distance, np.inf), kind="stable")
    count = min(_NEIGHBOURS, np.count_nonzero(is_alike))
    return [int(view) for view in nearest[:count]]


def consistent_depth(here: View, others: Iterable[View], min_views: int) -> NDArray[np.float32]:
    """Returns (H, W) the mean depth of the views that agree with one, 0 where they are too few.

    Args:
        here: The view.
        others: Views that it is compared with.
        min_views: How many views have to agree, this one included.
    """
    points, camera, pose = here
    is_known = points[:, :, 2] > 0
    rows, columns = np.nonzero(is_known)
    xy = np.column_stack([columns, rows])
    depth = points[is_known][:, 2].astype(float)
    in_world = _apply(points[is_known], pose)
    # Depths that agree are added up, those of `here` first. Another view agrees where the point of
    # its depth map comes back to nearly the same pixel with nearly the same depth.
    total = depth.copy()
    count = np.ones(len(depth))
    for view in others:
        index, back = _project_back(in_world, pose, view)
        away_px = np.linalg.norm(pixels_of(camera, back) - xy[index], axis=1)
        is_same_depth = np.abs(back[:, 2] - depth[index]) <= _RETURN_DEPTH * depth[index]
        agrees = (away_px <= _RETURN_PX) & is_same_depth
        total[index[agrees]] += back[agrees, 2]
        count[index[agrees]] += 1
    mean_depth = np.zeros(is_known.shape, np.float32)
    mean_depth[is_known] = np.where(count >= min_views, total / count, 0)
    return mean_depth


def _project_back(in_world: Floats, here: Floats, other: View) -> tuple[NDArray[np.intp], Floats]:
    """Points of another view's depth map where it sees given points, in one camera's coordinates.

    Args:
        in_world: (N, 3) the points in the world.
        here: (3, 4) pose of the one camera in the world.
        other: The other view.

    Returns:
        (M,) the numbers of the given points at which the other view has known depth, in front of
        the one camera; and (M, 3) the points of its depth map there, in that camera's coordinates.
    """
    points, camera, pose = other
    # Where the other view sees the points.
    seen = _apply_inverse(in_world, pose)
    index = np.flatnonzero(seen[:, 2] > 0)
    xy = pixels_of(camera, seen[index])
    size = (points.shape[0], points.shape[1])
    inside = in_frame(xy, size)
    index = index[inside]
    # The points of its own depth map there, in the world, and in the coordinates of the one camera.
    met = points.reshape(-1, 3)[pixel_index(xy[inside], size)]
    back = _apply_inverse(_apply(met, pose), here)
    usable = (met[:, 2] > 0) & (back[:, 2] > 0)
    return index[usable], back[usable]


def _apply(points: NDArray[np.floating], pose: Floats) -> Floats:
    """The points (N, 3) of a camera in the world, by the camera's pose (3, 4)."""
    return np.asarray(points @ pose[:, :3].T + pose[:, 3])


def _apply_inverse(points: Floats, pose: Floats) -> Floats:
    """The points (N, 3) of the world in a camera's coordinates, by the camera's pose (3, 4)."""
    return np.asarray((points - pose[:, 3]) @ pose[:, :3])
