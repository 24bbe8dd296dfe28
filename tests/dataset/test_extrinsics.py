"""A scan with extrinsics from a file, and extrinsics of the wrong direction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.read_options import ScanOptions
from pnpdepth_cli.dataset.scan_points import (
    check_direction,
    read_scan_points,
)
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.scans import read_scan
from tests.commands.scan_frames import CALIBRATION, HEIGHT, WIDTH, ScanOnDisk, scan_on_disk

TURN = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
SHIFT = np.array([0.1, -0.05, -0.2])


@pytest.fixture
def scene(tmp_path: Path) -> ScanOnDisk:
    """A scan whose calibration lacks the pose, and the pose in a file of its own."""
    scene = scan_on_disk(tmp_path)
    scene.calib.write_text(CALIBRATION.splitlines()[0])
    np.savetxt(tmp_path / "pose.txt", np.column_stack([TURN, SHIFT]))
    np.savetxt(tmp_path / "inverse.txt", np.column_stack([TURN.T, -TURN.T @ SHIFT]))
    return scene


def test_extrinsics_of_a_file_complete_a_calibration(scene: ScanOnDisk) -> None:
    options = ScanOptions(calib=scene.calib)
    with pytest.raises(UsageError, match=r"has no pose of the scanner; .* or give --ext"):
        read_scan_points(scene.scan, options, (HEIGHT, WIDTH))
    options = ScanOptions(calib=scene.calib, extrinsics=scene.folder / "pose.txt")
    read = read_scan_points(scene.scan, options, (HEIGHT, WIDTH))
    assert cKDTree(scene.xy).query(read.points.xy)[0].max() < 2e-3


def test_extrinsics_of_the_wrong_direction_are_recognised(scene: ScanOnDisk) -> None:
    wrong = ScanOptions(calib=scene.calib, extrinsics=scene.folder / "inverse.txt")
    with pytest.raises(UsageError, match=r"put 0 of 150 scan .* give their inverse"):
        read_scan_points(scene.scan, wrong, (HEIGHT, WIDTH))
    right = replace(wrong, extrinsics=scene.folder / "pose.txt")
    read = read_scan_points(scene.scan, right, (HEIGHT, WIDTH))
    assert cKDTree(scene.xy).query(read.points.xy)[0].max() < 2e-3
    assert not [note for note in read.notes if "extrinsics" in note]


def test_the_wrong_direction_of_a_real_scan_is_recognised(shared_data: Path) -> None:
    folder = shared_data / "kitti_object"
    for path in sorted((folder / "calib").glob("*.txt")):
        scan = read_scan(folder / "velodyne" / f"{path.stem}.bin").points
        calibration = read_calibration(path)
        camera, right = calibration.camera, calibration.scanner
        assert right is not None
        portrait = Camera(intrinsics=np.array([[700.0, 0, 180], [0, 700, 600], [0, 0, 1]]))
        assert check_direction(scan, camera, right, (375, 1242)) == []
        assert check_direction(scan, portrait, right, (1242, 375)) == []
        (warning,) = check_direction(scan, camera, right.inverse(), (375, 1242))
        assert "if they map the camera to the scanner, give their inverse" in warning
