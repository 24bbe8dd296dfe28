"""The camera of images that may be rectified."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import SAME_PLACE, Camera, Extrinsics
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.rectified_camera import choose_camera
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan

STREET = Path(__file__).parents[2] / "samples" / "street"
SIZE = (375, 1242)
K = np.array([[800.0, 0, 600], [0, 800, 180], [0, 0, 1]])
D = np.array([-0.2, 0.05, 0, 0, 0])


@pytest.mark.parametrize("rectified", [True, False])
def test_edges_say_whether_an_image_is_rectified(rectified: bool, tmp_path: Path) -> None:
    right = read_calibration(STREET / "calib.txt")
    image = STREET / "rgb.png"
    scan = STREET / "000000.bin"
    calib = tmp_path / "camera_info.yaml"
    if not rectified:  # as the raw camera would have seen it
        xy = np.stack(np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0])), -1).astype(np.float32)
        at = cv2.undistortPoints(xy.reshape(-1, 1, 2), K, D, P=right.camera.intrinsics)
        pixels = cv2.remap(cv2.imread(str(image)), at.reshape(xy.shape), None, cv2.INTER_LINEAR)
        image = tmp_path / "raw.png"
        cv2.imwrite(str(image), pixels)
    p = np.column_stack([right.camera.intrinsics, np.zeros(3)])
    numbers = {"d": D, "k": K, "p": p, "r": np.eye(3), "T_camera_lidar": right.scanner.square()}
    lines = [f"{name}: {values.ravel().tolist()}\n" for name, values in numbers.items()]
    calib.write_text("".join([*lines, "distortion_model: plumb_bob\n"]))
    camera = read_scan_points(scan, ScanOptions(calib=calib), SIZE, image).camera
    np.testing.assert_array_equal(camera.intrinsics, right.camera.intrinsics if rectified else K)
    assert camera.has_lens is not rectified
    blind = read_scan_points(scan, ScanOptions(calib=calib), SIZE)  # raw is said to be assumed
    assert any(note.startswith("camera: raw images, by K") for note in blind.notes)


@pytest.mark.parametrize("to_rectified", [True, False])
def test_edges_say_whether_transforms_lead_to_the_rectified_camera(to_rectified: bool) -> None:
    right = read_calibration(STREET / "calib.txt")
    turn = Extrinsics(Rotation.from_euler("xyz", [3, 4, 0], degrees=True).as_matrix(), np.zeros(3))
    scanner = right.scanner if to_rectified else turn.inverse() @ right.scanner
    cameras = {"P and R": (right.camera, turn), "P": (right.camera, SAME_PLACE)}
    raw = Calibration(camera=Camera(intrinsics=K), scanner=scanner, rectified=cameras)
    frames = [(read_rgb(STREET / "rgb.png").values, read_scan(STREET / "000000.bin")[0])]
    chosen, _ = choose_camera(raw, frames, "/front/image_rect")
    np.testing.assert_allclose(chosen.scanner.rotation, right.scanner.rotation, atol=1e-9)
