"""Motion between frames without poses, on the rendered drive of `samples/`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.poses import read_poses
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.motion import Keypoints, keypoints_of, motion_of_images
from pnpdepth_cli.sensors.pixels import Points
from tests.sensors.test_accumulation import CAMERA as ROOM_CAMERA
from tests.sensors.test_accumulation import room

DRIVE = Path(__file__).parents[2] / "samples/drive"
CAMERA = Camera(intrinsics=np.array([[360.77, 0, 304.53], [0, 360.77, 86.18], [0, 0, 1]]))


def points_of(number: int) -> Points:
    depth = read_depth(DRIVE / f"sparse/drive_{number:03}.png").values
    y, x = np.nonzero(depth)
    xy = np.column_stack([x, y]).astype(np.float32)
    return Points(xy=xy, depth=depth[y, x], size=(depth.shape[0], depth.shape[1]))


def image(number: int) -> Keypoints:
    return keypoints_of(read_rgb(DRIVE / f"rgb/drive_{number:03}.jpg").values)


def ahead_in_the_drive() -> float:
    return float(read_poses(DRIVE / "poses.txt")[1, 2, 3])


def test_the_motion_between_two_images_is_that_of_the_poses() -> None:
    estimate = motion_of_images(image(0), image(1), points_of(1), CAMERA)
    assert estimate.motion is not None
    np.testing.assert_allclose(estimate.motion[:, :3], np.eye(3), atol=2e-3)
    np.testing.assert_allclose(estimate.motion[:, 3], [0, 0, ahead_in_the_drive()], atol=0.03)
    assert estimate.basis.endswith("matches of the images")


def test_an_image_without_texture_gives_no_motion() -> None:
    blank = keypoints_of(np.full((187, 621, 3), 0.5, np.float32))
    assert (blank.xy.shape, blank.descriptors.shape) == ((0, 2), (0, 128))
    estimate = motion_of_images(blank, image(1), points_of(1), CAMERA)
    assert estimate.motion is None
    assert estimate.basis.startswith("0 matches")


def seen_from(points: Points, shift: tuple[float, float, float]) -> tuple[Keypoints, Keypoints]:
    """Keypoints at the points, as matched in a camera that has moved, and in their own image."""
    descriptors = np.random.default_rng(0).random((len(points), 128)).astype(np.float32)
    moved = unproject(ROOM_CAMERA, points.xy, points.depth) + np.array(shift)
    here = Keypoints(xy=pixels_of(ROOM_CAMERA, moved), descriptors=descriptors)
    return here, Keypoints(xy=points.xy.astype(np.float64), descriptors=descriptors)


def test_a_motion_beyond_the_median_depth_is_refused() -> None:
    points = room((0, 0, 0), None, 0, count=400)
    median = float(np.median(points.depth))
    estimate = motion_of_images(*seen_from(points, (0.5, 0, 0)), points, ROOM_CAMERA)
    assert estimate.motion is not None
    np.testing.assert_allclose(estimate.motion[:, 3], [0.5, 0, 0], atol=1e-3)
    estimate = motion_of_images(*seen_from(points, (1.5 * median, 0, 0)), points, ROOM_CAMERA)
    assert estimate.motion is None
    assert "of motion at a median depth of" in estimate.basis
