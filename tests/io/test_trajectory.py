"""Poses between the rows of a trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.poses import Trajectory, read_trajectory

HALF = float(np.sqrt(0.5))


def quarter_turn(root: Path) -> Trajectory:
    """From 10 s to 10.1 s 1 m along x and a quarter turn about z; rows in any order."""
    path = root / "groundtruth.txt"
    path.write_text(f"# t x y z q\n10.1 1 0 0 0 0 {HALF} {HALF}\n10 0 0 0 0 0 0 1\n")
    return read_trajectory(path)


def test_a_pose_between_two_is_interpolated(tmp_path: Path) -> None:
    pose = quarter_turn(tmp_path).at(10.05, 0.2)
    assert pose is not None
    assert pose[:, 3] == pytest.approx([0.5, 0, 0])
    assert pose[:, 0] == pytest.approx([HALF, HALF, 0])


def test_a_pose_at_the_time_of_a_row_is_that_row_whatever_the_gap(tmp_path: Path) -> None:
    pose = quarter_turn(tmp_path).at(10.0, 0.0)
    assert pose is not None
    assert pose.tolist() == np.eye(4)[:3].tolist()


def test_there_is_no_pose_outside_of_the_trajectory_or_in_a_gap(tmp_path: Path) -> None:
    trajectory = quarter_turn(tmp_path)
    assert trajectory.at(9.99, 1.0) is None
    assert trajectory.at(10.11, 1.0) is None
    assert trajectory.at(10.05, 0.05) is None


@pytest.mark.parametrize("row", ["1 0 0 0 0 1 0 0 0 0 1 0", "nan 0 0 0 0 0 0 1", "soon 0"])
def test_a_row_without_time_is_refused(row: str, tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_text(row)
    with pytest.raises(FileFormatError, match="line 1"):
        read_trajectory(tmp_path / "p.txt")
