"""The pose of a scanner in its camera's coordinates: a matrix, a quaternion or a ROS transform.

x_camera = rotation · x_scanner + translation. A file holds 12 or 16 numbers, the matrix [R t] by
rows; or 7 numbers, tx ty tz qx qy qz qw, as ROS and TUM write them; or what `ros2 topic echo
/tf_static` prints, with the camera as frame_id and the scanner as child_frame_id.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Extrinsics
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import one_line, read_text
from pnpdepth_cli.io.text_files import parse_yaml

Floats = NDArray[np.float64]

_SEPARATORS = re.compile(r"[\[\](),;\s]+")
_ROTATION_TOLERANCE = 1e-3
_FARTHEST_M = 1e6


def read_extrinsics(path: Path) -> Extrinsics:
    """Returns the pose of the scanner in the camera's coordinates.

    Raises:
        FileFormatError: The file holds no pose.
    """
    text = read_text(path)
    numbers = numbers_in(re.sub(r"#.*", "", text))
    if numbers is None:
        return _pose_of_transform(path, parse_yaml(path, text))
    if len(numbers) == 7:
        return pose_of_quaternion(path, numbers[:3], numbers[3:])
    if len(numbers) in (12, 16):
        return pose_of_matrix(path, "the matrix", numbers)
    raise FileFormatError(f"{path} holds {len(numbers)} numbers; a pose has 7, 12 or 16")


def numbers_in(value: object) -> list[float] | None:
    """Returns the numbers of a text, a list, nested lists, or the `data` of a matrix.

    None for anything that is not made of numbers.
    """
    if isinstance(value, Mapping):
        value = value.get("data", list(value.values()))
    if isinstance(value, str):
        value = [word for word in _SEPARATORS.split(value) if word not in ("", "-")]
    flat: list[Any] = []
    for item in value if isinstance(value, list) else [value]:
        flat += item if isinstance(item, list) else [item]
    try:
        return [float(number) for number in flat]
    except (TypeError, ValueError, OverflowError):
        return None


def pose_of_matrix(path: Path, name: str, numbers: list[float]) -> Extrinsics:
    """Returns the pose of a 3×4 or 4×4 matrix by rows. Raises FileFormatError if it is none."""
    if len(numbers) not in (12, 16):
        raise FileFormatError(f"{path}: {name} has {len(numbers)} numbers instead of 12 or 16")
    matrix = np.reshape(numbers, (-1, 4))
    if len(numbers) == 16 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise FileFormatError(f"{path}: the last row of {name} is not 0 0 0 1; correct it")
    return check_pose(path, name, matrix[:3, :3], matrix[:3, 3])


def pose_of_quaternion(path: Path, translation: list[float], xyzw: list[float]) -> Extrinsics:
    """Returns the pose of a translation and a quaternion x y z w."""
    length = float(np.linalg.norm(xyzw))
    if len(xyzw) != 4 or not abs(length - 1) < 0.01:
        raise FileFormatError(f"{path}: the quaternion has length {length:.3g} instead of 1")
    if len(translation) != 3:
        raise FileFormatError(f"{path}: a translation has 3 numbers, not {len(translation)}")
    rotation = rotation_of(np.roll(xyzw, 1))
    return check_pose(path, "the quaternion", rotation, np.array(translation))


def check_pose(path: Path, name: str, rotation: Floats, translation: Floats) -> Extrinsics:
    """Returns the pose. Raises FileFormatError if it holds no rotation, or is of no sensor."""
    if not is_rotation(rotation):
        off, turns = np.abs(rotation @ rotation.T - np.eye(3)).max(), np.linalg.det(rotation) > 0
        why = f"R·Rᵀ is off by {off:.2g}" if turns else "determinant −1: a left-handed scan?"
        raise FileFormatError(f"{path}: {name} is no rotation ({why}); correct it")
    if not (np.abs(translation) < _FARTHEST_M).all():
        raise FileFormatError(f"{path}: a translation of {one_line(translation)} m is of no sensor")
    return Extrinsics(rotation, translation)


def is_rotation(matrix: Floats) -> bool:
    """Returns whether a matrix (3, 3) turns without mirroring, to 0.1 %."""
    off = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(off <= _ROTATION_TOLERANCE and np.linalg.det(matrix) > 0)


def rotation_of(wxyz: Floats) -> Floats:
    """Returns the (3, 3) rotation of a quaternion w x y z of any length but 0, which gives NaN."""
    with np.errstate(invalid="ignore", divide="ignore"):
        w, x, y, z = wxyz / float(np.linalg.norm(wxyz))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _pose_of_transform(path: Path, content: object) -> Extrinsics:
    """The pose in a ROS transform, or in the first of several."""
    match content:
        case {"transforms": [inner, *_]} | {"transform": inner}:
            return _pose_of_transform(path, inner)
        case {
            "translation": {"x": x, "y": y, "z": z},
            "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
        }:
            numbers = numbers_in([x, y, z, qx, qy, qz, qw])
            if numbers is not None and len(numbers) == 7:
                return pose_of_quaternion(path, numbers[:3], numbers[3:])
    raise FileFormatError(f"{path} holds no matrix, no tx ty tz qx qy qz qw, no ROS transform")
