"""Pose files of KITTI and TUM give the same rotations as an independent computation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.poses import read_poses


def test_kitti_rows_are_matrices(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1 0 0 4 0 1 0 5 0 0 1 6\n\n0 -1 0 1 1 0 0 2 0 0 1 3\n")
    poses = read_poses(tmp_path / "poses.txt")
    assert poses.shape == (2, 3, 4)
    assert poses[1].tolist() == [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]


def test_tum_rows_turn_as_their_quaternion_says(tmp_path: Path) -> None:
    # A quarter turn about y: x becomes -z, z becomes x.
    half = np.sqrt(0.5)
    (tmp_path / "p.txt").write_text(f"# time x y z q\n1305.5 1 2 3 0 {half} 0 {half}\n")
    (pose,) = read_poses(tmp_path / "p.txt")
    assert pose[:, :3] @ [1, 0, 0] == pytest.approx([0, 0, -1])
    assert pose[:, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# nothing\n", "has no poses"),
        ("1 2 3\n", "line 1 has 3 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 x 0\n", "not made of numbers"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n", "no rotation"),
        ("-1 0 0 0 0 1 0 0 0 0 1 0\n", "no rotation"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0\n", "no rotation"),
        ("0 0 0 0 0 0 0 0\n", "line 1"),
    ],
)
def test_a_broken_row_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_poses(tmp_path / "p.txt")
