"""The occlusion filter, on a scene computed exactly and on frames with ground truth."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors.lens import pixels_of
from pnpdepth_cli.sensors.lidar import FORWARD_LEFT_UP
from pnpdepth_cli.sensors.projection import edge_agreement, hidden_points, project_velodyne

K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
CAMERA = Camera(intrinsics=K)
SIZE = (480, 640)


def board_before_wall(left_m: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """A scan of a board 5 m away (|y| < 0.5, |z| < 0.5 of the scanner) and a wall at 20 m.

    Also which points the camera, `left_m` to the scanner's right, cannot see.
    """
    elevation, azimuth = np.meshgrid(
        np.radians(np.arange(-15, 15, 0.4)), np.radians(np.arange(-24, 24, 0.17)), indexing="ij"
    )
    y, z = np.tan(azimuth).ravel(), (np.tan(elevation) / np.cos(azimuth)).ravel()
    on_board = (np.abs(5 * y) < 0.5) & (np.abs(5 * z) < 0.5)
    x = np.where(on_board, 5.0, 20.0)
    scan = np.column_stack([x, x * y, x * z])
    # the camera's ray to a wall point passes the board's plane at a quarter of its length
    at_board = np.array([0, -left_m, 0]) * 0.75 + scan * 0.25
    hidden = ~on_board & (np.abs(at_board[:, 1]) < 0.5) & (np.abs(at_board[:, 2]) < 0.5)
    return scan, hidden


@pytest.mark.parametrize("left_m", [0.05, 0.09, -0.13])
def test_wall_seen_past_a_board_is_hidden_and_little_else(left_m: float) -> None:
    scan, hidden = board_before_wall(left_m)
    scanner = Extrinsics(FORWARD_LEFT_UP, np.array([-left_m, 0.0, 0.0]))
    tree = cKDTree(pixels_of(CAMERA, scanner.apply(scan)))
    everything, kept = (
        tree.query(project_velodyne(scan, CAMERA, scanner, SIZE, keep_occluded=keep).xy)[1]
        for keep in (True, False)
    )
    removed = np.setdiff1d(everything, kept)
    truly_hidden = np.intersect1d(everything, np.flatnonzero(hidden))
    assert len(truly_hidden) > 50
    assert len(np.intersect1d(removed, truly_hidden)) >= 0.9 * len(truly_hidden)
    visible = np.setdiff1d(everything, truly_hidden)
    assert len(np.intersect1d(kept, visible)) >= 0.98 * len(visible)
    assert scan[removed, 0].min() == 20  # the foreground itself stays


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
    assert edge_agreement(points, rgb) == pytest.approx(agreement, abs=0.005)
    assert edge_agreement(points.select(slice(9, 15)), rgb) == 0  # too few to tell
