"""Poses at the times of images: a trajectory, read from rows of the TUM RGB-D benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.poses import pose_rows

_COLUMNS = 8  # time, position, quaternion x y z w

Floats = NDArray[np.float64]


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
        if len(values) != _COLUMNS or not np.isfinite(values[0]):
            raise FileFormatError(
                f"{path}: line {number} is not a time, a position and a quaternion x y z w"
            )
        times.append(values[0])
        poses.append(pose)
    if not poses:
        raise FileFormatError(f"{path} has no poses")
    return trajectory_of(np.array(times), np.stack(poses))
