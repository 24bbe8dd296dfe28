"""The camera and the pose of a scan: of files, and wrong ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.scan_points import check_direction, read_scan_points
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.scans import read_scan
from tests.colmap_models import write_binary_model
from tests.commands.frames import CALIBRATION, HEIGHT, WIDTH, scan_on_disk

STREET = Path(__file__).parents[2] / "samples" / "street"
SIZE = (375, 1242)
K = np.array([[800.0, 0, 600], [0, 800, 180], [0, 0, 1]])
TURN = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # from a LiDAR's axes to a camera's


def test_points_ahead_that_fall_outside_the_image_are_warned_of(tmp_path: Path) -> None:
    text = (STREET / "calib.txt").read_text().replace("7.215400000000e+02", "2.9e+03")
    (tmp_path / "calib.txt").write_text(text)
    options = ScanOptions(calib=tmp_path / "calib.txt")
    notes = read_scan_points(STREET / "000000.bin", options, SIZE).notes
    assert any("within 15°" in note for note in notes)


QUARTER = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # the camera looks along the scan's x
CYCLE = np.roll(np.eye(3), 1, axis=1)  # so, too; the inverse looks along y, x is down


@pytest.mark.parametrize(
    ("turn", "inside", "inverted", "notes"),
    [
        (QUARTER, 100, 299, 0),
        (QUARTER, 100, 300, 1),  # three times as many
        (QUARTER, 15, 300, 1),
        (QUARTER, 14, 300, None),  # less than a twentieth
        (QUARTER, 0, 2, 0),
        (CYCLE, 100, 201, 1),  # the scan is thin along x, which is the inverse's y
        (CYCLE, 100, 199, 0),
    ],
)
def test_the_direction_is_judged_by_the_points_in_the_image_and_what_is_upright(
    turn: NDArray[np.float64], inside: int, inverted: int, notes: int | None
) -> None:
    ahead, ahead_inverted = turn[2], turn.T[2]
    up = np.array([0, 0, 1] if turn is CYCLE else [0, 1, 0])
    beside = np.repeat([up, -up], 500, axis=0)
    along = np.repeat([ahead, ahead_inverted], [inside, inverted], axis=0)
    scan = 5 * np.concatenate([along, beside])
    camera = Camera(intrinsics=K)
    pose = Extrinsics(turn, np.zeros(3))
    if notes is None:
        with pytest.raises(UsageError):
            check_direction(scan, camera, pose, SIZE)
    else:
        assert len(check_direction(scan, camera, pose, SIZE)) == notes


def test_extrinsics_complete_a_calibration_in_one_direction(tmp_path: Path) -> None:
    scene = scan_on_disk(tmp_path)
    shift = np.array([0.1, -0.05, -0.2])
    scene.calib.write_text(CALIBRATION.splitlines()[0])
    np.savetxt(tmp_path / "pose.txt", np.column_stack([TURN, shift]))
    np.savetxt(tmp_path / "inverse.txt", np.column_stack([TURN.T, -TURN.T @ shift]))
    write_binary_model(tmp_path / "model")
    with pytest.raises(UsageError, match=f"name its folder, {tmp_path / 'model'}"):
        read_scan_points(tmp_path / "model/points3D.bin", ScanOptions(), (HEIGHT, WIDTH))
    alone = ScanOptions(calib=scene.calib)
    with pytest.raises(UsageError, match="--extrinsics"):
        read_scan_points(scene.scan, alone, (HEIGHT, WIDTH))
    wrong, right = (replace(alone, extrinsics=tmp_path / f"{n}.txt") for n in ("inverse", "pose"))
    with pytest.raises(UsageError, match="put 0 of 150 scan"):
        read_scan_points(scene.scan, wrong, (HEIGHT, WIDTH))
    read = read_scan_points(scene.scan, right, (HEIGHT, WIDTH))
    assert cKDTree(scene.xy).query(read.points.xy)[0].max() < 2e-3
    assert not [note for note in read.notes if "extrinsics" in note]


def test_the_wrong_direction_of_a_real_scan_is_recognised(shared_data: Path) -> None:
    folder = shared_data / "kitti_object"
    for path in sorted((folder / "calib").glob("*.txt")):
        scan = read_scan(folder / "velodyne" / f"{path.stem}.bin")[0]
        camera, right = read_calibration(path).camera, read_calibration(path).scanner
        portrait = Camera(intrinsics=np.array([[700.0, 0, 180], [0, 700, 600], [0, 0, 1]]))
        assert check_direction(scan, camera, right, (375, 1242)) == []
        assert check_direction(scan, portrait, right, (1242, 375)) == []
        (warning,) = check_direction(scan, camera, right.inverse(), (375, 1242))
        assert "if they map the camera to the scanner, give their inverse" in warning
