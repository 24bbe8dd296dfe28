"""Calibrations of KITTI, OpenCV, ROS, Kalibr and plain files, extrinsics, and damaged files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.poses import read_extrinsics
from pnpdepth_cli.sensors.lens import pixels_of

pytest.importorskip("yaml")

KITTI = """P0: 700 0 600 0 0 700 170 0 0 0 1 0
P2: 700 0 600 42 0 700 170 -0.35 0 0 1 0.005
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8
"""
PLAIN = """# a comment
K: [[500.5, 0, 320], [0, 501, 240],
    [0, 0, 1]]
R:
  - [0, -1, 0]
  - [0, 0, -1]
  - [1, 0, 0]
t: [0.1, -0.2, -0.3]   # metres
distortion: [-0.02, 0.01, -0.003, 0.001]
size: [640, 480]
lens: fisheye
"""
K = [[500.5, 0, 320], [0, 501, 240], [0, 0, 1]]
TURN, SHIFT = [[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0.1, -0.2, -0.3]
ROS = """image_width: 640
image_height: 480
camera_matrix: {{rows: 3, cols: 3, data: [500.5, 0, 320, 0, 501, 240, 0, 0, 1]}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: 5, data: {data}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""
TOPIC = """header:
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d: [-0.1, 0.02, 0.001, -0.002, 0.01]
k: [500.5, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
---
height: 480
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.01, -0.003, 0.001]
  distortion_model: equidistant
  intrinsics: [500.5, 501, 320, 240]
  resolution: [640, 480]
cam1:
  T_cam_lidar: [[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [500.5, 501, 320, 240]
  resolution: [640, 480]
"""
RADIAL = "radial-tangential"
POSES = {
    "matrix of 16": "0 -1 0 0.1\n0 0 -1 -0.2\n1 0 0 -0.3\n0 0 0 1\n",
    "matrix of 12": "[[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]]  # by rows",
    "quaternion": "0.1 -0.2 -0.3 0.5 -0.5 0.5 0.5",
    "tf": "transforms:\n- transform:\n    translation: {x: 0.1, y: -0.2, z: -0.3}\n"
    "    rotation: {x: 0.5, y: -0.5, z: 0.5, w: 0.5}\n",
}
ODD = [
    *("!!int ''", "!!bool x", "!!timestamp x", "!!binary é", "!!float z", "{? [] : 1}"),
    *("!!python/name:os.system ''", "1e999", "9" * 5000),
]
"""Values of YAML that are no matrix."""


def write(folder: Path, text: str, name: str = "calib.txt") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def opencv_file(coefficients: list[float], **others: int) -> str:
    """What OpenCV writes."""
    file = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in {"image_width": 640, "image_height": 480, **others}.items():
        file.write(name, value)
    file.write("camera_matrix", np.array(K))
    file.write("distortion_coefficients", np.array(coefficients)[:, None])
    return file.releaseAndGetString()


def test_kittis_files_become_one_pinhole_camera(tmp_path: Path) -> None:
    path = write(tmp_path, KITTI)
    got = read_calibration(path)
    assert (got.camera.size, got.camera.distortion) == (None, ())
    # P · [0 -0.08 -0.27 1] must come out the same as K · translation
    p2 = np.array([[700, 0, 600, 42], [0, 700, 170, -0.35], [0, 0, 1, 0.005]])
    shown = got.camera.intrinsics @ got.scanner.square()[:3, 3]
    np.testing.assert_allclose(shown, p2 @ [0, -0.08, -0.27, 1])
    assert read_calibration(path, 0).scanner.translation.tolist() == [0, -0.08, -0.27]
    # odometry has the scanner in Tr, and no rectification
    lines = KITTI.splitlines()
    odometry = "\n".join([*lines[:2], lines[3].replace("Tr_velo_to_cam", "Tr")])
    same = read_calibration(write(tmp_path, odometry))
    assert np.array_equal(same.scanner.square(), got.scanner.square())


def test_kitti_360_maps_camera_0_to_the_scanner_and_has_one_rectification(tmp_path: Path) -> None:
    k, turn = np.array([[552.5, 0, 682], [0, 552.5, 238.7], [0, 0, 1]]), np.array(TURN, float).T
    rectify = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
    to_scanner = np.column_stack([turn, [0.77, 0.29, -0.16]])
    offsets, lines = (0.0, -328.7), ["calib_time: 03-Apr-2018 18:47:03", "corner_dist: 0.100000"]
    for camera, offset in enumerate(offsets):
        p = np.column_stack([k, [offset, 0, 0]])
        for name, values in {"S_rect": [1408, 376], "R_rect": rectify, "P_rect": p}.items():
            lines.append(f"{name}_{camera:02}: {' '.join(map(str, np.ravel(values).tolist()))}")
    (tmp_path / "perspective.txt").write_text("\n".join(lines))
    np.savetxt(tmp_path / "calib_cam_to_velo.txt", to_scanner.reshape(1, 12))
    point = np.array([12.0, -3.0, 0.5])  # in the scanner's frame
    u, v, w = k @ rectify @ np.linalg.solve(turn, point - to_scanner[:, 3])
    for camera, offset in enumerate(offsets):
        calibration = read_calibration(tmp_path, camera or None)
        seen = calibration.scanner.apply(point[None])
        pixel = pixels_of(calibration.camera, seen)[0]
        np.testing.assert_allclose([*pixel, seen[0, 2]], [(u + offset) / w, v / w, w])
        assert calibration.camera.size == (376, 1408)


def test_kittis_raw_folder_gives_its_cameras_also_without_the_scanner(tmp_path: Path) -> None:
    cameras = write(
        tmp_path,
        "calib_time: 09-Jan-2012 13:57:47\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
        "S_rect_02: 1242 375\nP_rect_02: 700 0 600 42 0 700 170 0 0 0 1 0\n",
        "calib_cam_to_cam.txt",
    )
    for place in (tmp_path, cameras):
        alone = read_calibration(place)
        assert (alone.camera.size, alone.scanner) == ((375, 1242), None)
    scanner = write(tmp_path, "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.27\n", "calib_velo_to_cam.txt")
    pose = read_calibration(scanner).scanner
    assert [each.tolist() for each in pose] == [TURN, [0.06, -0.08, -0.27]]
    cameras.unlink()
    with pytest.raises(InputError):
        read_calibration(tmp_path)


FIVE, FOUR = [-0.1, 0.02, 0.001, -0.002, 0.01], [-0.02, 0.01, -0.003, 0.001]
EIGHT = [0.1, 0.2, 0.0, 0.0, 0.1, 0.2, 0.1, 0.01]
VALUES = {"K": K, "R": TURN, "t": SHIFT, "distortion": FIVE, "size": [640, 480]}
NAMED: dict[str, tuple[str, int | None, list[float], str, bool]] = {
    "OpenCV": (opencv_file(FIVE), None, FIVE, RADIAL, False),
    "OpenCV, fisheye": (opencv_file(FOUR, fisheye_model=1), None, FOUR, "fisheye", False),
    "ROS": (ROS.format(model="rational_polynomial", data=EIGHT), None, EIGHT, RADIAL, False),
    "ROS, fisheye": (ROS.format(model="equidistant", data=FOUR), None, FOUR, "fisheye", False),
    "ROS, undistorted": (ROS.format(model="''", data=[0] * 4), None, [], RADIAL, False),
    "an echoed topic": (TOPIC, None, FIVE, RADIAL, False),
    "Kalibr": (KALIBR, None, FOUR, "fisheye", False),
    "Kalibr's second": (KALIBR, 1, FIVE[:4], RADIAL, True),
    "plain text": (PLAIN, None, FOUR, "fisheye", True),
    "JSON": (json.dumps(VALUES), None, FIVE, RADIAL, True),
    "bare": ("500.5 501 320 240 640 480", None, [], RADIAL, False),
}
"""Text, number of the camera, coefficients, lens, and whether it has the scanner's pose."""


@pytest.mark.parametrize("kind", NAMED)
def test_a_camera_is_the_same_in_every_kind_of_file(kind: str, tmp_path: Path) -> None:
    text, number, coefficients, lens, has_pose = NAMED[kind]
    got = read_calibration(write(tmp_path, text), number)
    camera = got.camera
    assert (camera.intrinsics.tolist(), camera.size, camera.lens) == (K, (480, 640), lens)
    assert camera.distortion == tuple(coefficients)
    assert [each.tolist() for each in got.scanner or ()] == ([TURN, SHIFT] if has_pose else [])


@pytest.mark.parametrize(("text", "number"), [(KITTI, 3), (KALIBR, 7), (PLAIN, 1), (TOPIC, 0)])
def test_a_camera_that_is_not_there_is_wrong_usage(text: str, number: int, tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        read_calibration(write(tmp_path, text), number)


PLAIN_P, SHIFTED_P = [9, 0, 3, 0, 0, 8, 2, 0, 0, 0, 1, 0], [9, 0, 3, -18, 0, 8, 2, 0, 0, 0, 1, 0]
TURNED = {"P and R": (TURN, 0), "P": (None, 0)}


@pytest.mark.parametrize(
    ("p", "r", "cameras"),
    [
        ([0] * 12, [], {}),
        (PLAIN_P, TURN, TURNED),
        (SHIFTED_P, [], {"P with its offset": (None, -2), "P": (None, 0)}),
        (SHIFTED_P, TURN, {"P with its offset, and R": (TURN, -2), **TURNED}),
    ],
)
def test_the_cameras_of_rectified_images_follow_p_and_r(
    p: list[float], r: Any, cameras: dict[str, Any], tmp_path: Path
) -> None:
    raw = read_calibration(write(tmp_path, TOPIC.replace("---", f"p: {p}\nr: {r}\n---")))
    assert list(raw.rectified) == list(cameras)
    for name, (camera, pose) in raw.rectified.items():
        turn, x = cameras[name]
        assert camera.intrinsics.tolist() == [[9, 0, 3], [0, 8, 2], [0, 0, 1]]
        assert pose.rotation.tolist() == (turn or np.eye(3).tolist())
        assert pose.translation.tolist() == [x, 0, 0]


@pytest.mark.parametrize(
    "text",
    [
        *(KITTI.replace("Tr_velo_to_cam", "Tr_v"), KITTI.replace("P2: 700", "P2: nan")),
        KITTI.replace("R0_rect: 1", "R0_rect: 1.2"),
        KITTI.replace("velo_to_cam: 0 -1", "velo_to_cam: 0 1"),
        KITTI + KITTI,
        *(PLAIN.replace("t:", "#t:"), PLAIN.replace("-0.02, ", ""), PLAIN.replace("640", "0")),
        *("1 2 3", PLAIN.replace("500.5", "1e308"), KALIBR.replace("pinhole", "omni")),
        # YAML that is more than plain texts
        "a: &a [1, 1]\ncamera_matrix: *a\n",
        "camera_matrix: [" * 2000,
        "camera_matrix: 1\n" + " " * 300_000,
        "camera_matrix: !!python/object/apply:os.system ['true']",
        *(f"camera_matrix: {value}\ndistortion_model: plumb_bob\n" for value in ODD),
        # where the time grows with the square of the length, each of these takes a minute
        *("a" * 60_000, "a: b\nb\n" + "1\n" * 400_000, "1 " * 2_000_000),
    ],
)
@pytest.mark.filterwarnings("error")
def test_what_is_missing_or_wrong_is_named_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(FileFormatError, match=r"calib\.txt") as error:
        read_calibration(write(tmp_path, text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("form", POSES)
def test_extrinsics_are_read_in_each_form(form: str, tmp_path: Path) -> None:
    pose = read_extrinsics(write(tmp_path, POSES[form]))
    np.testing.assert_allclose(pose.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(pose.translation, SHIFT)


@pytest.mark.parametrize(
    "text",
    [
        *("1 2 3", "1 0 0 0 0 2 0 0 0 0 1 0", "0 0 0 1 1 1 1", "1e9 0 0 0 0 0 1", "hello: 3"),
        "translation: {x: 1, y: 2, z: 3}\nrotation: {x: 0, y: 0, z: 0, w: one}",
    ],
)
def test_what_is_no_pose_is_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError):
        read_extrinsics(write(tmp_path, text))
