"""The pose of a scanner in its camera's coordinates, as a matrix, a quaternion or a ROS transform.

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

from pnpdepth_cli.camera import Extrinsics
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import check_text_size, one_line, read_bytes
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
    check_text_size(path)
    text = read_bytes(path).decode("utf-8", "replace")
    numbers = numbers_in(re.sub(r"#.*", "", text))
    if numbers is None:
        return _pose_of_fields(path, parse_yaml(path, text))
    if len(numbers) == 7:
        return pose_of_quaternion(path, numbers[:3], numbers[3:])
    if len(numbers) in (12, 16):
        return pose_of_matrix(path, "the matrix", numbers)
    kinds = "12 or 16 of a matrix by rows, or tx ty tz qx qy qz qw"
    raise FileFormatError(f"{path} holds {len(numbers)} numbers; extrinsics are {kinds}")


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
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if off <= _ROTATION_TOLERANCE:
            raise FileFormatError(
                f"{path}: the {name} is no rotation but mirrors (determinant −1): the scan is"
                " left-handed, as CARLA's and Unity's are; negate its y, and the second column here"
            )
        raise FileFormatError(f"{path}: the {name} is no rotation (R·Rᵀ is off by {off:.2g})")
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


def _pose_of_fields(path: Path, fields: object) -> Extrinsics:
    """The pose in a mapping; tf nests it: transforms: - header, transform: translation, …."""
    for _ in range(3):
        if isinstance(fields, list) and fields:
            fields = fields[0]
        if not isinstance(fields, Mapping):
            break
        shift = next((fields[n] for n in ("translation", "t", "T") if n in fields), None)
        turn = next((fields[n] for n in ("rotation", "quaternion", "R") if n in fields), None)
        if shift is not None and turn is not None:
            translation, numbers = (
                _components(path, *pair) for pair in ((shift, "xyz"), (turn, "xyzw"))
            )
            if len(numbers) == 9 and len(translation) == 3:
                rotation = np.reshape(numbers, (3, 3))
                return check_pose(path, "rotation", rotation, np.array(translation))
            return pose_of_quaternion(path, translation, numbers)
        name = next((n for n in fields if str(n).startswith(("T_", "matrix"))), None)
        if name is not None:
            return pose_of_matrix(path, str(name), _components(path, fields[name], ""))
        fields = fields.get("transforms", fields.get("transform"))
    kinds = "a matrix, tx ty tz qx qy qz qw, or translation and rotation"
    raise FileFormatError(f"{path} holds no extrinsics; give {kinds}")


def _components(path: Path, value: object, names: str) -> list[float]:
    """The numbers of a list, or of the fields of these names."""
    if isinstance(value, Mapping) and "data" not in value:
        value = [value.get(name) for name in names]
    numbers = numbers_in(value)
    if numbers is None:
        raise FileFormatError(f"{path}: {one_line(value)[:60]} is not made of numbers; correct it")
    return numbers
