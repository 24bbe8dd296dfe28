"""Scans in an image, and which of their points the camera cannot see."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.commands.refinement.requested import read_requested
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.point_files import read_sparse
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.sensors.projection import (
    Points,
    as_depth_image,
    hidden_points,
    interleaved,
    occluded_in_map,
    project_velodyne,
)
from pnpdepth_cli.sensors.simulation import FORWARD_LEFT_UP, sample_points
from pnpdepth_cli.settings import Settings

CAMERA = Camera(intrinsics=np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]))
SIZE = (80, 101)


def test_a_scan_projects_as_computed_by_hand() -> None:
    # The scanner (x forward, y left, z up) is 0.5 m left of, 1 m above, 2 m behind the camera.
    behind = Extrinsics(FORWARD_LEFT_UP, np.array([-0.5, -1.0, -2.0]))
    scan = np.array(
        [
            [12.0, 0.0, 0.0],  # camera (-0.5, -1, 10): u = 50 - 5, v = 40 - 10
            [7.0, -1.25, -1.5],  # camera (0.75, 0.5, 5): u = 50 + 15, v = 40 + 10
            [6.0, -0.58, -1.06],  # camera (0.08, 0.06, 4): u = 52, v = 41.5
            [22.0, -0.9, -1.0],  # camera (0.4, 0, 20): u = 52, v = 40
            [8.0, -0.623, -0.97],  # camera (0.123, -0.03, 6): u = 52.05, v = 39.5
            [1.0, 0.0, 0.0],  # camera z = -1
            [12.0, 9.0, 0.0],  # camera (-9.5, ., 10): u = -45
        ]
    )
    got = project_velodyne(scan, CAMERA, behind, SIZE, keep_occluded=True)
    order = np.argsort(-got.depth)
    np.testing.assert_allclose(
        got.xy[order], [[45, 30], [52.05, 39.5], [65, 50], [52, 41.5]], atol=1e-5
    )
    np.testing.assert_allclose(got.depth[order], [10, 6, 5, 4], rtol=1e-6)
    assert list(got.dropped.values()) == [1, 1, 1]  # behind, outside, and of two on a pixel
    assert as_depth_image(got)[40, 52] == pytest.approx(6)


def test_a_lens_model_does_not_fold_points_from_outside_into_the_image() -> None:
    # 1 - 0.4 r² turns back at r = 0.91: a point at r = 1.58 would land on the axis
    eye = replace(CAMERA, distortion=(-0.4, 0.0, 0.0, 0.0))
    scan = np.array([[10.0, 5.0, 0.0], [10.0, 15.8, 0.0]])
    here = Extrinsics(FORWARD_LEFT_UP, np.zeros(3))
    assert len(project_velodyne(scan, eye, here, SIZE, keep_occluded=True)) == 1


@pytest.mark.parametrize("focal_px", [240.0, 300.0])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.3, -0.1, -0.2)])
def test_points_are_hidden_by_nearer_ones_beside_them(
    origin: tuple[float, float, float], focal_px: float
) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.permutation(24 * 32)[:200]
    xy = np.column_stack([pixels % 32, pixels // 32]) + rng.uniform(-0.49, 0.49, (200, 2))
    depth = rng.choice([2.0, 2.1, 3.0, 5.0, 20.0], 200)
    scanner = np.array([[focal_px, 0, 15.5], [0, focal_px, 11.5], [0, 0, 1]]) @ origin
    expected = np.zeros(200, bool)
    reach = max(1, round(np.radians(0.8) * focal_px))
    margin = np.radians(0.24) * focal_px
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


MAP_SIZE = (240, 640)


def points_of(depth: NDArray[np.float32]) -> Points:
    rows, columns = np.nonzero(depth)
    xy = np.column_stack([columns, rows]).astype(np.float32)
    return Points(xy=xy, depth=depth[rows, columns], size=depth.shape)


def boards_before_a_wall(*, keep_occluded: bool = True) -> Points:
    """A map of boards at 5 m and a wall at 20 m, seen by a scanner above and beside the camera."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.arange(-9, 9, 0.4)), np.radians(np.arange(-24, 24, 0.2)), indexing="ij"
    )
    y = np.tan(azimuth).ravel()
    z = (np.tan(elevation) / np.cos(azimuth)).ravel()
    on_board = (np.floor(5 * y / 0.25) % 2 == 0) & (np.abs(5 * z) < 0.4)
    x = np.where(on_board, 5.0, 20.0)
    scan = project_velodyne(
        np.column_stack([x, x * y, x * z]),
        Camera(intrinsics=np.array([[700.0, 0, 320], [0, 700, 120], [0, 0, 1]])),
        Extrinsics(FORWARD_LEFT_UP, np.array([0.06, -0.08, -0.27])),
        MAP_SIZE,
        keep_occluded=keep_occluded,
    )
    return points_of(as_depth_image(scan))


def test_points_of_the_wall_within_the_boards_are_occluded() -> None:
    points = boards_before_a_wall()
    hidden = occluded_in_map(points)
    between = interleaved(as_depth_image(points))
    column, row = points.xy.astype(int).T
    assert hidden[between[row, column]].mean() > 0.8
    assert hidden.mean() < 2.5 * between.sum() / len(points)


def test_points_of_the_foreground_are_never_occluded() -> None:
    points = boards_before_a_wall()
    assert points.depth[occluded_in_map(points)].min() > 19  # the boards are at 5 m


def test_a_map_whose_occluded_points_are_gone_is_no_raw_projection() -> None:
    assert occluded_in_map(boards_before_a_wall(keep_occluded=False)) is None


@pytest.fixture
def map_of_boards(tmp_path: Path) -> FrameFiles:
    """A file with the map of the boards and the wall."""
    write_depth(tmp_path / "sparse.png", as_depth_image(boards_before_a_wall()), scale=256)
    return FrameFiles(sparse=tmp_path / "sparse.png")


def test_occluded_points_of_a_file_are_dropped_and_counted(map_of_boards: FrameFiles) -> None:
    hidden = occluded_in_map(boards_before_a_wall())
    read = read_requested(RefineRequest(files=map_of_boards))
    assert read.sources["sparse"].dropped["hidden by foreground"] == hidden.sum()
    assert len(read.points) == np.count_nonzero(~hidden)


def test_one_note_says_that_the_papers_method_keeps_occluded_points(
    map_of_boards: FrameFiles,
) -> None:
    read = read_requested(RefineRequest(files=map_of_boards))
    assert sum("--method paper" in note for note in read.notes) == 1


def test_the_papers_method_keeps_occluded_points(map_of_boards: FrameFiles) -> None:
    paper = RefineRequest(files=map_of_boards, method=Settings(method="paper"))
    assert len(read_requested(paper).points) == len(boards_before_a_wall())


@pytest.mark.parametrize("kind", ["uniform", "grid"])
def test_sampled_points_are_no_projected_scan(kind: str) -> None:
    depth = np.where(np.arange(640) // 40 % 2 == 0, 2.0, 8.0) * np.ones((480, 1))
    samples = sample_points(depth.astype(np.float32), SamplePattern(kind=kind, count=9000), 0)
    assert occluded_in_map(points_of(as_depth_image(samples))) is None


def test_kittis_maps_are_recognised_and_its_filtered_scans_are_not(shared_data: Path) -> None:
    for path in sorted((shared_data / "kitti_dc" / "velodyne_raw").glob("*.png")):
        gt = read_depth(path.parents[1] / "groundtruth" / path.name).values
        points, _ = read_sparse(path)
        hidden = occluded_in_map(points)
        true_depth = gt[tuple(points.xy.astype(int).T[::-1])]
        agrees = np.abs(points.depth - true_depth) <= 0.1 * true_depth
        known = true_depth > 0
        assert (~hidden[known & agrees]).mean() > 0.985
        assert hidden[known & ~agrees].mean() > 0.4
    folder = shared_data / "kitti_object"
    calibration = read_calibration(folder / "calib" / "000001.txt")
    scan, _ = read_scan(folder / "velodyne" / "000001.bin")
    filtered = project_velodyne(scan, calibration.camera, calibration.scanner, (375, 1242))
    assert occluded_in_map(points_of(as_depth_image(filtered))) is None
