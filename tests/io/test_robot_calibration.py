"""Calibrations of OpenCV, ROS and Kalibr, extrinsics in each form, and damaged files."""

from __future__ import annotations

import contextlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnpdepth_cli.errors import FileFormatError, PnpDepthError, UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.extrinsics import inverse, read_extrinsics

pytest.importorskip("yaml")

K = [[500.5, 0, 320], [0, 501, 240], [0, 0, 1]]
ROS = """image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [500.5, 0, 320, 0, 501, 240, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: {data}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""
TOPIC = """header:
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d: [-0.1, 0.02, 0.001, -0.002, 0.0]
k: [500.5, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
---
height: 480
"""
SHORT = ROS.format(model="plumb_bob", count=2, data=[1, 2])
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.01, -0.003, 0.001]
  distortion_model: equidistant
  intrinsics: [500.5, 501, 320, 240]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  T_cam_lidar:
  - [0, -1, 0, 0.1]
  - [0, 0, -1, -0.2]
  - [1, 0, 0, -0.3]
  - [0, 0, 0, 1]
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [400, 401, 310, 230]
  resolution: [640, 480]
"""
TURN = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
SHIFT = [0.1, -0.2, -0.3]
POSES = {
    "matrix of 16": "0 -1 0 0.1\n0 0 -1 -0.2\n1 0 0 -0.3\n0 0 0 1\n",
    "matrix of 12": "[[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]]  # by rows",
    "quaternion": "0.1 -0.2 -0.3 0.5 -0.5 0.5 0.5",
    "two lists": "translation: [0.1, -0.2, -0.3]\nrotation: [0.5, -0.5, 0.5, 0.5]\n",
    "json": '{"translation": [0.1, -0.2, -0.3], "quaternion": [0.5, -0.5, 0.5, 0.5]}',
    "tf": "transforms:\n- header: {frame_id: camera}\n  child_frame_id: lidar\n  transform:\n"
    "    translation: {x: 0.1, y: -0.2, z: -0.3}\n"
    "    rotation: {x: 0.5, y: -0.5, z: 0.5, w: 0.5}\n",
    "named matrix": "T_cam_lidar: [[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]]",
    "R and t": "R: [0, -1, 0, 0, 0, -1, 1, 0, 0]\nt: [0.1, -0.2, -0.3]\n",
}


def write(folder: Path, text: str, name: str = "camera.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def opencv_file(folder: Path, coefficients: list[float], **others: int) -> Path:
    path = folder / "opencv.yml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("image_height", 480)
    for name, value in others.items():
        file.write(name, value)
    file.write("camera_matrix", np.array(K))
    file.write("distortion_coefficients", np.array(coefficients)[:, None])
    file.release()
    return path


def test_a_file_that_opencv_wrote_is_read(tmp_path: Path) -> None:
    got = read_calibration(opencv_file(tmp_path, [-0.1, 0.02, 0.001, -0.002, 0.01]))
    assert got.intrinsics.tolist() == K
    assert got.distortion == (-0.1, 0.02, 0.001, -0.002, 0.01)
    assert (got.size, got.lens, got.has_pose) == ((480, 640), "radial-tangential", False)
    fisheye = read_calibration(opencv_file(tmp_path, [-0.1, 0.02, 0, 0.01], fisheye_model=1))
    assert (fisheye.lens, fisheye.distortion) == ("fisheye", (-0.1, 0.02, 0, 0.01))


@pytest.mark.parametrize(
    ("model", "data", "lens"),
    [
        ("plumb_bob", [-0.1, 0.02, 0.001, -0.002, 0.01], "radial-tangential"),
        ("rational_polynomial", [0.1, 0.2, 0.0, 0.0, 0.1, 0.2, 0.1, 0.01], "radial-tangential"),
        ("equidistant", [-0.02, 0.01, -0.003, 0.001], "fisheye"),
    ],
)
def test_a_camera_info_file_of_ros_is_read(
    model: str, data: list[float], lens: str, tmp_path: Path
) -> None:
    got = read_calibration(write(tmp_path, ROS.format(model=model, count=len(data), data=data)))
    assert got.intrinsics.tolist() == K
    assert (got.size, got.lens, got.distortion) == ((480, 640), lens, tuple(data))


def test_an_echoed_camera_info_topic_is_read_from_its_first_message(tmp_path: Path) -> None:
    got = read_calibration(write(tmp_path, TOPIC))
    assert got.intrinsics.tolist() == K
    assert (got.size, got.distortion[:2]) == ((480, 640), (-0.1, 0.02))


def test_the_cameras_of_a_camchain_are_chosen_by_number(tmp_path: Path) -> None:
    path = write(tmp_path, KALIBR)
    first, second = read_calibration(path), read_calibration(path, 1)
    assert (first.intrinsics.tolist(), first.lens, first.has_pose) == (K, "fisheye", False)
    assert (second.lens, second.has_pose) == ("radial-tangential", True)
    assert (second.rotation.tolist(), second.translation.tolist()) == (TURN, SHIFT)
    with pytest.raises(UsageError, match="has no cam7; --camera can be one of: cam0, cam1"):
        read_calibration(path, 7)


@pytest.mark.parametrize("form", POSES)
def test_extrinsics_are_read_in_each_form(form: str, tmp_path: Path) -> None:
    rotation, translation = read_extrinsics(write(tmp_path, POSES[form], "pose.txt"))
    np.testing.assert_allclose(rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(translation, SHIFT)
    back = inverse(inverse((rotation, translation)))
    np.testing.assert_allclose(back[1], SHIFT)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "holds 3 numbers; extrinsics are 12 or 16"),
        ("1 0 0 0 0 2 0 0 0 0 1 0", "is no rotation"),
        ("0 0 0 1 1 1 1", "the quaternion has length 2"),
        ("1e9 0 0 0 0 0 1", "is none of a sensor"),
        ("hello: 3", "holds no extrinsics"),
    ],
)
def test_what_is_no_pose_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_extrinsics(write(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (KALIBR.replace("pinhole", "omni"), "only pinhole .4. and eucm .6. are known"),
        (KALIBR.replace("equidistant", "wobbly"), "distortion model 'wobbly' is not known"),
        (SHORT, "2 coefficients of radial-tangential"),
        ("a: &a [1, 1]\ncamera_matrix: *a\n", "has an alias"),
        ("camera_matrix: [" * 2000, "is not valid YAML"),
        ("camera_matrix: 1\n" + " " * 300_000, "more than a calibration"),
        (
            "camera_matrix: !!python/object/apply:os.system ['true']",
            "is not made of finite numbers",
        ),
        ("camera_matrix: [1, 2, .inf]", "is not made of finite numbers"),
    ],
)
def test_what_cannot_be_used_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=message) as caught:
        read_calibration(write(tmp_path, text))
    assert "\n" not in str(caught.value)


@settings(max_examples=120)
@given(data=st.data())
def test_a_damaged_file_raises_only_our_errors(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    text = data.draw(st.sampled_from([TOPIC, KALIBR, POSES["tf"], POSES["json"]]))
    content = bytearray(text.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        position = data.draw(st.integers(0, len(content) - 1))
        content[position] = data.draw(st.sampled_from(b"019-.:[]{}&*!\n \x00\xffae"))
    path = tmp_path_factory.mktemp("yaml") / "camera.yaml"
    path.write_bytes(content)
    for read in (read_calibration, read_extrinsics):
        with contextlib.suppress(PnpDepthError):
            read(path)
