"""The pose of a scanner in its camera's frame, as a matrix, a quaternion or a ROS transform.

x_camera = rotation · x_scanner + translation. A file holds one of

    16 or 12 numbers              the matrix [R t], by rows
    7 numbers                     tx ty tz qx qy qz qw, as ROS and TUM write them
    translation: [x, y, z]        YAML or JSON; the quaternion is x, y, z, w. `ros2 topic echo
    rotation: [x, y, z, w]        /tf_static` and fields x: y: z: w: are read too, with the camera
                                  as frame_id and the scanner as child_frame_id
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.yaml_file import parse_yaml

Floats = NDArray[np.float64]
Extrinsics = tuple[Floats, Floats]
"""(rotation (3, 3), translation (3,))."""

_SEPARATORS = re.compile(r"[\[\](),;\s]+")
_ROTATION_TOLERANCE = 1e-3
_FARTHEST_M = 1e6


def read_extrinsics(path: Path) -> Extrinsics:
    """Returns (rotation, translation) from the scanner's frame to the camera's.

    Raises:
        FileFormatError: The file holds no pose.
    """
    text = read_bytes(path).decode("utf-8", "replace")
    words = [word for word in _SEPARATORS.split(re.sub(r"#.*", "", text)) if word]
    try:
        return _pose_of_numbers(path, [float(word) for word in words])
    except ValueError:
        return _pose_of_fields(path, parse_yaml(path, text))


def pose_of_matrix(path: Path, name: str, numbers: list[float]) -> Extrinsics:
    """Returns the pose of a 3×4 or 4×4 matrix by rows. Raises FileFormatError if it is none."""
    if len(numbers) not in (12, 16):
        raise FileFormatError(f"{path}: {name} has {len(numbers)} numbers instead of 12 or 16")
    matrix = np.reshape(numbers, (-1, 4))
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    _check_translation(path, translation)
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not off <= _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise FileFormatError(f"{path}: {name} has no rotation (R·Rᵀ is off by {off:.2g})")
    if len(numbers) == 16 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise FileFormatError(f"{path}: the last row of {name} is not 0 0 0 1; correct it")
    return rotation, translation


def pose_of_quaternion(path: Path, translation: list[float], xyzw: list[float]) -> Extrinsics:
    """Returns the pose of a translation and a quaternion x y z w."""
    length = float(np.linalg.norm(xyzw))
    if len(xyzw) != 4 or not abs(length - 1) < 0.01:
        raise FileFormatError(f"{path}: the quaternion has length {length:.3g} instead of 1")
    if len(translation) != 3:
        raise FileFormatError(f"{path}: a translation has 3 numbers, not {len(translation)}")
    _check_translation(path, np.array(translation))
    return rotation_of(np.roll(xyzw, 1)), np.array(translation)


def inverse(pose: Extrinsics) -> Extrinsics:
    """Returns the pose of the camera in the scanner's frame."""
    rotation, translation = pose
    return rotation.T, -rotation.T @ translation


def _pose_of_numbers(path: Path, numbers: list[float]) -> Extrinsics:
    if len(numbers) == 7:
        return pose_of_quaternion(path, numbers[:3], numbers[3:])
    if len(numbers) in (12, 16):
        return pose_of_matrix(path, "the matrix", numbers)
    raise FileFormatError(
        f"{path} holds {len(numbers)} numbers; extrinsics are 12 or 16 of a matrix by rows, or 7:"
        " tx ty tz qx qy qz qw"
    )


def _pose_of_fields(path: Path, content: Any) -> Extrinsics:
    fields = content
    for _ in range(3):  # transforms: - header, transform: translation, rotation
        if isinstance(fields, list) and fields:
            fields = fields[0]
        if not isinstance(fields, Mapping):
            break
        if "translation" in fields and {"rotation", "quaternion"} & fields.keys():
            turn = fields.get("rotation", fields.get("quaternion"))
            shift = _components(path, fields["translation"], "xyz")
            numbers = _components(path, turn, "xyzw")
            if len(numbers) == 9:
                rows = [[*numbers[3 * i : 3 * i + 3], shift[i]] for i in range(3)]
                return pose_of_matrix(path, "rotation", [v for row in rows for v in row])
            return pose_of_quaternion(path, shift, numbers)
        if "R" in fields and {"t", "T"} & fields.keys():
            turn, shift = (
                _components(path, fields[n], "xyz") for n in ("R", "t" if "t" in fields else "T")
            )
            if len(turn) == 9 and len(shift) == 3:
                rows = [[*turn[3 * i : 3 * i + 3], shift[i]] for i in range(3)]
                return pose_of_matrix(path, "R", [v for row in rows for v in row])
        name = next((n for n in fields if str(n).startswith(("T_", "matrix"))), None)
        if name is not None:
            return pose_of_matrix(path, str(name), _components(path, fields[name], "xyz"))
        fields = fields.get("transforms", fields.get("transform"))
    raise FileFormatError(
        f"{path} holds no extrinsics; give a matrix, tx ty tz qx qy qz qw, or translation and"
        " rotation"
    )


def _components(path: Path, value: Any, names: str) -> list[float]:
    if isinstance(value, Mapping):
        value = value.get("data", [value.get(name) for name in names])
    flat: list[Any] = []
    for each in value if isinstance(value, list) else [value]:
        flat += each if isinstance(each, list) else [each]
    try:
        return [float(each) for each in flat]
    except (TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(
            f"{path}: {one_line(value)[:60]} is not made of numbers; correct it"
        ) from error


def _check_translation(path: Path, translation: Floats) -> None:
    if not (np.abs(translation) < _FARTHEST_M).all():
        raise FileFormatError(
            f"{path}: a translation of {one_line(translation)} m is none of a sensor; correct it"
        )


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
