from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnpdepth_cli.errors import FileFormatError, InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.calibration import read_calibration

KITTI = """P0: 700 0 600 0 0 700 170 0 0 0 1 0
P2: 700 0 600 42 0 700 170 -0.35 0 0 1 0.005
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8
"""
YAML = """# a comment
K: [[700.5, 0, 600],
    [0, 701, 170],
    [0, 0, 1]]
R:
  - [0, -1, 0]
  - [0, 0, -1]
  - [1, 0, 0]
t: [0.06, -0.08, -0.27]   # metres
distortion: [-0.3, 0.1, 0.0, 0.001]
size: [1242, 375]
"""


def write(folder: Path, text: str, name: str = "calib.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_kittis_object_file_becomes_one_pinhole_camera(tmp_path: Path) -> None:
    got = read_calibration(write(tmp_path, KITTI))
    assert got.intrinsics.tolist() == [[700, 0, 600], [0, 700, 170], [0, 0, 1]]
    assert got.rotation.tolist() == [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    # P · [0 -0.08 -0.27 1] must come out the same as K · translation
    p2 = np.array([[700, 0, 600, 42], [0, 700, 170, -0.35], [0, 0, 1, 0.005]])
    np.testing.assert_allclose(got.intrinsics @ got.translation, p2 @ [0, -0.08, -0.27, 1])
    assert (got.size, got.distortion, got.has_pose) == (None, (), True)


def test_a_camera_other_than_2_can_be_chosen(tmp_path: Path) -> None:
    got = read_calibration(write(tmp_path, KITTI), 0)
    assert got.translation.tolist() == [0, -0.08, -0.27]
    with pytest.raises(UsageError, match="has no camera 3; --camera can be one of: 0, 2"):
        read_calibration(write(tmp_path, KITTI), 3)


def test_kittis_odometry_file_has_the_scanner_in_tr(tmp_path: Path) -> None:
    lines = KITTI.splitlines()
    odometry = "\n".join([*lines[:2], lines[3].replace("Tr_velo_to_cam", "Tr")])
    got, want = (read_calibration(write(tmp_path, text)) for text in (odometry, KITTI))
    assert np.array_equal(got.rotation, want.rotation)
    assert np.array_equal(got.translation, want.translation)


def test_a_plain_text_file_and_its_json_are_read_the_same(tmp_path: Path) -> None:
    text = read_calibration(write(tmp_path, YAML, "a.yaml"))
    values = {
        "K": [[700.5, 0, 600], [0, 701, 170], [0, 0, 1]],
        "R": [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
        "t": [0.06, -0.08, -0.27],
        "distortion": [-0.3, 0.1, 0.0, 0.001],
        "size": [1242, 375],
    }
    same = read_calibration(write(tmp_path, json.dumps(values), "a.json"))
    for got in (text, same):
        assert got.intrinsics.tolist() == values["K"]
        assert got.rotation.tolist() == values["R"]
        assert got.translation.tolist() == values["t"]
        assert got.distortion == (-0.3, 0.1, 0.0, 0.001)
        assert got.size == (375, 1242)


def test_nine_numbers_are_intrinsics_alone(tmp_path: Path) -> None:
    got = read_calibration(write(tmp_path, "585 0 320\n0 585 240\n0 0 1\n"))
    assert got.intrinsics.tolist() == [[585, 0, 320], [0, 585, 240], [0, 0, 1]]
    assert not got.has_pose
    assert got.rotation.tolist() == np.eye(3).tolist()


BROKEN = [
    (KITTI.replace("R0_rect", "R0"), "has no R0_rect"),
    (KITTI.replace("Tr_velo_to_cam", "Tr_v"), "has no Tr_velo_to_cam"),
    (KITTI.replace("P2: 700", "P2: seven"), "P2 is not made of finite numbers"),
    (KITTI.replace("P2: 700", "P2: nan"), "P2 is not made of finite numbers"),
    (KITTI.replace("P2: 700", "P2:"), "P2 has 11 numbers instead of 12"),
    (KITTI.replace("P2: 700", "P2: -700"), "intrinsics are not of the form"),
    (KITTI.replace("R0_rect: 1", "R0_rect: 1.2"), "rectification is no rotation"),
    (KITTI.replace("velo_to_cam: 0 -1", "velo_to_cam: 0 1"), "scanner is no rotation"),
    (KITTI + KITTI, "P0 occurs twice"),
    ("hello\n" + KITTI, "line 1: 'hello' has no name"),
    (YAML.replace("K:", "k:"), "'k' is not part of a calibration"),
    (YAML.replace("t:", "#t:"), "has R but no t"),
    (
        YAML.replace("[-0.3, 0.1, 0.0, 0.001]", "[-0.3]"),
        "1 coefficients of radial-tangential",
    ),
    (YAML.replace("1242", "0"), "no image"),
    ("1 2 3", "K has 3 numbers instead of 9"),
    ('{"K": [1, 2', "is not valid JSON"),
    ("\0\0\0\0", "not a text file"),
]


@pytest.mark.parametrize(("text", "message"), BROKEN)
def test_what_is_missing_or_wrong_is_named_in_one_line(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(FileFormatError) as error:
        read_calibration(write(tmp_path, text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert "calib.txt" in str(error.value)


def test_a_camera_of_a_plain_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="leave out --camera 1"):
        read_calibration(write(tmp_path, YAML), 1)


def test_a_folder_without_kittis_files_is_an_error_that_names_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no calib_cam_to_cam\.txt"):
        read_calibration(tmp_path)
    (tmp_path / "calib_velo_to_cam.txt").write_text("x: 1")
    with pytest.raises(InputError, match=r"has no calib_cam_to_cam\.txt"):
        read_calibration(tmp_path)


def test_kittis_cameras_are_read_without_their_scanner(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "calib_time: 09-Jan-2012 13:57:47\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
        "S_rect_02: 1242 375\nP_rect_02: 700 0 600 42 0 700 170 0 0 0 1 0\n",
        "calib_cam_to_cam.txt",
    )
    for place in (tmp_path, path):
        got = read_calibration(place)
        assert got.intrinsics.tolist() == [[700, 0, 600], [0, 700, 170], [0, 0, 1]]
        assert (got.size, got.has_pose) == ((375, 1242), False)


def test_an_image_as_calibration_is_recognised(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(20))
    with pytest.raises(FileFormatError, match="not a text file"):
        read_calibration(path)


@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_a_damaged_calibration_raises_only_our_errors(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    text = data.draw(st.sampled_from([KITTI, YAML]))
    cut = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(cut, min(len(text), cut + 30)))
    noise = data.draw(st.text(max_size=8))
    path = tmp_path_factory.mktemp("c") / "calib.txt"
    path.write_text(text[:cut] + noise + text[end:], encoding="utf-8")
    message = ""
    try:
        got = read_calibration(path)
    except PnpDepthError as error:
        message = str(error)
    else:
        assert np.isfinite(got.intrinsics).all()
        assert np.isfinite(got.translation).all()
    assert len(message.splitlines()) <= 1


def test_kittis_raw_folder_gives_all_four_cameras(shared_data: Path) -> None:
    folder = shared_data / "kitti_dc"
    x = []
    for camera in range(4):
        got = read_calibration(folder, camera)
        assert got.size == (375, 1242)
        assert got.intrinsics[0, 0] == 721.5377
        x.append(got.translation[0])
    # the baselines of the set-up: 54 cm between the greys, the colours 6 cm to their left
    np.testing.assert_allclose(np.diff(x), [-0.537, 0.597, -0.533], atol=0.002)
    same = read_calibration(folder / "calib_velo_to_cam.txt")
    assert np.array_equal(same.translation, read_calibration(folder, 2).translation)


def test_kittis_object_files_are_near_the_published_set_up(shared_data: Path) -> None:
    for path in sorted((shared_data / "kitti_object" / "calib").glob("*.txt")):
        got = read_calibration(path)
        np.testing.assert_allclose(got.translation, [0.06, -0.08, -0.3], atol=0.05)
        assert got.rotation @ [1, 0, 0] == pytest.approx([0, 0, 1], abs=0.03)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("700.5", "1e308"),
        ("0.06", "-1e308"),
        ("[0, -1, 0]", "[0, -1e308, 1e308]"),
        ("-0.3", "1e300"),
        ("size: [1242, 375]", "size: [1000000000, 1000000000]"),
        ("size: [1242, 375]", "size: [50000, 50000]"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_numbers_that_no_camera_has_are_refused(tmp_path: Path, old: str, new: str) -> None:
    assert old in YAML
    with pytest.raises(FileFormatError, match=r"which no camera has|pixels, more than"):
        read_calibration(write(tmp_path, YAML.replace(old, new)))
