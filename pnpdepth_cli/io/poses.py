"""Camera poses in files, in rows of KITTI odometry or of TUM RGB-D, and at the times of images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.extrinsics import rotation_of
from pnpdepth_cli.io.file_bytes import read_bytes

_KITTI_COLUMNS, _TUM_COLUMNS = 12, 8
_ROTATION_TOLERANCE = 1e-3

Floats = NDArray[np.float64]


def read_poses(path: Path) -> Floats:
    """Returns the poses (N, 3, 4) from each camera's frame to the world's, in file order.

    Args:
        path: Rows of 12 numbers, a 3×4 matrix (KITTI odometry), or of 8 numbers, time, position
            and quaternion x y z w (TUM RGB-D benchmark); `#` begins a comment.

    Raises:
        FileFormatError: A row has other numbers, or its rotation is none.
        InputError: The file cannot be read.
    """
    poses = [pose for _, _, pose in pose_rows(path)]
    if not poses:
        raise FileFormatError(f"{path} has no poses")
    return np.stack(poses)


def read_pose_of_each(path: Path, count: int, what: str) -> Floats:
    """Returns the poses (count, 3, 4) of a file that has one row for each of something.

    Args:
        path: As `read_poses` takes it.
        count: Number of poses that are needed.
        what: What they are of, in the plural.

    Raises:
        InputError: The file has another number of poses, or cannot be read.
    """
    poses = read_poses(path)
    if len(poses) != count:
        raise InputError(
            f"{path} has {len(poses)} poses for {count} {what}; it needs one row for each, in"
            " their order"
        )
    return poses


def pose_rows(path: Path) -> Iterator[tuple[int, Floats, Floats]]:
    """Yields (line, its numbers, the pose (3, 4)) of each row, as `read_poses` takes them."""
    for number, line in enumerate(read_bytes(path).decode("utf-8", "replace").splitlines(), 1):
        words = line.partition("#")[0].split()
        if words:
            yield number, *_pose(path, number, words)


def _pose(path: Path, number: int, words: list[str]) -> tuple[Floats, Floats]:
    """The numbers of a row, and the pose (3, 4)."""
    try:
        values = np.array(words, np.float64)
    except ValueError:
        raise FileFormatError(f"{path}: line {number} is not made of numbers") from None
    if len(values) == _KITTI_COLUMNS:
        pose = values.reshape(3, 4)
    elif len(values) == _TUM_COLUMNS:
        pose = np.column_stack([rotation_of(np.roll(values[4:], 1)), values[1:4]])
    else:
        raise FileFormatError(
            f"{path}: line {number} has {len(values)} numbers; a pose has 12 (KITTI) or 8 (TUM)"
        )
    rotation = pose[:, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=_ROTATION_TOLERANCE)
    if not (np.isfinite(pose).all() and is_rotation and np.linalg.det(rotation) > 0):
        raise FileFormatError(f"{path}: line {number} holds no rotation")
    return values, pose


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Poses of one body over time."""

    times_s: Floats
    """(N,) seconds, ascending."""
    poses: Floats
    """(N, 3, 4) from the body's frame to the world's, metres."""

    def at(self, time_s: float, longest_gap_s: float) -> Floats | None:
        """Returns the pose (3, 4) at a time, interpolated between the poses before and after.

        Position is interpolated linearly, rotation along the shortest arc. None outside of the
        trajectory, and between poses that are farther apart than the longest gap.

        Args:
            time_s: Seconds, on the trajectory's clock.
            longest_gap_s: Between two poses, seconds.
        """
        from scipy.spatial.transform import Rotation, Slerp

        after = int(np.searchsorted(self.times_s, time_s))
        if after < len(self.times_s) and self.times_s[after] == time_s:
            return np.asarray(self.poses[after])
        if not 0 < after < len(self.times_s):
            return None
        pair = slice(after - 1, after + 1)
        start, end = self.times_s[pair]
        if end - start > longest_gap_s:
            return None
        turns = Slerp([start, end], Rotation.from_matrix(self.poses[pair, :, :3]))
        weight = (time_s - start) / (end - start)
        shift = (1 - weight) * self.poses[after - 1, :, 3] + weight * self.poses[after, :, 3]
        return np.column_stack([turns(time_s).as_matrix(), shift])


def trajectory_of(times_s: Floats, poses: Floats) -> Trajectory:
    """Returns the trajectory of poses (N, 3, 4) in any order; of equal times the first stays."""
    times_s, first = np.unique(times_s, return_index=True)
    return Trajectory(times_s=times_s, poses=poses[first])


def read_trajectory(path: Path) -> Trajectory:
    """Returns the trajectory in a file with rows of time, position and quaternion x y z w.

    Raises:
        FileFormatError: A row has other numbers, or its rotation is none.
        InputError: The file cannot be read.
    """
    times, poses = [], []
    for number, values, pose in pose_rows(path):
        if len(values) != _TUM_COLUMNS or not np.isfinite(values[0]):
            raise FileFormatError(
                f"{path}: line {number} is not a time, a position and a quaternion x y z w"
            )
        times.append(values[0])
        poses.append(pose)
    if not poses:
        raise FileFormatError(f"{path} has no poses")
    return trajectory_of(np.array(times), np.stack(poses))
