from __future__ import annotations

import numpy as np

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.sensors.lens import pixels_of
from pnpdepth_cli.sensors.lidar import FORWARD_LEFT_UP
from pnpdepth_cli.sensors.pixels import as_depth_image
from pnpdepth_cli.sensors.projection import project_velodyne

K = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
SIZE = (80, 101)


CAMERA = Camera(intrinsics=K)
HERE = Extrinsics(FORWARD_LEFT_UP, np.zeros(3))


def test_a_scan_projects_as_computed_by_hand() -> None:
    # The scanner (x forward, y left, z up) is 0.5 m left of, 1 m above, 2 m behind the camera.
    behind = Extrinsics(FORWARD_LEFT_UP, np.array([-0.5, -1.0, -2.0]))
    scan = np.array(
        [
            [12.0, 0.0, 0.0, 0.3],  # camera (-0.5, -1, 10): u = 50 - 5, v = 40 - 10
            [7.0, -1.25, -1.5, 0.3],  # camera (0.75, 0.5, 5): u = 50 + 15, v = 40 + 10
            [6.0, -0.58, -1.06, 0.3],  # camera (0.08, 0.06, 4): u = 52, v = 41.5
            [1.0, 0.0, 0.0, 0.3],  # camera z = -1
            [12.0, 9.0, 0.0, 0.3],  # camera (-9.5, ., 10): u = -45
        ]
    )
    got = project_velodyne(scan, CAMERA, behind, SIZE, keep_occluded=True)
    np.testing.assert_allclose(got.xy, [[45, 30], [65, 50], [52, 41.5]], atol=1e-5)
    np.testing.assert_allclose(got.depth, [10, 5, 4], rtol=1e-6)
    assert got.dropped == {
        "behind the camera": 1,
        "outside the image": 1,
        "behind another in their pixel": 0,
    }


def test_of_two_points_on_a_pixel_the_nearer_wins_and_keeps_its_subpixel_position() -> None:
    scan = np.array([[20.0, 0.02, 0.0], [10.0, 0.03, 0.0], [10.0, 1.0, 0.0]])
    got = project_velodyne(scan, CAMERA, HERE, SIZE, keep_occluded=True)
    np.testing.assert_allclose(got.depth, [10, 10], rtol=1e-6)
    np.testing.assert_allclose(got.xy[0], [49.7, 40], atol=1e-5)
    assert got.dropped["behind another in their pixel"] == 1
    assert as_depth_image(got)[40, 50] == 10


def test_a_lens_model_does_not_fold_points_from_outside_into_the_image() -> None:
    # 1 - 0.4 r² turns back at r = 0.91: a point at r = 1.58 would land on the axis
    eye = Camera(intrinsics=K, distortion=(-0.4, 0.0, 0.0, 0.0))
    folded = np.array([[10.0, 15.8, 0.0]])
    assert np.isnan(pixels_of(eye, HERE.apply(folded))).all()
    inside = np.array([[10.0, 5.0, 0.0], *folded])
    assert len(project_velodyne(inside, eye, HERE, SIZE, keep_occluded=True)) == 1
