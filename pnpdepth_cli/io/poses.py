"""Poses: of a scanner in its camera's coordinates, of cameras in the world, and over time.

The pose of a scanner, x_camera = rotation · x_scanner + translation, is 12 or 16 numbers, the
matrix [R t] by rows; or 7 numbers, tx ty tz qx qy qz qw, as ROS and TUM write them; or what `ros2
topic echo /tf_static` prints, with the camera as frame_id and the scanner as child_frame_id. Those
of cameras are of KITTI odometry, TUM RGB-D or Nerfstudio.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Extrinsics
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io import file_bytes

_SEPARATORS = re.compile(r"[\[\](),;\s]+")
_ROTATION_TOLERANCE = 1e-3  # of the entries of R · Rᵀ, as files round their numbers
_QUATERNION_TOLERANCE = 0.01  # of the length of a quaternion
_LAST_ROW_TOLERANCE = 1e-6  # of 0 0 0 1, the last row of a matrix
_FARTHEST_M = 1e8  # of a place on the earth, such as in UTM
_KITTI_COLUMNS = 12  # numbers of a row of KITTI odometry: a 3×4 matrix
_WHOLE_COLUMNS = 16  # of a 4×4 matrix
_TUM_COLUMNS = 8  # of a row of the TUM benchmark: time, position, quaternion
_NAMED = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")
"""Names of the columns of a TUM row in a table with more of them, as of Stray Scanner."""
_OXTS_COLUMNS = 30
_EARTH_RADIUS_M = 6378137.0  # of WGS 84 at the equator

LONGEST_GAP_S = 0.02
"""Longest gap between a frame and its pose, as in the tools of the TUM RGB-D benchmark."""
POSES_FILE = "poses.txt"
"""What `pnpdepth frames` writes: TUM rows, one for each frame in the order of their names."""
_BAG_TIME = re.compile(r"(?<!\d)(0|[1-9]\d*)_(\d{6})$")
"""End of the names that `pnpdepth frames` gives, seconds and microseconds."""

Floats = NDArray[np.float64]


def read_extrinsics(path: Path) -> Extrinsics:
    """Returns the pose of the scanner in the camera's coordinates, in metres.

    Args:
        path: Text of 7, 12 or 16 numbers, or of a transform of ROS.

    Raises:
        InputError: The file holds no pose.
    """
    text = file_bytes.read_text(path)
    numbers = numbers_in(re.sub(r"#.*", "", text))
    if numbers is None:
        return _pose_of_transform(path, file_bytes.parse_yaml(path, text))
    if len(numbers) == 7:
        return pose_of_quaternion(path, numbers)
    if len(numbers) in (12, 16):
        return pose_of_matrix(path, "the matrix", numbers)
    raise InputError(f"{path} holds {len(numbers)} numbers; a pose has 7, 12 or 16")


def numbers_in(value: object) -> list[float] | None:
    """Returns the numbers of a value in a calibration, one after another.

    Args:
        value: Text, list, nested lists, or a mapping, whose `data` counts, or else all its values.

    Returns:
        The numbers; None for a value that is not made of numbers.
    """
    if isinstance(value, Mapping):
        value = value.get("data", list(value.values()))
    if isinstance(value, str):
        value = [word for word in _SEPARATORS.split(value) if word not in ("", "-")]
    try:
        numbers: list[float] = np.array(value, np.float64).ravel().tolist()
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers


def pose_of_matrix(path: Path, name: str, numbers: list[float]) -> Extrinsics:
    """Returns the pose of a 3×4 or 4×4 matrix.

    Args:
        path: The file that the matrix is from, for messages.
        name: Name of the matrix in messages.
        numbers: Matrix row by row, the translation in metres.

    Raises:
        InputError: The numbers are no such matrix, or the matrix holds no rotation.
    """
    if len(numbers) not in (12, 16):
        raise InputError(
            f"{path}: {name} has {len(numbers)} numbers instead of 12 or 16; correct it"
        )
    matrix = np.reshape(numbers, (-1, 4))
    if len(numbers) == 16 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(f"{path}: the last row of {name} is not 0 0 0 1; correct it")
    return check_pose(path, name, matrix[:3, :3], matrix[:3, 3])


def pose_of_quaternion(path: Path, numbers: list[float]) -> Extrinsics:
    """Returns the pose that a translation in metres and a quaternion make.

    Args:
        path: The file that the numbers are from, for messages.
        numbers: tx ty tz qx qy qz qw.

    Raises:
        InputError: The quaternion is not of length 1, or the translation is of no sensor.
    """
    translation, xyzw = np.split(np.array(numbers), [3])
    length = float(np.linalg.norm(xyzw))
    if not abs(length - 1) < _QUATERNION_TOLERANCE:
        raise InputError(
            f"{path}: the quaternion has length {length:.3g} instead of 1; correct it, x y z w in"
            " this order"
        )
    wxyz = np.roll(xyzw, 1)
    return check_pose(path, "the quaternion", rotation_of(wxyz), translation)


def check_pose(path: Path, name: str, rotation: Floats, translation: Floats) -> Extrinsics:
    """Returns the pose of a rotation (3, 3) and a translation (3,) in metres.

    Args:
        path: The file that they are from, for messages.
        name: Name of the rotation in messages.
        rotation: Matrix that should be a rotation.
        translation: Translation, which should be of a place on the earth.

    Raises:
        InputError: The matrix is no rotation, or the translation is `_FARTHEST_M` or more.
    """
    if not is_rotation(rotation):
        # A mirror is told apart: the scan's axes are left-handed.
        if not np.linalg.det(rotation) > 0:
            raise InputError(
                f"{path}: {name} is no rotation (determinant −1: a left-handed scan?); correct it"
            )
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        raise InputError(f"{path}: {name} is no rotation (R·Rᵀ is off by {off:.2g}); correct it")
    if not (np.abs(translation) < _FARTHEST_M).all():
        raise InputError(f"{path}: a translation of {translation} m is of no sensor; correct it")
    return Extrinsics(rotation, translation)


def read_oxts(paths: Sequence[Path]) -> Floats:
    """Returns the poses (N, 3, 4) of KITTI's inertial system, from its coordinates to the world's.

    The world is in metres, x east, y north, z up, in the Mercator projection of the data set's
    authors, whose scale is 1 at the first packet (Geiger et al., "Vision meets Robotics: The KITTI
    Dataset", 2013).

    Args:
        paths: Packets in oxts/data/, one for each frame; at least one.

    Raises:
        InputError: A file is no packet of 30 numbers.
    """
    from scipy.spatial.transform import Rotation

    packets = [numbers_in(file_bytes.read_text(path)) or [] for path in paths]
    for path, packet in zip(paths, packets, strict=True):
        if len(packet) != _OXTS_COLUMNS or not np.isfinite(packet[:6]).all():
            raise InputError(
                f"{path} is no packet of {_OXTS_COLUMNS} numbers of KITTI's oxts; copy it again"
            )
    # Degrees, metres and radians.
    latitude, longitude, altitude, roll, pitch, yaw = np.array(packets)[:, :6].T
    scale_m = _EARTH_RADIUS_M * np.cos(np.radians(latitude[0]))
    east = scale_m * np.radians(longitude)
    north = scale_m * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    positions = np.stack([east, north, altitude], axis=1)
    turns = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    return np.concatenate([turns, positions[:, :, None]], axis=2)


def is_rotation(matrix: Floats) -> bool:
    """Returns whether a matrix (3, 3) is a rotation, to 0.1 %; a mirroring one is none."""
    off = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(off <= _ROTATION_TOLERANCE and np.linalg.det(matrix) > 0)


def rotation_of(wxyz: Floats) -> Floats:
    """Returns the rotation (3, 3) of a quaternion (4,), w x y z.

    The quaternion may have any length. That of length 0 gives NaN.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        w, *axis = wxyz / float(np.linalg.norm(wxyz))
    cross_product = np.cross(np.eye(3), axis)  # the matrix whose product with v is axis × v
    return np.asarray(np.eye(3) + 2 * (w * cross_product + cross_product @ cross_product))


def _pose_of_transform(path: Path, content: object) -> Extrinsics:
    """The pose in a ROS transform, or in the first of several.

    Args:
        path: The file, for messages.
        content: Content of the file, as `parse_yaml` returns it.

    Raises:
        InputError: The content is no transform.
    """
    match content:
        case {"transforms": [inner, *_]} | {"transform": inner}:
            return _pose_of_transform(path, inner)
        case {
            "translation": {"x": x, "y": y, "z": z},
            "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
        }:
            numbers = numbers_in([x, y, z, qx, qy, qz, qw])
            if numbers is not None and len(numbers) == 7:
                return pose_of_quaternion(path, numbers)
    raise InputError(
        f"{path} holds no pose; give a matrix, tx ty tz qx qy qz qw, or a transform of ROS"
    )


def read_poses(path: Path) -> Floats:
    """Returns the poses (N, 3, 4) from each camera's coordinates to the world's, in file order.

    A row is one of these; `#` begins a comment:

    - 12 numbers, a 3×4 matrix (KITTI odometry)
    - 16 numbers, a 4×4 matrix, which may have four lines
    - 8 numbers: time, position, and quaternion x y z w (TUM RGB-D benchmark). There may be other
      columns if a header names these (Stray Scanner).

    Raises:
        InputError: The file cannot be read, or a row has other numbers or no rotation.
    """
    _, poses = _read_rows(path)
    return poses


def poses_of_frames(
    path: Path, names: Sequence[str], kind: str | None = None
) -> tuple[Floats, str]:
    """Returns the poses (N, 3, 4) of the frames of these names, and how they were read.

    A pose leads from the coordinates of the frame's camera, x right, y down, z forward, to the
    world's, in the unit of the file. Poses and frames are joined in the first way that fits:

    - those of a `transforms.json` by the names of its images
    - names that are times in seconds (12.5, or 12_500000 as `pnpdepth frames` writes it) with the
      row of the nearest time, at most LONGEST_GAP_S away, as evo joins trajectories
    - as many rows as frames in their order
    - the number in a name with the row of that number, from 0

    Args:
        path: A file of rows, or a transforms.json.
        names: Names of the frames.
        kind: What the file's poses are, one of `choices.POSE_KINDS`. None: "opengl" of a
            transforms.json, else "camera-to-world".

    Raises:
        InputError: A row has other numbers or no rotation, or the rows do not fit the frames.
    """
    # The poses as the file has them.
    if path.suffix.lower() == ".json":
        poses = _poses_of_nerfstudio(path, names)
        how = "joined by name"
        kind = kind or "opengl"
    else:
        poses, how = _poses_of_rows(path, names)
    # The poses from a camera with x right, y down, z forward to the world.
    direction = "from camera to world"
    axes = "x right, y down, z forward"
    if kind == "opengl":
        y_and_z_reversed = np.array([1, -1, -1, 1])  # the columns of a pose; the last is the shift
        poses = poses * y_and_z_reversed
        axes = "y up and z back (OpenGL)"
    elif kind == "world-to-camera":
        turns = poses[:, :, :3].transpose(0, 2, 1)
        poses = np.concatenate([turns, -turns @ poses[:, :, 3:]], axis=2)
        direction = "from world to camera"
    return poses, f"{how}; taken as {direction}, of axes {axes}"


def _poses_of_nerfstudio(path: Path, names: Sequence[str]) -> Floats:
    """The matrices (N, 3, 4) that a transforms.json has for the frames of these names.

    Args:
        path: The file.
        names: Names of the frames, which are those of their images without suffix.

    Raises:
        InputError: The file is no transforms.json, has no or several matrices for a frame, or one
            without a rotation.
    """
    content = file_bytes.read_json(path)
    try:
        # Path without suffix, and matrix, of each image, by the name of its file without suffix.
        by_name: dict[str, list[tuple[str, object]]] = {}
        for frame in content["frames"]:
            image = PurePosixPath(frame["file_path"]).with_suffix("")
            entry = (f"/{image.as_posix()}", frame["transform_matrix"])
            by_name.setdefault(image.name, []).append(entry)
        # The matrix of each frame. Images of several cameras are told apart by their paths.
        poses = np.empty((len(names), 3, 4))
        for index, name in enumerate(names):
            entries = by_name.get(name.rpartition("/")[2], [])
            if len(entries) > 1:
                entries = [entry for entry in entries if entry[0].endswith(f"/{name}")]
            if len(entries) != 1:
                raise InputError(
                    f"{path} has {len(entries)} frames of the name {name!r}, not one; give the"
                    " transforms.json of these images"
                )
            _, matrix = entries[0]
            poses[index] = np.array(matrix, np.float64)[:3, :4]
            if not np.isfinite(poses[index]).all() or not is_rotation(poses[index, :, :3]):
                raise ValueError(f"the pose of {name} is no rotation")
    except (LookupError, TypeError, ValueError) as error:  # of JSON that has other content
        raise InputError(
            f"{path} is no transforms.json ({file_bytes.one_line(error)}); give Nerfstudio's"
        ) from error
    return poses


def _poses_of_rows(path: Path, names: Sequence[str]) -> tuple[Floats, str]:
    """The poses (N, 3, 4) of the frames of these names in a file of rows, and how they join.

    Args:
        path: The file.
        names: Names of the frames: times in seconds, numbers of rows, or any in the rows' order.

    Raises:
        InputError: The rows do not fit the frames, or a row has other numbers or no rotation.
    """
    from scipy.spatial import KDTree

    rows, poses = _read_rows(path)
    # The names as times, where those that `pnpdepth frames` gives have _ for the decimal point, and
    # as numbers.
    with_points = [_BAG_TIME.sub(r"\1.\2", name) for name in names]
    times_s = _last_numbers(with_points)
    numbers = _last_numbers(names)
    # Names that are times take the row of the nearest time.
    has_times = rows.shape[1] == _TUM_COLUMNS and np.isfinite(rows[:, 0]).all()
    if len(times_s) == len(names) and has_times:
        gaps_s, nearest = KDTree(rows[:, :1]).query(times_s[:, None])
        # 1_000001 and 1_000002 may be frames of a sequence 1 as well, which have one row then.
        are_times = with_points == list(names) or len(set(nearest)) == len(set(times_s))
        largest_gap_s = float(gaps_s.max())
        if are_times and largest_gap_s <= LONGEST_GAP_S:
            return poses[nearest], f"joined by time, at most {1000 * largest_gap_s:.0f} ms apart"
    # Else there is a row for each frame, or the names are numbers of rows.
    if len(rows) == len(names):
        return poses, "row by row, in the order of the frames"
    if len(numbers) == len(names) and numbers.max() < len(rows):
        return poses[numbers.astype(int)], "the number in a name is that of its row, from 0"
    raise InputError(
        f"{path} has {len(rows)} poses for {len(names)} frames; give one for each, in their order,"
        " or times that are their names"
    )


def _last_numbers(names: Sequence[str]) -> Floats:
    """The number at the end of each name that ends in one; fewer numbers than names otherwise."""
    ends = (re.search(r"\d+(?:\.\d+)?$", name) for name in names)
    return np.array([float(end[0]) for end in ends if end is not None])


def _read_rows(path: Path) -> tuple[Floats, Floats]:
    """The numbers (N, 12 or 8) of the rows of a file of poses, and the poses (N, 3, 4).

    Raises:
        InputError: The file has no row, or a row has other numbers or no rotation.
    """
    # The numbers; of a table with more columns, those that its header names.
    rows, header = file_bytes.read_rows(path, file_bytes.read_bytes(path), _NAMED)
    if header and set(_NAMED) <= set(header):
        rows = rows[:, [header.index(name) for name in _NAMED]]
    rows = _without_last_rows(path, rows)
    if not len(rows) or rows.shape[1] not in (_KITTI_COLUMNS, _TUM_COLUMNS):
        raise InputError(
            f"{path} has no rows of 12 or 16 numbers, a matrix (KITTI), or of 8, time, position and"
            f" quaternion (TUM); there are {rows.shape[1]} in a row"
        )
    # The poses: matrices, or time, position and quaternion x y z w.
    if rows.shape[1] == _KITTI_COLUMNS:
        poses = rows.reshape(-1, 3, 4)
    else:
        quaternions_wxyz = np.roll(rows[:, 4:], 1, axis=1)
        turns = np.stack([rotation_of(wxyz) for wxyz in quaternions_wxyz])
        poses = np.concatenate([turns, rows[:, 1:4, None]], axis=2)
    for number, pose in enumerate(poses, start=1):
        if not np.isfinite(pose).all() or not is_rotation(pose[:, :3]):
            raise InputError(f"{path}: row {number} holds no rotation; correct it")
    return rows, poses


def _without_last_rows(path: Path, rows: Floats) -> Floats:
    """The rows of a file of poses, where 4×4 matrices have lost their last row 0 0 0 1.

    Args:
        path: The file, for messages.
        rows: (N, columns) numbers of the lines. A 4×4 matrix is 16 numbers, or four lines of 4.

    Returns:
        (N, 12) for 4×4 matrices; any other rows as they are.

    Raises:
        InputError: The last row of a matrix is not 0 0 0 1.
    """
    if rows.shape[1] == 4 and len(rows) % 4 == 0:
        rows = rows.reshape(-1, _WHOLE_COLUMNS)
    if rows.shape[1] != _WHOLE_COLUMNS:
        return rows
    differences = np.abs(rows[:, _KITTI_COLUMNS:] - (0, 0, 0, 1))
    wrong_rows = np.flatnonzero((differences > _LAST_ROW_TOLERANCE).any(axis=1))
    if len(wrong_rows):
        raise InputError(
            f"{path}: the last row of matrix {wrong_rows[0] + 1} is not 0 0 0 1; give the matrices"
            " by rows, from the camera's coordinates to the world's"
        )
    return rows[:, :_KITTI_COLUMNS]


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Poses of one body over time."""

    times_s: Floats  # (N,) seconds, ascending
    poses: Floats  # (N, 3, 4) from the body's coordinates to the world's, metres

    def at(self, time_s: float, longest_gap_s: float) -> Floats | None:
        """Returns the pose (3, 4) at a time, interpolated between the poses before and after.

        Position is interpolated linearly, rotation along the shortest arc.

        Args:
            time_s: Time in seconds.
            longest_gap_s: Longest time between two poses that are interpolated.

        Returns:
            The pose; None outside of the trajectory, and between poses with a longer gap.
        """
        from scipy.spatial.transform import Rotation, Slerp

        after = int(np.searchsorted(self.times_s, time_s))
        if after < len(self.times_s) and self.times_s[after] == time_s:
            return np.asarray(self.poses[after])
        if not 0 < after < len(self.times_s):
            return None
        # Both neighbours in time.
        pair = slice(after - 1, after + 1)
        start_s, end_s = self.times_s[pair]
        if end_s - start_s > longest_gap_s:
            return None
        turn_at = Slerp([start_s, end_s], Rotation.from_matrix(self.poses[pair, :, :3]))
        weight = (time_s - start_s) / (end_s - start_s)  # of the later pose
        shift = (1 - weight) * self.poses[after - 1, :, 3] + weight * self.poses[after, :, 3]
        return np.column_stack([turn_at(time_s).as_matrix(), shift])


def trajectory_of(times_s: Floats, poses: Floats) -> Trajectory:
    """Returns the trajectory of poses in any order; of equal times the first one stays.

    Args:
        times_s: (N,) times in seconds.
        poses: (N, 3, 4) from the body's coordinates to the world's.
    """
    ascending_s, first_indices = np.unique(times_s, return_index=True)
    return Trajectory(times_s=ascending_s, poses=poses[first_indices])


def read_trajectory(path: Path) -> Trajectory:
    """Returns the trajectory in a file with rows of time, position and quaternion x y z w.

    Raises:
        InputError: The file cannot be read, or has other rows.
    """
    rows, poses = _read_rows(path)
    if rows.shape[1] != _TUM_COLUMNS or not np.isfinite(rows[:, 0]).all():
        raise InputError(
            f"{path} is no trajectory; give rows of time, position and quaternion x y z w (TUM)"
        )
    return trajectory_of(rows[:, 0], poses)
