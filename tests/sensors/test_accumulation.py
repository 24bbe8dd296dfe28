"""Points of neighbouring scans, and the motion to them: by poses, surfaces and images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.io.point_files import read_sparse
from pnpdepth_cli.io.poses import read_poses
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.sensors.accumulation import (
    Keypoints,
    accumulate,
    keypoints_of,
    motion_of_images,
    refine_motion,
)
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.projection import Points

SIZE = (120, 160)
CAMERA = Camera(intrinsics=np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]))


Shift = tuple[float, float, float]


def room(position: Shift = (0, 0, 0), box_x: float | None = None, *, seed: int) -> Points:
    """What a camera at a position sees: two walls, a floor, and a box 4 m away, if any."""
    pixels = np.random.default_rng(seed).permutation(SIZE[0] * SIZE[1])[:3000]
    xy = np.column_stack([pixels % SIZE[1], pixels // SIZE[1]]).astype(np.float32)
    depth = depth_of_walls(xy, position)
    shift = np.array(position)
    if box_x is not None:
        at = unproject(CAMERA, xy, np.full(3000, 4 - shift[2]))[:, :2] + shift[:2]
        on_box = (np.abs(at - (box_x, 0)) < 0.5).all(axis=1)
        depth = np.where(on_box, 4 - shift[2], depth)
    return Points(xy=xy, depth=depth.astype(np.float32), size=SIZE)


def depth_of_walls(xy: NDArray[np.float32], position: Shift = (0, 0, 0)) -> NDArray[np.float64]:
    """A wall 8 m ahead, one 2 m to the left, and a floor 1.5 m below the origin."""
    x, y, _ = unproject(CAMERA, xy, np.ones(len(xy))).T
    with np.errstate(divide="ignore"):
        left = np.where(x < 0, (-2 - position[0]) / x, np.inf)
        floor = np.where(y > 0, (1.5 - position[1]) / y, np.inf)
    return np.minimum(np.minimum(left, floor), 8 - position[2])


def from_ahead(metres: float) -> NDArray[np.float64]:
    """The motion from a camera that is so far ahead to this one."""
    return np.column_stack([np.eye(3), [0, 0, metres]])


def test_moved_points_lie_on_the_surfaces_of_the_frame() -> None:
    own = room(seed=0)
    ahead = room((0, 0, 0.5), seed=1)
    both = accumulate(own, {1: [(ahead, from_ahead(0.5))]}, CAMERA)
    assert both.xy[: len(own)].tobytes() == own.xy.tobytes()
    assert both.depth[: len(own)].tobytes() == own.depth.tobytes()
    moved = both.xy[len(own) :]
    assert len(moved) > 1000
    assert np.median(np.abs(both.depth[len(own) :] / depth_of_walls(moved) - 1)) < 1e-3


def test_points_of_a_moved_object_are_dropped() -> None:
    own = room(box_x=-1.0, seed=0)
    later = room(box_x=1.0, seed=1)
    both = accumulate(own, {1: [(later, from_ahead(0))]}, CAMERA)
    moved, depth = both.xy[len(own) :], both.depth[len(own) :]
    at = (moved - (79.5, 59.5)) / 150 * 4
    on_old_box = (np.abs(at - (1, 0)) < 0.4).all(axis=1)
    assert (later.depth == 4).sum() > 100
    assert not (depth[on_old_box] < 4.5).any()
    assert len(moved) < len(later) - 100


def test_a_scan_farther_in_time_is_replaced_by_a_nearer_one() -> None:
    own, one, two = (room(seed=seed) for seed in range(3))
    near, far = {1: [(one, from_ahead(0))]}, {2: [(two, from_ahead(0))]}
    with_near, with_both = (accumulate(own, points, CAMERA) for points in (near, far | near))
    kept = with_both.xy[: len(with_near)]
    assert kept.tobytes() == with_near.xy.tobytes()
    more = with_both.xy[len(with_near) :]
    distance = np.linalg.norm(more[:, None] - with_near.xy[None], axis=2).min(axis=1)
    assert distance.min() >= 2


@pytest.mark.parametrize("seen", [0, 1])
@pytest.mark.parametrize("count", [1, 5, 3000])
def test_a_scan_that_sees_little_of_the_view_adds_what_agrees(seen: int, count: int) -> None:
    own = room(seed=0).select(slice(count))
    turned_away = np.column_stack([np.diag([-1.0, 1.0, -1.0]), np.zeros(3)])
    behind = own.select(slice(0))
    ahead = own.select(slice(seen))
    scans = [(room(seed=1), turned_away), (behind, from_ahead(0)), (ahead, from_ahead(0))]
    both = accumulate(own, {1: scans}, CAMERA)
    assert both.xy.tobytes() == own.xy.tobytes()  # the one that agrees lies on a measured pixel
    assert both.depth.tobytes() == own.depth.tobytes()


def test_an_inaccurate_motion_is_corrected_by_the_surfaces() -> None:
    own = room(box_x=-1.0, seed=0)
    ahead = room((0, 0, 0.5), -1.0, seed=1)
    xyz = unproject(CAMERA, ahead.xy, ahead.depth)
    motion = refine_motion(own, xyz, from_ahead(0.6), CAMERA)
    np.testing.assert_allclose(motion[:, :3], np.eye(3), atol=2e-3)
    assert abs(motion[2, 3] - 0.5) < 0.01


DRIVE = Path(__file__).parents[2] / "samples/drive"
DRIVE_CAMERA = Camera(intrinsics=np.array([[360.77, 0, 304.53], [0, 360.77, 86.18], [0, 0, 1]]))


def image(number: int) -> Keypoints:
    return keypoints_of(read_rgb(DRIVE / f"rgb/drive_{number:03}.jpg").values)


def test_the_motion_between_two_images_is_that_of_the_poses() -> None:
    points, _ = read_sparse(DRIVE / "sparse/drive_001.png")
    motion, _ = motion_of_images(image(0), image(1), points, DRIVE_CAMERA)
    ahead = float(read_poses(DRIVE / "poses.txt")[1, 2, 3])
    np.testing.assert_allclose(motion, from_ahead(ahead), atol=0.03)
    np.testing.assert_allclose(motion[:, :3], np.eye(3), atol=2e-3)
    blank = keypoints_of(np.full((187, 621, 3), 0.5, np.float32))
    motion, basis = motion_of_images(blank, image(1), points, DRIVE_CAMERA)
    assert motion is None
    assert basis.startswith("0 matches")


def test_a_motion_beyond_the_median_depth_is_refused() -> None:
    points = room(seed=0).select(slice(400))
    descriptors = np.random.default_rng(0).random((400, 128)).astype(np.float32)
    xyz = unproject(CAMERA, points.xy, points.depth)
    own = points.xy.astype(np.float64)
    for share, refused in ((0.1, False), (1.5, True)):
        shift = [share * float(np.median(points.depth)), 0, 0]
        shown = pixels_of(CAMERA, xyz + shift)
        motion, _ = motion_of_images((shown, descriptors), (own, descriptors), points, CAMERA)
        assert (motion is None) == refused
        if motion is not None:
            np.testing.assert_allclose(motion[:, 3], shift, atol=1e-3)
