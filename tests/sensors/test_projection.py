"""Scans in an image, and which of their points the camera cannot see."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors.lens import pixels_of
from pnpdepth_cli.sensors.lidar import FORWARD_LEFT_UP
from pnpdepth_cli.sensors.pixels import as_depth_image
from pnpdepth_cli.sensors.projection import (
    edge_agreement,
    edge_ranks,
    hidden_points,
    near_jumps,
    project_velodyne,
)

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


@pytest.mark.parametrize("focal_px", [240.0, 300.0])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.3, -0.1, -0.2)])
def test_a_point_is_hidden_by_a_nearer_one_beside_its_beam(
    origin: tuple[float, float, float], focal_px: float
) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.permutation(24 * 32)[:200]
    xy = np.column_stack([pixels % 32, pixels // 32]) + rng.uniform(-0.49, 0.49, (200, 2))
    depth = rng.choice([2.0, 2.1, 3.0, 5.0, 20.0], 200)
    scanner = np.array([[focal_px, 0, 15.5], [0, focal_px, 11.5], [0, 0, 1]]) @ origin
    expected = np.zeros(200, bool)
    reach, margin = max(1, round(np.radians(0.8) * focal_px)), np.radians(0.24) * focal_px
    for (i, far), (j, near) in itertools.product(enumerate(depth), repeat=2):
        apart = np.floor(xy[j] + 0.5) - np.floor(xy[i] + 0.5)
        if near < 0.92 * far and np.abs(apart).max() <= reach:
            along = (near - scanner[2]) / (far - scanner[2])  # of the beam, from the scanner
            passes = ((1 - along) * scanner[:2] + along * far * xy[i]) / near
            beam = passes - xy[i] if 0 < along < 1 else np.zeros(2)
            expected[i] |= np.hypot(*(apart - beam / 2)) <= margin + 0.75 * np.hypot(*beam)
    hidden = hidden_points(xy, depth, (24, 32), focal_px=focal_px, scanner=scanner)
    assert hidden.tolist() == expected.tolist()
    assert 0.1 < expected.mean() < 0.9


@pytest.mark.parametrize(("edge", "agreement"), [(50, 0.81), (20, -0.11), (None, 0.0)])
def test_edges_agree_where_they_are_beside_jumps_of_depth(
    edge: int | None, agreement: float
) -> None:
    y, x = np.mgrid[2:60:4, 2:100:4]
    xy = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
    depth = np.where((xy[:, 0] < 50) & (edge is not None), 2, 5).astype(np.float32)
    rgb = np.zeros((60, 100, 3), np.float32)
    rgb[:, edge:] = 1
    points = SparsePoints(xy=xy, depth=depth, size=(60, 100))
    found = edge_agreement(edge_ranks(rgb), points.xy, near_jumps(points))
    assert found == pytest.approx(agreement, abs=0.005)
    assert not near_jumps(points.select(slice(9, 15))).any()  # too few to tell
