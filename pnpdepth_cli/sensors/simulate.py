"""Points that a LiDAR would measure in a scene of which a camera's dense depth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.lidar import Lidar
from pnpdepth_cli.sensors.sparse import FARTHEST_M, DropCounter, Floats, Mask, Points, pixel_index

_SAME_SURFACE = 1.1
"""Neighbouring pixels whose depths are within this ratio belong to one surface."""

_FIRST_M = 0.01
"""Metres ahead of the scanner at which its beams can first hit a surface."""

_LONGEST_WALK = 2048
"""Steps; beams that cross more pixels, close to the scanner, take longer steps."""


def simulate_lidar(depth: NDArray[np.floating], camera: Camera, sensor: Lidar, seed: int) -> Points:
    """Returns sparse depth of one revolution of the scanner, in the image of the dense depth.

    Args:
        depth: (H, W) metres along the camera's axis, 0 = unknown.
        camera: Intrinsics, and the scanner's pose (`FORWARD_LEFT_UP` and zero: at the camera).
        sensor: The scanner, with its noise.
        seed: Of all noise; the same seed gives the same points.

    Raises:
        NoPointsError: No beam hits anything that the camera sees.
    """
    size = (depth.shape[0], depth.shape[1])
    rng = np.random.default_rng(seed)
    turned = _rotated(camera, sensor.rotation_noise_deg, rng)
    beams = sensor.directions(rng) @ turned.rotation.T
    drops = DropCounter(len(beams))
    z = _depth_at_first_hit(np.asarray(depth, np.float64), turned, beams)
    met = drops.keep(np.isfinite(z), "meets nothing that the camera sees")
    distance = (z[met] - camera.translation[2]) / beams[met, 2]
    kept = drops.keep(distance <= sensor.max_range, "out of range")
    returned = drops.keep(rng.random(np.count_nonzero(kept)) >= sensor.dropout, "dropped out")
    distance, beams = distance[kept][returned], beams[met][kept][returned]
    if sensor.range_noise > 0:
        distance = distance + rng.normal(0, sensor.range_noise, len(distance))
    points = camera.translation + beams * distance[:, None]
    ahead = drops.keep((distance > 0) & (points[:, 2] > 0), "noise put it behind the camera")
    points = points[ahead]
    near = np.abs(points).max(axis=1, initial=0) < FARTHEST_M
    if not near.all():
        points = points[drops.keep(near, "noise put it too far")]
    points, xy = drops.keep_seen(points, camera.pixels_of(points), size)
    if not len(xy):
        raise NoPointsError(
            f"no beam of {sensor.name} gives a point in the image ({drops}); check depth,"
            " intrinsics and where the scanner stands"
        )
    return Points(
        xy=xy.astype(np.float32),
        depth=points[:, 2].astype(np.float32),
        size=size,
        dropped=drops.dropped,
    )


def _rotated(camera: Camera, std_deg: float, rng: np.random.Generator) -> Camera:
    """The camera with the scanner rotated at random about its own origin."""
    if std_deg == 0:
        return camera
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", rng.normal(0, std_deg, 3), degrees=True)
    return replace(camera, rotation=camera.rotation @ turn.as_matrix())


def _depth_at_first_hit(depth: Floats, camera: Camera, directions: Floats) -> Floats:
    """(M,) depth z at which each beam first hits the depth map; NaN where it does not.

    directions are (M, 3) unit vectors in the camera's frame, from the scanner's origin. A beam is
    followed outwards in steps of about a pixel. One that passes behind an edge has no hit, because
    the camera does not see what is there.
    """
    hit = np.full(len(directions), np.nan)
    known = depth[depth > 0]
    start = camera.translation
    if not known.size:
        return hit
    near, far = max(0.999 * known.min(), start[2] + _FIRST_M), 1.001 * known.max()
    if far <= near:
        return hit
    # The others never get beyond `near`.
    forward = np.flatnonzero(directions[:, 2] > 1e-9)
    beams = directions[forward]
    depths_z = 1 / np.linspace(1 / near, 1 / far, _walk_length(camera, beams, near, far, depth) + 1)
    before_z, before_map = near, np.full(len(forward), np.inf)
    been_inside = np.zeros(len(forward), bool)
    walking = np.arange(len(forward))
    for z in depths_z:
        ahead, inside = _map_at(depth, camera, _reached(start, beams[walking], z))
        met = (ahead > 0) & (z >= ahead)
        same = before_map[walking] <= _SAME_SURFACE * ahead
        straight_on = met & (before_z <= ahead)
        slanted = met & ~straight_on & same
        hit[forward[walking[straight_on]]] = ahead[straight_on]
        gap_before = before_map[walking[slanted]] - before_z
        fraction = gap_before / (gap_before + z - ahead[slanted])
        hit[forward[walking[slanted]]] = before_z + fraction * (z - before_z)
        before_map[walking] = np.where(ahead > 0, ahead, np.inf)
        before_z = z
        left = been_inside[walking] & ~inside  # a straight line never re-enters the image
        been_inside[walking] |= inside
        walking = walking[~(met | left)]
    return _on_their_surface(hit, depth, camera, directions)


def _on_their_surface(hit: Floats, depth: Floats, camera: Camera, beams: Floats) -> Floats:
    """The hits whose own pixel shows that surface; NaN for one that grazed an edge by a pixel."""
    index = np.flatnonzero(np.isfinite(hit))
    z, start = hit[index], camera.translation
    shown, _ = _map_at(depth, camera, _reached(start, beams[index], z))
    same = (z <= _SAME_SURFACE * shown) & (shown <= _SAME_SURFACE * z)
    checked = hit.copy()
    checked[index[~same]] = np.nan
    return checked


def _walk_length(camera: Camera, beams: Floats, near: float, far: float, depth: Floats) -> int:
    """The number of steps in which no beam in the image moves by more than a pixel."""
    start = camera.translation
    ends = [camera.pixels_of(_reached(start, beams, z)) for z in (near, far)]
    size = depth.shape[0], depth.shape[1]
    seen = in_frame(ends[0], size) | in_frame(ends[1], size)
    if not seen.any():
        return 1
    moved = np.hypot(*(ends[1] - ends[0])[seen].T)
    return int(min(max(1, np.ceil(np.nanmax(moved, initial=0))), _LONGEST_WALK))


def _reached(start: Floats, beams: Floats, z: float | Floats) -> Floats:
    """The points (M, 3) at which beams from a point have the depth z."""
    return np.asarray(start + beams * ((z - start[2]) / beams[:, 2])[:, None])


def _map_at(depth: Floats, camera: Camera, points: Floats) -> tuple[Floats, Mask]:
    """(M,) depth map at the pixels of points, 0 outside the image; and (M,) whether inside."""
    xy = camera.pixels_of(points)
    size = (depth.shape[0], depth.shape[1])
    inside = in_frame(xy, size)
    values = np.zeros(len(points))
    values[inside] = depth.ravel()[pixel_index(xy[inside], size)]
    return values, inside
