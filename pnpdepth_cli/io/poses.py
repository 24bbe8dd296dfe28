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
_ROTATION_TOLERANCE = 1e-3
_FARTHEST_M = 1e8  # of a place on the earth, such as in UTM
_KITTI_COLUMNS, _WHOLE_COLUMNS, _TUM_COLUMNS = 12, 16, 8
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
    """Returns the pose of the scanner in the camera's coordinates.

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
    """Returns the numbers of a text, a list, nested lists, or the `data` of a matrix.

    None for anything that is not made of numbers.
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
    """Returns the pose of a 3×4 or 4×4 matrix by rows. Raises InputError if it is none."""
    if len(numbers) not in (12, 16):
        raise InputError(
            f"{path}: {name} has {len(numbers)} numbers instead of 12 or 16; correct it"
        )
    matrix = np.reshape(numbers, (-1, 4))
    if len(numbers) == 16 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(f"{path}: the last row of {name} is not 0 0 0 1; correct it")
    return check_pose(path, name, matrix[:3, :3], matrix[:3, 3])


def pose_of_quaternion(path: Path, numbers: list[float]) -> Extrinsics:
    """Returns the pose of a translation and a quaternion, tx ty tz qx qy qz qw."""
    translation, xyzw = np.split(np.array(numbers), [3])
    length = float(np.linalg.norm(xyzw))
    if not abs(length - 1) < 0.01:
        raise InputError(
            f"{path}: the quaternion has length {length:.3g} instead of 1; correct it, x y z w in"
            " this order"
        )
    return check_pose(path, "the quaternion", rotation_of(np.roll(xyzw, 1)), translation)


def check_pose(path: Path, name: str, rotation: Floats, translation: Floats) -> Extrinsics:
    """Returns the pose. Raises InputError if it holds no rotation, or is of no sensor."""
    if not is_rotation(rotation):
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
    """Returns the poses (N, 3, 4) of KITTI's inertial system, from its packets in oxts/data/.

    Metres, x east, y north, z up, in the Mercator projection of the data set's authors, whose scale
    is 1 at the first packet (Geiger et al., "Vision meets Robotics: The KITTI Dataset", 2013).

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
    latitude, longitude, altitude, roll, pitch, yaw = np.array(packets)[:, :6].T
    scale_m = _EARTH_RADIUS_M * np.cos(np.radians(latitude[0]))
    east = scale_m * np.radians(longitude)
    north = scale_m * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    turns = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    return np.concatenate([turns, np.stack([east, north, altitude], axis=1)[:, :, None]], axis=2)


def is_rotation(matrix: Floats) -> bool:
    """Returns whether a matrix (3, 3) turns without mirroring, to 0.1 %."""
    off = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(off <= _ROTATION_TOLERANCE and np.linalg.det(matrix) > 0)


def rotation_of(wxyz: Floats) -> Floats:
    """Returns the (3, 3) rotation of a quaternion w x y z of any length but 0, which gives NaN."""
    with np.errstate(invalid="ignore", divide="ignore"):
        w, *axis = wxyz / float(np.linalg.norm(wxyz))
    turn = np.cross(np.eye(3), axis)  # turn @ v is the axis × v
    return np.asarray(np.eye(3) + 2 * (w * turn + turn @ turn))


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
                return pose_of_quaternion(path, numbers)
    raise InputError(
        f"{path} holds no pose; give a matrix, tx ty tz qx qy qz qw, or a transform of ROS"
    )


def read_poses(path: Path) -> Floats:
    """Returns the poses (N, 3, 4) from each camera's coordinates to the world's, in file order.

    Rows are 12 numbers, a 3×4 matrix (KITTI odometry), 16 of a 4×4 matrix, which may have four
    lines, or 8 numbers, time, position and quaternion x y z w (TUM RGB-D benchmark), which may be
    among others by the names in a header (Stray Scanner); `#` begins a comment.

    Raises:
        InputError: The file cannot be read, or a row has other numbers or no rotation.
    """
    return _rows(path)[1]


def poses_of_frames(
    path: Path, names: Sequence[str], kind: str | None = None
) -> tuple[Floats, str]:
    """Returns the poses (N, 3, 4) of the frames of these names, and how they were read.

    Those of a `transforms.json` are joined by the names of its images. Else, names that are times
    in seconds (12.5, or 12_500000 as `pnpdepth frames` writes it) take the row of the nearest time,
    at most LONGEST_GAP_S away, as evo joins trajectories. Else there is a row for each frame, in
    their order; or, with more rows than frames, the number in a name is that of its row from 0.

    Args:
        path: A file of rows, or a transforms.json.
        names: Names of the frames.
        kind: What the file's poses are, one of `choices.POSE_KINDS`. None: "opengl" of a
            transforms.json, else "camera-to-world".

    Raises:
        InputError: A row has other numbers or no rotation, or the rows do not fit the frames.
    """
    # As the file has them.
    if path.suffix.lower() == ".json":
        poses = _poses_of_nerfstudio(path, names)
        how = "joined by name"
        kind = kind or "opengl"
    else:
        poses, how = _poses_of_rows(path, names)
    # From a camera with x right, y down, z forward to the world.
    direction = "from camera to world"
    axes = "x right, y down, z forward"
    if kind == "opengl":
        y_and_z_turned = np.array([1, -1, -1, 1])
        poses = poses * y_and_z_turned
        axes = "y up and z back (OpenGL)"
    elif kind == "world-to-camera":
        turns = poses[:, :, :3].transpose(0, 2, 1)
        poses = np.concatenate([turns, -turns @ poses[:, :, 3:]], axis=2)
        direction = "from world to camera"
    return poses, f"{how}; taken as {direction}, of axes {axes}"


def _poses_of_nerfstudio(path: Path, names: Sequence[str]) -> Floats:
    """The matrices (N, 3, 4) of the frames of these names in a transforms.json."""
    content = file_bytes.read_json(path)
    try:
        # Paths without suffix, and matrices, by the names of the files.
        by_name: dict[str, list[tuple[str, object]]] = {}
        for frame in content["frames"]:
            file = PurePosixPath(frame["file_path"]).with_suffix("")
            entry = (f"/{file.as_posix()}", frame["transform_matrix"])
            by_name.setdefault(file.name, []).append(entry)
        # The one of each frame.
        poses = np.empty((len(names), 3, 4))
        for index, name in enumerate(names):
            entries = by_name.get(name.rpartition("/")[2], [])
            if len(entries) > 1:  # of several cameras, by their folders
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
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is no transforms.json ({file_bytes.one_line(error)}); give Nerfstudio's"
        ) from error
    return poses


def _poses_of_rows(path: Path, names: Sequence[str]) -> tuple[Floats, str]:
    """The poses (N, 3, 4) of the frames of these names in a file of rows, and how they join."""
    from scipy.spatial import KDTree

    rows, poses = _rows(path)
    dotted = [_BAG_TIME.sub(r"\1.\2", name) for name in names]
    times = _last_numbers(dotted)
    numbers = _last_numbers(names)
    # Names that are times take the row of the nearest time.
    are_rows = rows.shape[1] == _TUM_COLUMNS and np.isfinite(rows[:, 0]).all()
    if len(times) == len(names) and are_rows:
        gaps, nearest = KDTree(rows[:, :1]).query(times[:, None])
        # Frames 1_000001 and 1_000002 may be of sequence 1 as well.
        are_times = dotted == list(names) or len(set(nearest)) == len(set(times))
        largest_s = float(gaps.max())
        if are_times and largest_s <= LONGEST_GAP_S:
            return poses[nearest], f"joined by time, at most {1000 * largest_s:.0f} ms apart"
    # Else there is a row for each, or they are numbers of rows.
    if len(rows) == len(names):
        return poses, "row by row, in the order of the frames"
    if len(numbers) == len(names) and numbers.max() < len(rows):
        return poses[numbers.astype(int)], "the number in a name is that of its row, from 0"
    raise InputError(
        f"{path} has {len(rows)} poses for {len(names)} frames; give one for each, in their order,"
        " or times that are their names"
    )


def _last_numbers(names: Sequence[str]) -> Floats:
    """The numbers at the end of the names that end in one."""
    ends = (re.search(r"\d+(?:\.\d+)?$", name) for name in names)
    return np.array([float(end[0]) for end in ends if end is not None])


def _rows(path: Path) -> tuple[Floats, Floats]:
    """The numbers (N, 12 or 8) of the rows and their poses (N, 3, 4); at least one."""
    rows, header = file_bytes.read_rows(path, file_bytes.read_bytes(path), _NAMED)
    if header and set(_NAMED) <= set(header):
        rows = rows[:, [header.index(name) for name in _NAMED]]
    rows = _without_last_rows(path, rows)
    if not len(rows) or rows.shape[1] not in (_KITTI_COLUMNS, _TUM_COLUMNS):
        raise InputError(
            f"{path} has no rows of 12 or 16 numbers, a matrix (KITTI), or of 8, time, position and"
            f" quaternion (TUM); there are {rows.shape[1]} in a row"
        )
    if rows.shape[1] == _KITTI_COLUMNS:
        poses = rows.reshape(-1, 3, 4)
    else:
        turns = np.stack([rotation_of(np.roll(row[4:], 1)) for row in rows])
        poses = np.concatenate([turns, rows[:, 1:4, None]], axis=2)
    for number, pose in enumerate(poses, start=1):
        if not np.isfinite(pose).all() or not is_rotation(pose[:, :3]):
            raise InputError(f"{path}: row {number} holds no rotation; correct it")
    return rows, poses


def _without_last_rows(path: Path, rows: Floats) -> Floats:
    """Rows of 4×4 matrices, each in one line or in four, as rows of 3×4 ones; others as they are.

    Raises:
        InputError: The last row of a matrix is not 0 0 0 1.
    """
    if rows.shape[1] == 4 and len(rows) % 4 == 0:
        rows = rows.reshape(-1, _WHOLE_COLUMNS)
    if rows.shape[1] != _WHOLE_COLUMNS:
        return rows
    wrong = np.flatnonzero((np.abs(rows[:, _KITTI_COLUMNS:] - (0, 0, 0, 1)) > 1e-6).any(axis=1))
    if len(wrong):
        raise InputError(
            f"{path}: the last row of matrix {wrong[0] + 1} is not 0 0 0 1; give the matrices by"
            " rows, from the camera's coordinates to the world's"
        )
    return rows[:, :_KITTI_COLUMNS]


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Poses of one body over time."""

    times_s: Floats  # (N,) seconds, ascending
    poses: Floats  # (N, 3, 4) from the body's coordinates to the world's, metres

    def at(self, time_s: float, longest_gap_s: float) -> Floats | None:
        """Returns the pose (3, 4) at a time, interpolated between the poses before and after.

        Position is interpolated linearly, rotation along the shortest arc. None outside of the
        trajectory, and between poses that are farther apart than the longest gap.
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
    """Returns the trajectory in a file with rows of time, position and quaternion x y z w."""
    rows, poses = _rows(path)
    if rows.shape[1] != _TUM_COLUMNS or not np.isfinite(rows[:, 0]).all():
        raise InputError(
            f"{path} is no trajectory; give rows of time, position and quaternion x y z w (TUM)"
        )
    return trajectory_of(rows[:, 0], poses)
