"""Camera intrinsics and the pose of a scanner: of KITTI, OpenCV, ROS, Kalibr, and plain files.

A plain file is JSON, or lines of `name: numbers` in which brackets, commas and list dashes only
separate, and a value may continue over several lines:

    K: [721.5, 0, 609.6,  0, 721.5, 172.9,  0, 0, 1]
    R: [[0, -1, 0], [0, 0, -1], [1, 0, 0]]     # x_camera = R · x_scanner + t
    t: [0.06, -0.08, -0.27]
    distortion: []                             # OpenCV: k1 k2 p1 p2 [k3 [k4 k5 k6 …]]
    lens: radial-tangential                    # or fisheye: OpenCV's k1 k2 k3 k4
    size: [1242, 375]                          # optional: width and height

Nine bare numbers are K alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.file_bytes import check_pixel_count, one_line, read_bytes
from pnpdepth_cli.io.formats import kind_of
from pnpdepth_cli.io.robot_calibration import Calibration, camera_in_yaml, is_robot_calibration
from pnpdepth_cli.io.yaml_file import parse_yaml

__all__ = ["CAMERA", "Calibration", "Floats", "read_calibration", "read_rigid_motion"]

CAMERA = 2
"""KITTI's left colour camera, whose images the benchmarks have."""

_RAW_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")
_COEFFICIENTS = {"radial-tangential": (0, 4, 5, 8, 12, 14), "fisheye": (4,)}
_PLAIN = ("K", "R", "t", "distortion", "lens", "size")
_SEPARATORS = re.compile(r"[\[\](),;\s]+")
_FIELD = re.compile(r"^\s*([A-Za-z_]\w*)\s*:(.*)$")
_ROTATION_TOLERANCE = 1e-3
_LARGEST = 1e9
"""Of the numbers of a calibration, in pixels or metres; beyond it, products overflow."""

Floats = NDArray[np.float64]


def read_calibration(path: Path, camera: int | None = None) -> Calibration:
    """Returns the calibration in a file, or in a folder of KITTI's raw data.

    Args:
        path: File or folder.
        camera: 0 to 3 of KITTI's, None for 2, the left colour camera; or the number of a camera of
            Kalibr's, None for cam0.

    Raises:
        FileFormatError: A matrix is missing, or is not made of numbers that a camera can have.
        InputError: The file cannot be read.
        UsageError: There is no such camera.
    """
    if path.is_dir() or path.name in _RAW_FILES:
        return _kitti_raw(path if path.is_dir() else path.parent, camera)
    text = _text(path)
    if is_robot_calibration(text):
        calibration = camera_in_yaml(path, parse_yaml(path, text), camera)
        _check_intrinsics(path, calibration.intrinsics)
        return calibration
    if text.lstrip().startswith("{"):
        return _plain(path, _json_fields(path, text), camera)
    if not re.search(r"[A-Za-z_]\w*\s*:", text):
        return _plain(path, {"K": text}, camera)
    fields = _fields(path, text)
    if any(re.fullmatch(r"P\d", name) for name in fields):
        return _kitti(path, fields, camera)
    return _plain(path, fields, camera)


def read_rigid_motion(path: Path) -> tuple[Floats, Floats]:
    """Returns (rotation (3, 3), translation (3,) metres) of KITTI's raw files with R and T.

    Raises:
        FileFormatError: One is missing, or the rotation is none.
        InputError: The file cannot be read.
    """
    fields = _fields(path, _text(path))
    rotation = _matrix(path, fields, "R", (3, 3))
    _check_rotation(path, "R", rotation)
    return rotation, _matrix(path, fields, "T", (3,))


def _kitti(path: Path, fields: dict[str, str], camera: int | None) -> Calibration:
    """KITTI's object set (R0_rect, Tr_velo_to_cam) and odometry set (Tr, already rectified)."""
    number = _camera(path, camera, [int(n[1:]) for n in fields if re.fullmatch(r"P\d", n)])
    projection = _matrix(path, fields, f"P{number}", (3, 4))
    source = f"KITTI calibration, camera {number}"
    if "Tr" in fields:
        return _rectified(path, projection, np.eye(3), _matrix(path, fields, "Tr", (3, 4)), source)
    velo_to_cam = _matrix(path, fields, "Tr_velo_to_cam", (3, 4))
    rectify = _matrix(path, fields, "R0_rect", (3, 3))
    return _rectified(path, projection, rectify, velo_to_cam, source)


def _kitti_raw(folder: Path, camera: int | None) -> Calibration:
    cameras, scanner = (folder / name for name in _RAW_FILES)
    if not cameras.is_file() or not scanner.is_file():
        missing = next(p for p in (cameras, scanner) if not p.is_file())
        raise InputError(
            f"{folder} has no {missing.name}; give the folder with KITTI's {_RAW_FILES[0]} and"
            f" {_RAW_FILES[1]}, or one calibration file"
        )
    fields = _fields(cameras, _text(cameras))
    cameras_there = [
        int(n.removeprefix("P_rect_")) for n in fields if re.fullmatch(r"P_rect_\d\d", n)
    ]
    number = _camera(cameras, camera, cameras_there)
    pose = _fields(scanner, _text(scanner))
    # The raw data's development kit rotates every camera by camera 0's rectification.
    return _rectified(
        cameras,
        _matrix(cameras, fields, f"P_rect_{number:02}", (3, 4)),
        _matrix(cameras, fields, "R_rect_00", (3, 3)),
        np.column_stack([_matrix(scanner, pose, "R", (3, 3)), _matrix(scanner, pose, "T", (3, 1))]),
        f"KITTI raw calibration, camera {number}",
        size=_numbers(cameras, fields, f"S_rect_{number:02}", (2,)),
    )


def _rectified(
    path: Path,
    projection: Floats,
    rectify: Floats,
    scanner: Floats,
    source: str,
    size: Sequence[float] | None = None,
) -> Calibration:
    """P · R_rect · [R t], with the camera's own offset in P's last column as a translation."""
    intrinsics = projection[:, :3]
    _check_intrinsics(path, intrinsics)
    _check_rotation(path, "rectification", rectify)
    _check_rotation(path, "rotation of the scanner", scanner[:, :3])
    return Calibration(
        intrinsics=intrinsics,
        rotation=rectify @ scanner[:, :3],
        translation=rectify @ scanner[:, 3] + np.linalg.solve(intrinsics, projection[:, 3]),
        distortion=(),
        size=None if size is None else _height_width(path, size),
        has_pose=True,
        source=source,
    )


def _plain(path: Path, fields: dict[str, str], camera: int | None) -> Calibration:
    unknown = sorted(set(fields) - set(_PLAIN))
    if unknown:
        raise FileFormatError(
            f"{path}: {unknown[0]!r} is not part of a calibration; use {', '.join(_PLAIN)}"
        )
    if camera is not None:
        raise UsageError(f"{path} describes one camera; leave out --camera {camera}")
    intrinsics = _matrix(path, fields, "K", (3, 3))
    _check_intrinsics(path, intrinsics)
    if ("R" in fields) != ("t" in fields):
        present, missing = ("R", "t") if "R" in fields else ("t", "R")
        raise FileFormatError(f"{path} has {present} but no {missing}; give both")
    has_pose = "R" in fields
    rotation = _matrix(path, fields, "R", (3, 3)) if has_pose else np.eye(3)
    _check_rotation(path, "R", rotation)
    lens = fields.get("lens", "radial-tangential").strip(" \"'")
    if lens not in _COEFFICIENTS:
        raise FileFormatError(
            f"{path}: lens {one_line(lens)[:40]!r} is not one of {', '.join(_COEFFICIENTS)}"
        )
    counts = _COEFFICIENTS[lens]
    distortion = _numbers(path, fields, "distortion", counts) if "distortion" in fields else []
    return Calibration(
        intrinsics=intrinsics,
        rotation=rotation,
        translation=_matrix(path, fields, "t", (3,)) if has_pose else np.zeros(3),
        distortion=tuple(distortion),
        lens=lens,
        size=_height_width(path, _numbers(path, fields, "size", (2,)))
        if "size" in fields
        else None,
        has_pose=has_pose,
        source="calibration",
    )


def _text(path: Path) -> str:
    data = read_bytes(path)
    if kind_of(data) is None and b"\0" not in data:
        try:
            return data.decode("utf-8-sig")
        except UnicodeDecodeError:
            pass
    raise FileFormatError(
        f"{path} is not a text file; give a calibration of KITTI, or JSON or text with K, R and t"
    )


def _fields(path: Path, text: str) -> dict[str, str]:
    """`name: value`; a line without a name continues the value before it."""
    fields: dict[str, str] = {}
    name = None
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0]
        match = _FIELD.match(content)
        if match:
            name = match[1]
            if name in fields:
                raise FileFormatError(f"{path}, line {number}: {name} occurs twice; keep one")
            fields[name] = match[2]
        elif content.strip() and content.strip() != "---":
            if name is None:
                raise FileFormatError(
                    f"{path}, line {number}: {one_line(content)[:60]!r} has no name before it;"
                    " write NAME: NUMBERS"
                )
            fields[name] += f" {content}"
    return fields


def _json_fields(path: Path, text: str) -> dict[str, str]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"{path} is not valid JSON ({one_line(error)}); correct it"
        ) from error
    return {str(name): json.dumps(value) for name, value in content.items()}


def _numbers(path: Path, fields: dict[str, str], name: str, counts: Sequence[int]) -> list[float]:
    """The finite numbers of a field, as many as one of `counts`."""
    if name not in fields:
        raise FileFormatError(
            f"{path} has no {name}; this calibration is incomplete or of another kind"
        )
    words = [w for w in _SEPARATORS.split(fields[name]) if w not in ("", "-")]
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [np.nan]
    if not np.isfinite(numbers).all():
        raise FileFormatError(f"{path}: {name} is not made of finite numbers; correct it")
    if max(map(abs, numbers), default=0) > _LARGEST:
        raise FileFormatError(
            f"{path}: {name} holds {max(numbers, key=abs):g}, which no camera has; correct it"
        )
    if len(numbers) not in counts:
        wanted = " or ".join(str(count) for count in counts)
        raise FileFormatError(f"{path}: {name} has {len(numbers)} numbers instead of {wanted}")
    return numbers


def _matrix(path: Path, fields: dict[str, str], name: str, shape: tuple[int, ...]) -> Floats:
    return np.reshape(_numbers(path, fields, name, (int(np.prod(shape)),)), shape)


def _camera(path: Path, wanted: int | None, present: list[int]) -> int:
    number = CAMERA if wanted is None else wanted
    if number not in present:
        listing = ", ".join(str(n) for n in sorted(present)) or "none"
        raise UsageError(f"{path} has no camera {number}; --camera can be one of: {listing}")
    return number


def _check_intrinsics(path: Path, matrix: Floats) -> None:
    bottom = np.array_equal(matrix[2], [0, 0, 1])
    if not (bottom and matrix[0, 0] > 0 and matrix[1, 1] > 0 and matrix[1, 0] == 0):
        raise FileFormatError(
            f"{path}: the intrinsics are not of the form fx s cx, 0 fy cy, 0 0 1; correct them"
        )


def _check_rotation(path: Path, name: str, matrix: Floats) -> None:
    off = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not off <= _ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        raise FileFormatError(f"{path}: the {name} is no rotation (R·Rᵀ is off by {off:.2g})")


def _height_width(path: Path, size: Sequence[float]) -> tuple[int, int]:
    width, height = (round(value) for value in size)
    if width < 1 or height < 1:
        raise FileFormatError(f"{path}: an image of {width}×{height} pixels is no image")
    check_pixel_count(path, width, height)
    return height, width
