"""Camera intrinsics and the pose of a scanner: of KITTI, OpenCV, ROS, Kalibr, and plain files.

A plain file is JSON, or lines of `name: numbers` in which brackets, commas and list dashes only
separate, and a value may continue over several lines:

    K: [721.5, 0, 609.6,  0, 721.5, 172.9,  0, 0, 1]
    R: [[0, -1, 0], [0, 0, -1], [1, 0, 0]]     # x_camera = R · x_scanner + t
    t: [0.06, -0.08, -0.27]
    distortion: []                             # OpenCV: k1 k2 p1 p2 [k3 [k4 k5 k6 …]]
    lens: radial-tangential                    # or fisheye: OpenCV's k1 k2 k3 k4
    size: [1242, 375]                          # optional: width and height

Bare numbers are K alone: 9, 16 of a 4×4 matrix (ScanNet), or fx fy cx cy [width height]. Record3D's
metadata.json has K by columns. YAML is
OpenCV's FileStorage, ROS camera_info, or Kalibr's camchain, with the intrinsics of the raw image; a
matrix T_camera_lidar there is the pose of the scanner. A folder is KITTI's raw data or KITTI-360.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Camera, Extrinsics
from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.extrinsics import check_pose, numbers_in, pose_of_matrix
from pnpdepth_cli.io.file_bytes import check_pixel_count, check_text_size, one_line, read_bytes
from pnpdepth_cli.io.formats import kind_of
from pnpdepth_cli.io.json_file import read_json
from pnpdepth_cli.io.yaml_file import parse_yaml

CAMERA = 2
"""KITTI's left colour camera, whose images the benchmarks have."""

_PERSPECTIVE, _FROM_CAMERA_0 = "perspective.txt", "calib_cam_to_velo.txt"  # of KITTI-360
_RAW_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")
_PLAIN = ("K", "R", "t", "distortion", "lens", "size")
_YAML_MARKS = ("camera_matrix:", "distortion_model:", "camera_model:", "distortion_coeffs:")
_MATRICES = ("camera_matrix", "cameraMatrix", "CameraMat", "camera_mat", "K", "k")
_DISTORTIONS = (
    *("distortion_coefficients", "distCoeffs", "dist_coeffs", "DistCoeff", "distortion_coeffs"),
    *("distortion", "D", "d"),
)
_POSES = ("T_camera_lidar", "T_cam_lidar", "T_camera_scanner", "T_cam_velo")
_LENSES = {
    **dict.fromkeys(
        ("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "none", "", "pinhole"),
        "radial-tangential",
    ),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt", "equi"), "fisheye"),
}
"""Distortion models by their names in ROS and Kalibr."""

_COEFFICIENTS = {
    "radial-tangential": (0, 4, 5, 8, 12, 14),
    "fisheye": (0, 4),
}
_FIELD = re.compile(r"^\s*([A-Za-z_]\w*)(?:\s*:|\s+(?=[-+.\d]))(.*)$")
"""A name and its value; KITTI's tracking set has names without a colon."""

_LARGEST = 1e9
"""Largest number of a calibration, in pixels or metres; beyond it, products overflow."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A camera and the scanner beside it."""

    camera: Camera
    scanner: Extrinsics | None = None  # None: the file does not state its pose
    rectification: Extrinsics = SAME_PLACE
    """Pose, in the camera's coordinates, of the camera that poses of the scanner refer to, such as
    KITTI's unrectified camera 0 in a rectified one."""
    rectified: Mapping[str, tuple[Camera, Extrinsics]] = field(default_factory=dict)
    """Cameras of rectified images by their source, where `camera` is of raw images.

    Each has the pose of `camera` in its coordinates."""


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
    if path.is_dir() or path.name in (_PERSPECTIVE, *_RAW_FILES):
        return _kitti_folder(path if path.is_dir() else path.parent, camera)
    text = _text(path)
    if text.lstrip().startswith("%YAML") or any(mark in text for mark in _YAML_MARKS):
        return camera_in_yaml(path, parse_yaml(path, text), camera)
    fields: dict[str, Any]
    if text.lstrip().startswith("{"):
        fields = read_json(path)
        if {"K", "w", "h", "poses"} <= set(fields):  # Record3D's, with K by columns
            by_rows = _matrix(path, fields, "K", (3, 3)).T.ravel().tolist()
            fields = {"K": by_rows, "width": fields["w"], "height": fields["h"]}
            return _single(path, fields, camera, "Record3D's metadata")
    elif re.search(r"\b[A-Za-z_]\w*\s*:", text):
        fields = _fields(path, text)
    else:
        fields = _bare_intrinsics(path, text)
    if any(re.fullmatch(r"P\d", str(name)) for name in fields):
        return _kitti(path, fields, camera)
    unknown = sorted(set(fields) - set(_PLAIN))
    if unknown:
        raise FileFormatError(
            f"{path}: {unknown[0]!r} is not part of a calibration; use {', '.join(_PLAIN)}"
        )
    return _single(path, fields, camera, "calibration")


def read_rigid_motion(path: Path) -> Extrinsics:
    """Returns (rotation (3, 3), translation (3,) metres) of KITTI's raw files with R and T."""
    fields = _fields(path, _text(path))
    rotation = _matrix(path, fields, "R", (3, 3))
    return check_pose(path, "R", rotation, _matrix(path, fields, "T", (3,)))


def camera_in_yaml(path: Path, content: Any, camera: int | None) -> Calibration:
    """Returns a camera of the content of a YAML file of OpenCV, ROS or Kalibr.

    `camera` is the number of a camera of a camchain, None for cam0.
    """
    if not isinstance(content, Mapping):
        raise FileFormatError(f"{path} is not a calibration; give OpenCV's, ROS's or Kalibr's YAML")
    chain = {str(k): v for k, v in content.items() if isinstance(v, Mapping) and "intrinsics" in v}
    if chain:
        name = f"cam{0 if camera is None else camera}"
        if name not in chain:
            raise UsageError(f"{path} has no {name}; --camera can be one of: {', '.join(chain)}")
        calibration = _kalibr(path, name, chain[name])
    else:
        kind = "ROS camera_info" if "distortion_model" in content else "OpenCV calibration"
        fields = {name: content[name] for name in content if name != "R"}  # the rectification
        calibration = _single(path, fields, camera, kind)
        rectified = _rectified_cameras(path, content, calibration.camera)
        calibration = replace(calibration, rectified=rectified)
    read = calibration.camera
    if not read.distortion:
        return calibration
    return replace(calibration, camera=replace(read, source=f"{read.source}, {read.lens} lens"))


def _rectified_cameras(
    path: Path, content: Mapping[str, Any], raw: Camera
) -> dict[str, tuple[Camera, Extrinsics]]:
    """The cameras of a rectified image of camera_info, without distortion.

    Whether the transforms lead to the rectified camera (kitti2bag) or to the raw one, to which R
    and the last column of P then lead, no file says. The first is as the definition of CameraInfo
    has it. Empty without P, or where P describes the raw image.
    """
    p, r = (
        next((np.array(_numbers(path, content, n)) for n in names if n in content), np.empty(0))
        for names in (("projection_matrix", "P", "p"), ("rectification_matrix", "R", "r"))
    )
    if p.size != 12 or not (p[0] > 0 and p[5] > 0):
        return {}
    intrinsics, offset = p.reshape(3, 4)[:, :3], np.zeros(3)
    turn = r.reshape(3, 3) if r.size == 9 and r.any() else np.eye(3)
    if np.linalg.det(intrinsics):
        offset = np.linalg.solve(intrinsics, p.reshape(3, 4)[:, 3])
    plain = Camera(intrinsics=intrinsics, size=raw.size, source=raw.source)
    turned = not np.allclose(turn, np.eye(3), atol=1e-9)
    cameras = {"P": (plain, SAME_PLACE)}
    if turned:
        cameras = {"P and R": (plain, Extrinsics(turn, np.zeros(3)))} | cameras
    if np.abs(offset).max() > 1e-9:
        name = "P with its offset, and R" if turned else "P with its offset"
        cameras = {name: (plain, Extrinsics(turn, offset))} | cameras
    is_raw = np.allclose(intrinsics, raw.intrinsics, atol=1e-3) and not raw.distortion
    return {} if is_raw and len(cameras) == 1 else cameras


def _kitti(path: Path, fields: Mapping[str, Any], camera: int | None) -> Calibration:
    """KITTI's object set (R0_rect, Tr_velo_to_cam), tracking set (R_rect, Tr_velo_cam) and odometry
    set (Tr, already rectified)."""
    number = _camera(path, camera, [int(n[1:]) for n in fields if re.fullmatch(r"P\d", n)])
    odometry = "Tr" in fields
    turn = "R_rect" if "R_rect" in fields else "R0_rect"
    velodyne = "Tr_velo_cam" if "Tr_velo_cam" in fields else "Tr_velo_to_cam"
    scanner = _matrix(path, fields, "Tr" if odometry else velodyne, (3, 4))
    pose = check_pose(path, "rotation of the scanner", scanner[:, :3], scanner[:, 3])
    rectify = np.eye(3) if odometry else _matrix(path, fields, turn, (3, 3))
    projection = _matrix(path, fields, f"P{number}", (3, 4))
    return _rectified_calibration(
        path, projection, rectify, pose, f"KITTI calibration, camera {number}"
    )


def _kitti_folder(folder: Path, camera: int | None) -> Calibration:
    """KITTI's raw data or KITTI-360; without the file of the scanner, the camera alone."""
    is_360 = (folder / _PERSPECTIVE).is_file()
    cameras = folder / (_PERSPECTIVE if is_360 else _RAW_FILES[0])
    if not cameras.is_file():
        raise InputError(
            f"{folder} has no {cameras.name}; give the folder with KITTI's {_RAW_FILES[0]} and"
            f" {_RAW_FILES[1]}, or one calibration file"
        )
    scanner = folder / (_FROM_CAMERA_0 if is_360 else _RAW_FILES[1])
    pose = None
    if scanner.is_file() and is_360:  # it maps camera 0 to the scanner
        pose = pose_of_matrix(scanner, "the matrix", numbers_in(_text(scanner)) or []).inverse()
    elif scanner.is_file():
        pose = read_rigid_motion(scanner)
    fields = _fields(cameras, _text(cameras))
    numbers = [int(name[-2:]) for name in fields if re.fullmatch(r"P_rect_\d\d", name)]
    number = _camera(cameras, 0 if is_360 and camera is None else camera, numbers)
    # The development kit of the raw data rotates every camera by camera 0's rectification.
    return _rectified_calibration(
        cameras,
        _matrix(cameras, fields, f"P_rect_{number:02}", (3, 4)),
        _matrix(cameras, fields, "R_rect_00", (3, 3)),
        pose,
        f"{'KITTI-360' if is_360 else 'KITTI raw'} calibration, camera {number}",
        _height_width(cameras, _numbers(cameras, fields, f"S_rect_{number:02}", 2)),
    )


def _bare_intrinsics(path: Path, text: str) -> dict[str, Any]:
    """K, and the size if it is there, of numbers without names."""
    numbers = numbers_in(text) or []
    if len(numbers) == 16:  # ScanNet's, by rows
        return {"K": [numbers[i] for i in (0, 1, 2, 4, 5, 6, 8, 9, 10)]}
    if len(numbers) in (4, 6):
        fx, fy, cx, cy, *size = numbers
        return {"K": [fx, 0, cx, 0, fy, cy, 0, 0, 1]} | ({"size": size} if size else {})
    return {"K": text}


def _rectified_calibration(
    path: Path,
    projection: Floats,
    rectify: Floats,
    scanner: Extrinsics | None,
    source: str,
    size: tuple[int, int] | None = None,
) -> Calibration:
    """The calibration P · R_rect · [R t]; the last column of P gives the camera's own offset."""
    intrinsics = _check_intrinsics(path, projection[:, :3])
    offset = np.asarray(np.linalg.solve(intrinsics, projection[:, 3]), np.float64)
    rectify_pose = check_pose(path, "rectification", rectify, offset)
    return Calibration(
        camera=Camera(intrinsics=intrinsics, size=size, source=source),
        scanner=None if scanner is None else rectify_pose @ scanner,
        rectification=rectify_pose,
    )


def _kalibr(path: Path, name: str, fields: Mapping[str, Any]) -> Calibration:
    model = str(fields.get("camera_model", "pinhole"))
    values = _numbers(path, fields, "intrinsics")
    lens = str(fields.get("distortion_model", "none"))
    distortion = fields.get("distortion_coeffs", [])
    if model != "pinhole" or len(values) != 4:
        raise FileFormatError(
            f"{path}: {name} is a {one_line(model)[:20]} camera with {len(values)} intrinsics; only"
            " pinhole (4) is known, so calibrate it as one"
        )
    fx, fy, cx, cy = values
    single = {name: fields[name] for name in _POSES if name in fields}
    single |= {"K": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "distortion": distortion, "lens": lens}
    if "resolution" in fields:
        single["size"] = fields["resolution"]
    return _single(path, single, None, f"Kalibr camchain, {name}")


def _single(path: Path, fields: Mapping[str, Any], camera: int | None, source: str) -> Calibration:
    """The camera of a plain file, or of one of OpenCV or ROS."""
    if camera is not None:
        raise UsageError(f"{path} describes one camera; leave out --camera {camera}")
    matrix = next((name for name in _MATRICES if name in fields), "K")
    intrinsics = _check_intrinsics(path, _matrix(path, fields, matrix, (3, 3)))
    scanner = _pose(path, fields)
    lens, distortion = _lens(path, fields)
    size = _size(path, fields)
    return Calibration(
        camera=Camera(
            intrinsics=intrinsics, lens=lens, distortion=distortion, size=size, source=source
        ),
        scanner=scanner,
    )


def _lens(path: Path, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
    model = str(fields.get("lens", fields.get("distortion_model")) or "none").strip(" \"'")
    is_fisheye = str(fields.get("fisheye_model", "0")).lower() not in ("0", "false")
    if is_fisheye and "distortion_model" not in fields:  # of OpenCV
        model = "fisheye"
    lens = _LENSES.get(model)
    if lens is None:
        known = ", ".join(name for name in _LENSES if name)
        raise FileFormatError(
            f"{path}: distortion model {one_line(model)[:30]!r} is not known; known are {known}"
        )
    name = next((name for name in _DISTORTIONS if name in fields), None)
    coefficients = () if name is None else tuple(_numbers(path, fields, name))
    if lens == "radial-tangential" and not any(coefficients):
        coefficients = ()
    if len(coefficients) not in _COEFFICIENTS[lens]:
        wanted = " or ".join(str(count) for count in _COEFFICIENTS[lens])
        raise FileFormatError(
            f"{path}: {len(coefficients)} coefficients of {lens} distortion instead of {wanted}"
        )
    return lens, coefficients


def _pose(path: Path, fields: Mapping[str, Any]) -> Extrinsics | None:
    name = next((name for name in _POSES if name in fields), None)
    if name is not None:
        return pose_of_matrix(path, name, _numbers(path, fields, name))
    present = [name for name in ("R", "t") if name in fields]
    if not present:
        return None
    if len(present) == 1:
        missing = "t" if present == ["R"] else "R"
        raise FileFormatError(f"{path} has {present[0]} but no {missing}; give both")
    rotation = _matrix(path, fields, "R", (3, 3))
    return check_pose(path, "R", rotation, _matrix(path, fields, "t", (3,)))


def _size(path: Path, fields: Mapping[str, Any]) -> tuple[int, int] | None:
    if "size" in fields:
        return _height_width(path, _numbers(path, fields, "size", 2))
    names = [next((n for n in (f"image_{s}", s) if n in fields), "") for s in ("width", "height")]
    if not all(names):
        return None
    return _height_width(path, [_numbers(path, fields, name, 1)[0] for name in names])


def _text(path: Path) -> str:
    if path.suffix.lower() != ".json":  # Record3D's has the poses of all frames
        check_text_size(path)
    data = read_bytes(path)
    if kind_of(data) is None and b"\0" not in data:
        try:
            return data.decode("utf-8-sig")
        except UnicodeDecodeError:
            pass
    raise FileFormatError(
        f"{path} is not a text file; give a calibration of KITTI, or JSON or text with K, R and t"
    )


def _fields(path: Path, text: str) -> dict[str, Any]:
    """`name: value`; a line without a name continues the value before it."""
    fields: dict[str, list[str]] = {}
    name = None
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0]
        match = _FIELD.match(content)
        if match:
            name = match[1]
            if name in fields:
                raise FileFormatError(f"{path}, line {number}: {name} occurs twice; keep one")
            fields[name] = [match[2]]
        elif content.strip() and content.strip() != "---":
            if name is None:
                raise FileFormatError(
                    f"{path}, line {number}: {one_line(content)[:60]!r} has no name before it;"
                    " write NAME: NUMBERS"
                )
            fields[name].append(content)
    return {name: " ".join(parts) for name, parts in fields.items()}


def _numbers(
    path: Path, fields: Mapping[str, Any], name: str, count: int | None = None
) -> list[float]:
    """The finite numbers of a field; so many, if there is a count."""
    if name not in fields:
        raise FileFormatError(
            f"{path} has no {name}; this calibration is incomplete or of another kind"
        )
    numbers = numbers_in(fields[name])
    if numbers is None or not np.isfinite(numbers).all():
        raise FileFormatError(f"{path}: {name} is not made of finite numbers; correct it")
    if max(map(abs, numbers), default=0) > _LARGEST:
        raise FileFormatError(
            f"{path}: {name} holds {max(numbers, key=abs):g}, which no camera has; correct it"
        )
    if count is not None and len(numbers) != count:
        raise FileFormatError(f"{path}: {name} has {len(numbers)} numbers instead of {count}")
    return numbers


def _matrix(path: Path, fields: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Floats:
    return np.reshape(_numbers(path, fields, name, math.prod(shape)), shape)


def _camera(path: Path, wanted: int | None, present: list[int]) -> int:
    number = CAMERA if wanted is None else wanted
    if number not in present:
        listing = ", ".join(str(n) for n in sorted(present)) or "none"
        raise UsageError(f"{path} has no camera {number}; --camera can be one of: {listing}")
    return number


def _check_intrinsics(path: Path, matrix: Floats) -> Floats:
    bottom = np.array_equal(matrix[2], [0, 0, 1])
    if not (bottom and matrix[0, 0] > 0 and matrix[1, 1] > 0 and matrix[1, 0] == 0):
        raise FileFormatError(
            f"{path}: the intrinsics are not of the form fx s cx, 0 fy cy, 0 0 1; correct them"
        )
    return matrix


def _height_width(path: Path, size: Sequence[float]) -> tuple[int, int]:
    width, height = (round(value) for value in size)
    if width < 1 or height < 1:
        raise FileFormatError(f"{path}: an image of {width}×{height} pixels is no image")
    check_pixel_count(path, width, height)
    return height, width
