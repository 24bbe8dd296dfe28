"""Camera poses in files: the matrix rows of KITTI odometry, and the rows of TUM RGB-D."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.file_bytes import read_bytes
from pnpdepth_cli.io.rotation import rotation_of

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
