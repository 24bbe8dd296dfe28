"""Poses of KITTI and TUM files, and between their rows."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.poses import poses_of_frames, read_poses, read_trajectory

HALF = float(np.sqrt(0.5))


def tum_row(time_s: float, x: float) -> str:
    return f"{time_s} {x} 0 0 0 0 0 1\n"


def kitti_row(x: float) -> str:
    return f"1 0 0 {x} 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "names", "expected"),
    [
        # rows in any order, and more of them than frames
        (tum_row(12.51, 3) + tum_row(10.0, 1) + tum_row(11.0, 2), ["10.005", "12.5"], [1, 3]),
        (tum_row(0, 1) + tum_row(1, 2) + tum_row(10, 3), ["a/0", "a/10"], [1, 3]),
        # names that `pnpdepth frames` gives, and frames of sequences 1 and 02, which are no times
        (tum_row(7.1, 1) + tum_row(8.1, 2) + tum_row(9.1, 3), ["7_100000", "9_100000"], [1, 3]),
        (tum_row(2.0, 1) + tum_row(2.1, 2) + tum_row(2.2, 3), ["02_000001"], [2]),
        # times that are no names: the order counts
        (tum_row(100.0, 1) + tum_row(100.1, 2), ["0", "1"], [1, 2]),
        (kitti_row(1) + kitti_row(2), ["x", "y"], [1, 2]),
        (kitti_row(1) + kitti_row(2) + kitti_row(3), ["000000", "000002"], [1, 3]),
    ],
)
def test_poses_are_joined_by_time_else_by_order_or_number(
    tmp_path: Path, text: str, names: list[str], expected: list[float]
) -> None:
    (tmp_path / "poses.txt").write_text(text)
    poses, how = poses_of_frames(tmp_path / "poses.txt", names)
    assert "from camera to world" in how
    assert poses[:, 0, 3].tolist() == expected
    with pytest.raises(InputError):
        poses_of_frames(tmp_path / "poses.txt", ["x"] * 9)


def test_poses_of_nerfstudio_have_axes_up_and_back(tmp_path: Path) -> None:
    # a camera at (1, 2, 3) that looks along x of the world, whose z is up
    matrix = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    path = tmp_path / "transforms.json"
    still = np.eye(4).tolist()

    def poses_of(listed: dict[str, object], *names: str) -> tuple[np.ndarray, str]:
        frames = [{"file_path": n, "transform_matrix": pose} for n, pose in listed.items()]
        path.write_text(json.dumps({"frames": frames}))
        return poses_of_frames(path, names)

    (_, pose), how = poses_of({"images/b.jpg": matrix, "./images/a.png": still}, "rgb/a", "rgb/b")
    assert pose @ [0, 0, 5, 1] == pytest.approx([6, 2, 3])  # 5 ahead
    assert pose @ [0, 1, 0, 1] == pytest.approx([1, 2, 2])  # 1 down
    assert "OpenGL" in how
    cameras = {"images/cam1/a.png": matrix, "images/cam0/a.png": still}
    assert poses_of(cameras, "cam0/a", "cam1/a")[0][:, 0, 3].tolist() == [0, 1]
    for name in ("a", "d"):
        with pytest.raises(InputError, match=f"'{name}'"):
            poses_of(cameras, name)
    with pytest.raises(InputError):
        poses_of({"a": [[1, 2]]}, "a")


TURNED = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
"""A camera at (1, 2, 3), turned by a quarter about z."""


@pytest.mark.parametrize(
    ("kind", "row", "words"),
    [
        ("camera-to-world", "0 -1 0 1 1 0 0 2 0 0 1 3", "from camera"),
        ("camera-to-world", f"# time x y z q\n1305.5 1 2 3 0 0 {HALF} {HALF}", "from camera"),
        # x of the world is -y of the camera
        ("world-to-camera", "0 1 0 -2 -1 0 0 1 0 0 1 -3", "from world"),
        ("opengl", "0 1 0 1 1 0 0 2 0 0 -1 3", "OpenGL"),  # its y and z axes are the negative ones
    ],
)
def test_poses_of_each_kind_are_one_camera(tmp_path: Path, kind: str, row: str, words: str) -> None:
    (tmp_path / "poses.txt").write_text(row)
    (pose,), how = poses_of_frames(tmp_path / "poses.txt", ["a"], kind)
    np.testing.assert_allclose(pose, TURNED, atol=1e-15)
    assert words in how


@pytest.mark.parametrize(
    "text",
    [
        "# nothing\n",
        "1 2 3\n",
        "2 0 0 0 0 1 0 0 0 0 1 0\n",
        "-1 0 0 0 0 1 0 0 0 0 1 0\n",
        "1 0 0 nan 0 1 0 0 0 0 1 0\n",
        "0 0 0 0 0 0 0 0\n",
        kitti_row(0) + tum_row(0, 0),
    ],
)
def test_a_broken_row_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(InputError, match=r"p\.txt"):
        read_poses(tmp_path / "p.txt")


def test_a_pose_between_two_is_interpolated_unless_they_are_far_apart(tmp_path: Path) -> None:
    """From 10 s to 10.5 s 1 m along x and a quarter turn about z; rows in any order."""
    path = tmp_path / "groundtruth.txt"
    path.write_text(f"# t x y z q\n10.5 1 0 0 0 0 {HALF} {HALF}\n10 0 0 0 0 0 0 1\n")
    trajectory = read_trajectory(path)
    pose = trajectory.at(10.25, 0.5)
    assert pose @ [1, 0, 0, 1] == pytest.approx([0.5 + HALF, HALF, 0])
    assert np.array_equal(trajectory.at(10.0, 0.0), np.eye(4)[:3])
    outside = ((9.99, 1.0), (10.51, 1.0), (10.25, 0.49))
    assert [trajectory.at(*time_and_gap) for time_and_gap in outside] == [None] * 3


def test_rows_of_4_by_4_matrices_are_poses_in_one_line_or_in_four(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    right = np.repeat(np.eye(4)[None], 3, axis=0)
    right[:, 0, 3] = [1, 2, 3]
    for rows in (right.reshape(3, 16), right.reshape(12, 4)):
        np.savetxt(path, rows)
        np.testing.assert_array_equal(read_poses(path), right[:, :3])
        np.testing.assert_array_equal(poses_of_frames(path, ["a", "b", "c"])[0], right[:, :3])
    # Matrices by columns have the translation in the last row.
    np.savetxt(path, right.transpose(0, 2, 1).reshape(3, 16))
    with pytest.raises(InputError, match="matrix 1"):
        read_poses(path)


def test_a_table_with_the_names_of_its_columns_is_poses(tmp_path: Path) -> None:
    """As odometry.csv of Stray Scanner, whose frames have numbers, or with others in between."""
    path = tmp_path / "odometry.csv"
    rows = "".join(f"{100 + n / 60:.6f}, {n:06d}, {n}, 0, 0, 0, 0, 0, 1\n" for n in range(5))
    path.write_text(f"timestamp, frame, x, y, z, qx, qy, qz, qw\n{rows}")
    poses, _ = poses_of_frames(path, ["000001", "000003"])
    np.testing.assert_array_equal(poses[:, 0, 3], [1, 3])
    assert read_trajectory(path).times_s == pytest.approx(100 + np.arange(5) / 60, abs=1e-6)
    path.write_text("qw,qx,qy,qz,X,Y,Z,Timestamp\n1,0,0,0,7,8,9,5\n")
    np.testing.assert_array_equal(read_poses(path)[0, :, 3], [7, 8, 9])
