"""Calibrations of KITTI, OpenCV, ROS, Kalibr and plain files, extrinsics, and damaged files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.poses import read_extrinsics
from pnpdepth_cli.sensors.lens import pixels_of
from tests.io.calibration_files import (
    FIVE,
    FOUR,
    KALIBR,
    KITTI,
    PLAIN,
    POSES,
    ROS,
    TOPIC,
    K,
    opencv_file,
)

pytest.importorskip("yaml")

TURN, SHIFT = [[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0.1, -0.2, -0.3]
RADIAL = "radial-tangential"


def write(folder: Path, text: str) -> Path:
    path = folder / "calib.txt"
    path.write_text(text, encoding="utf-8")
    return path


RECTIFY = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
TO_CAMERA = np.column_stack([TURN, SHIFT])
PROJECTIONS = {
    0: np.array([[552.5, 0, 682, 0], [0, 552.5, 238.7, 0], [0, 0, 1, 0]]),
    2: np.array([[552.5, 0, 682, 42], [0, 552.5, 238.7, -0.35], [0, 0, 1, 0.005]]),
}


P_PLAIN = {f"P{n}:": projection for n, projection in PROJECTIONS.items()}
SIZED = {f"P_rect_0{n}:": projection for n, projection in PROJECTIONS.items()}
SIZED |= {"R_rect_00:": RECTIFY, "S_rect_00:": [1408, 376], "S_rect_02:": [1408, 376]}
BACK = np.linalg.inv(np.vstack([TO_CAMERA, [0, 0, 0, 1]]))[:3]
KITTIS: dict[str, dict[str, dict[str, Any]]] = {
    "object": {"calib.txt": {**P_PLAIN, "R0_rect:": RECTIFY, "Tr_velo_to_cam:": TO_CAMERA}},
    "tracking": {"calib.txt": {**P_PLAIN, "R_rect": RECTIFY, "Tr_velo_cam": TO_CAMERA}},
    "odometry": {"calib.txt": {**P_PLAIN, "Tr:": RECTIFY @ TO_CAMERA}},  # already rectified
    "raw": {"calib_cam_to_cam.txt": SIZED, "calib_velo_to_cam.txt": {"R:": TURN, "T:": SHIFT}},
    "360": {"perspective.txt": SIZED, "calib_cam_to_velo.txt": {"": BACK}},
}
"""The values of the files of a data set."""


@pytest.mark.parametrize("kind", KITTIS)
def test_kittis_points_are_where_its_matrices_have_them(kind: str, tmp_path: Path) -> None:
    for file, values in KITTIS[kind].items():
        lines = []
        if values is SIZED:
            lines.append("calib_time: 03-Apr-2018 18:47:03")
        lines += [" ".join([name, *map(str, np.ravel(v).tolist())]) for name, v in values.items()]
        (tmp_path / file).write_text("\n".join(lines) + "\n")
    path = tmp_path / file if len(KITTIS[kind]) == 1 else tmp_path
    point = np.array([12.0, -3.0, 0.5])
    for number, projection in PROJECTIONS.items():
        u, v, w = projection @ [*(RECTIFY @ TO_CAMERA @ [*point, 1]), 1]
        got = read_calibration(path, number)
        seen = got.scanner.apply(point[None])
        pixel = pixels_of(got.camera, seen)[0]
        np.testing.assert_allclose([*pixel, seen[0, 2]], [u / w, v / w, w], rtol=1e-9)
        assert got.camera.size == ((376, 1408) if kind in ("raw", "360") else None)
    own = read_calibration(path, 0 if kind == "360" else 2).scanner
    assert np.array_equal(read_calibration(path).scanner.square(), own.square())
    with pytest.raises(UsageError):
        read_calibration(path, 3)
    if kind == "raw":  # the scanner may be missing, but not the cameras
        (path / "calib_velo_to_cam.txt").unlink()
        assert read_calibration(path / "calib_cam_to_cam.txt").scanner is None
        (path / "calib_cam_to_cam.txt").unlink()
        with pytest.raises(InputError):
            read_calibration(path)


@pytest.mark.parametrize(
    ("focal_px", "centre_px", "size"),
    [
        ("7.188560000000e+02", "6.071928000000e+02 1.852157000000e+02", (376, 1241)),  # 00
        ("7.215377000000e+02", "6.095593000000e+02 1.728540000000e+02", (375, 1242)),  # 03
        ("7.070912000000e+02", "6.018873000000e+02 1.831104000000e+02", (370, 1226)),  # 04
        ("7.070912000000e+02", "6.028873000000e+02 1.831104000000e+02", None),  # of no sequence
    ],
)
def test_a_file_of_kittis_odometry_has_the_size_of_its_images_which_it_does_not_state(
    focal_px: str, centre_px: str, size: tuple[int, int] | None, tmp_path: Path
) -> None:
    across, down = centre_px.split()
    text = f"P0: {focal_px} 0 {across} 0 0 {focal_px} {down} 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0"
    assert read_calibration(write(tmp_path, text), 0).camera.size == size


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
    assert [array.tolist() for array in got.scanner or ()] == ([TURN, SHIFT] if has_pose else [])
    with pytest.raises(UsageError):  # there is no such camera
        read_calibration(tmp_path / "calib.txt", 7)


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
    for (camera, pose), (turn, x) in zip(raw.rectified.values(), cameras.values(), strict=True):
        assert camera.intrinsics.tolist() == [[9, 0, 3], [0, 8, 2], [0, 0, 1]]
        assert pose.rotation.tolist() == (turn or np.eye(3).tolist())
        assert pose.translation.tolist() == [x, 0, 0]


NO_CALIBRATIONS = [
    KITTI.replace("Tr_velo_to_cam", "Tr_v"),
    KITTI.replace("P2: 700", "P2: nan"),
    KITTI.replace("R0_rect: 1", "R0_rect: 1.2"),
    KITTI.replace("to_cam: 0 -1", "to_cam: 0 1"),
    KITTI + KITTI,
    "1 2 3",
    KALIBR.replace("pinhole", "omni"),
    PLAIN.replace("500.5", "1e308"),
    PLAIN.replace("t:", "#t:"),
    PLAIN.replace("-0.02, ", ""),
    PLAIN.replace("640", "0"),
    # YAML that is more than plain texts
    "a: &a [1, 1]\ncamera_matrix: *a\n",
    "camera_matrix: [" * 2000,
    "camera_matrix: 1\n" + " " * 300_000,
    "camera_matrix: !!python/object/apply:os.system ['true']",
    *(f"camera_matrix: {odd}\n" for odd in ("!!int ''", "!!binary é", "1e999", "9" * 5000)),
    # where the time grows with the square of the length, each of these takes a minute
    "a" * 60_000,
    "a: b\nb\n" + "1\n" * 400_000,
    "1 " * 2_000_000,
]
NO_POSES = [
    "1 2 3",
    "1 0 0 0 0 2 0 0 0 0 1 0",
    "0 0 0 1 1 1 1",
    "1e9 0 0 0 0 0 1",
    "hello: 3",
    "translation: {x: 1, y: 2, z: 3}\nrotation: {x: 0, y: 0, z: 0, w: one}",
]


@pytest.mark.parametrize(
    ("read", "text"),
    [(read_calibration, text) for text in NO_CALIBRATIONS]
    + [(read_extrinsics, text) for text in NO_POSES],
)
@pytest.mark.filterwarnings("error")
def test_a_wrong_calibration_or_pose_is_refused_with_the_name_of_its_file(
    tmp_path: Path, read: Callable[[Path], object], text: str
) -> None:
    with pytest.raises(InputError, match=r"^.*calib\.txt.*$"):
        read(write(tmp_path, text))


@pytest.mark.parametrize("form", POSES)
def test_extrinsics_are_read_in_each_form(form: str, tmp_path: Path) -> None:
    pose = read_extrinsics(write(tmp_path, POSES[form]))
    np.testing.assert_allclose(pose.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(pose.translation, SHIFT)
