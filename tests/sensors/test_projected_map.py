"""Projected scans in depth maps: recognised by their pattern, and their occluded points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.commands.refinement.refine_image import read_requested
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.dataset.read_options import ReadOptions, ScanOptions
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.sensors.lidar import FORWARD_LEFT_UP
from pnpdepth_cli.sensors.pixels import Points, as_depth_image
from pnpdepth_cli.sensors.projection import interleaved, occluded_in_map, project_velodyne
from pnpdepth_cli.sensors.samplers import sample_points
from pnpdepth_cli.settings import Settings

SIZE = (240, 640)
INTRINSICS = np.array([[700.0, 0, 320], [0, 700, 120], [0, 0, 1]])


def points_of(depth: NDArray[np.floating]) -> Points:
    rows, columns = np.nonzero(depth)
    return Points(
        xy=np.column_stack([columns, rows]).astype(np.float32),
        depth=depth[rows, columns].astype(np.float32),
        size=depth.shape,
    )


def boards_before_a_wall(*, keep_occluded: bool = True) -> Points:
    """A map of boards at 5 m and a wall at 20 m, seen by a scanner above and beside the camera."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.arange(-9, 9, 0.4)), np.radians(np.arange(-24, 24, 0.2)), indexing="ij"
    )
    y, z = np.tan(azimuth).ravel(), (np.tan(elevation) / np.cos(azimuth)).ravel()
    on_board = (np.floor(5 * y / 0.25) % 2 == 0) & (np.abs(5 * z) < 0.4)
    x = np.where(on_board, 5.0, 20.0)
    scan = project_velodyne(
        np.column_stack([x, x * y, x * z]),
        Camera(intrinsics=INTRINSICS),
        Extrinsics(FORWARD_LEFT_UP, np.array([0.06, -0.08, -0.27])),
        SIZE,
        keep_occluded=keep_occluded,
    )
    return points_of(as_depth_image(scan))


def test_points_of_the_wall_within_the_boards_are_occluded() -> None:
    points = boards_before_a_wall()
    hidden = occluded_in_map(points)
    assert hidden is not None
    assert points.depth[hidden].min() > 19  # the foreground itself stays
    between = interleaved(as_depth_image(points))
    column, row = points.xy.astype(int).T
    assert hidden[between[row, column]].mean() > 0.8
    assert hidden.mean() < 2.5 * between.sum() / len(points)


def test_a_map_without_its_occluded_points_is_left_alone() -> None:
    assert occluded_in_map(boards_before_a_wall(keep_occluded=False)) is None


@pytest.mark.parametrize("kind", ["uniform", "grid"])
def test_sampled_points_are_no_projected_scan(kind: str) -> None:
    depth = np.where(np.arange(640) // 40 % 2 == 0, 2.0, 8.0) * np.ones((480, 1))
    samples = sample_points(depth.astype(np.float32), SamplePattern(kind=kind, count=9000), 0)
    assert occluded_in_map(points_of(as_depth_image(samples))) is None


def test_a_frame_is_read_without_occluded_points_unless_they_are_kept(tmp_path: Path) -> None:
    points = boards_before_a_wall()
    write_depth(tmp_path / "sparse.png", as_depth_image(points), scale=256)
    files = FrameFiles(sparse=tmp_path / "sparse.png")
    read = read_requested(RefineRequest(files=files))
    count = read.sources["sparse"].dropped["hidden by foreground"]
    assert len(read.points) == len(points) - count < len(points)
    assert sum("--method paper" in note for note in read.notes) == 1
    kept = read_frame(files, ReadOptions(scan=ScanOptions(keep_occluded=True)))
    assert len(kept.points) == len(points)
    assert not any("occluded" in note for note in kept.notes)
    paper = RefineRequest(files=files, method=Settings(method="paper"))
    assert len(read_requested(paper).points) == len(points)


def test_kittis_maps_are_recognised_and_its_filtered_scans_are_not(shared_data: Path) -> None:
    for path in sorted((shared_data / "kitti_dc" / "velodyne_raw").glob("*.png")):
        raw = read_depth(path).values
        gt = read_depth(path.parents[1] / "groundtruth" / path.name).values
        points = points_of(raw)
        hidden = occluded_in_map(points)
        assert hidden is not None
        true_depth = gt[tuple(points.xy.astype(int).T[::-1])]
        agrees = np.abs(points.depth - true_depth) <= 0.1 * true_depth
        known = true_depth > 0
        assert (~hidden[known & agrees]).mean() > 0.985
        assert hidden[known & ~agrees].mean() > 0.4
    folder = shared_data / "kitti_object"
    calibration = read_calibration(folder / "calib" / "000001.txt")
    assert calibration.scanner is not None
    scan = read_scan(folder / "velodyne" / "000001.bin").points
    filtered = project_velodyne(scan, calibration.camera, calibration.scanner, (375, 1242))
    assert occluded_in_map(points_of(as_depth_image(filtered))) is None
