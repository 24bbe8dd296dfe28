"""Camera intrinsics and the pose of a scanner: of KITTI, OpenCV, ROS, Kalibr, and plain files.

A plain file is JSON, or lines of `name: numbers` in which brackets, commas and list dashes only
separate, and a value may continue over several lines:

    K: [721.5, 0, 609.6,  0, 721.5, 172.9,  0, 0, 1]
    R: [[0, -1, 0], [0, 0, -1], [1, 0, 0]]     # x_camera = R · x_scanner + t
    t: [0.06, -0.08, -0.27]
    distortion: []                             # OpenCV: k1 k2 p1 p2 [k3 [k4 k5 k6 …]]
    lens: radial-tangential                    # or fisheye: OpenCV's k1 k2 k3 k4
    size: [1242, 375]                          # optional: width and height

K has 9 numbers, 12 or 16 of a matrix [K 0] (ScanNet), or fx fy cx cy, which may also have these
names. Bare numbers are K alone, or fx fy cx cy width height. Record3D's metadata.json and Open3D's
intrinsic.json, as its recorder of RealSense cameras writes it, have K by columns. YAML is
OpenCV's FileStorage, ROS camera_info, or Kalibr's camchain; a matrix T_camera_lidar there is the
pose of the scanner. A folder is KITTI's raw data or KITTI-360.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Camera, Extrinsics
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.file_bytes import check_pixel_count, one_line, parse_yaml, read_json, read_text
from pnpdepth_cli.io.poses import check_pose, numbers_in, pose_of_matrix

_360_FILES = ("perspective.txt", "calib_cam_to_velo.txt")
_RAW_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")
_PLAIN = ("K", "R", "t", "distortion", "lens", "size")
_SINGLE = ("fx", "fy", "cx", "cy")
_OF_OPEN3D = ("intrinsic_matrix", "width", "height")
_YAML_MARKS = ("camera_matrix:", "distortion_model:", "camera_model:", "distortion_coeffs:")
_MATRICES = ("camera_matrix", "cameraMatrix", "intrinsics", "k", "K")
_OF_LENS = ("distortion_coefficients", "distCoeffs", "distortion_coeffs", "distortion", "D", "d")
_LENSES = dict.fromkeys(
    ("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "none", "pinhole"),
    "radial-tangential",
) | dict.fromkeys(("equidistant", "fisheye", "kannala_brandt", "equi"), "fisheye")
"""Distortion models by their names in ROS and Kalibr."""

_COEFFICIENTS = {"radial-tangential": (0, 4, 5, 8, 12, 14), "fisheye": (0, 4)}
_FALSE = ("0", "false", "False")
_FIELD = re.compile(r"^[ \t]*([A-Za-z_]\w*)(?:[ \t]*[:=]|[ \t]+(?=[-+.\d]))", re.MULTILINE)
"""A name at the beginning of a line; KITTI's tracking set has names without a colon."""
_COMMENT = re.compile(r"#.*|^---[ \t]*$", re.MULTILINE)

_KITTI_SIZES = {
    (721.5377, 609.5593, 172.854): (375, 1242),
    (707.0493, 604.0814, 180.5066): (370, 1224),
    (718.3351, 600.3891, 181.5122): (374, 1238),
    (707.0912, 601.8873, 183.1104): (370, 1226),
    (718.856, 607.1928, 185.2157): (376, 1241),
}
"""(H, W) of KITTI's rectified images by fx, cx, cy, which its object, odometry and tracking files
do not state (its raw data of five days, S_rect and P_rect)."""
_KITTI_TOLERANCE = 2e-3  # pixels, of numbers that were rounded

_LARGEST = 1e9  # largest number of a calibration, in pixels or metres; beyond it, products overflow

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

    @property
    def known_scanner(self) -> Extrinsics:
        """The pose of the scanner. Raises UsageError if it is not known."""
        if self.scanner is None:
            raise UsageError(
                f"{self.camera.source} has no pose of the scanner; add it (R and t, Tr,"
                " T_camera_lidar), or give --extrinsics FILE"
            )
        return self.scanner


class _Fields:
    """The named values of a calibration file."""

    def __init__(self, path: Path, values: Mapping[str, object]) -> None:
        self.path, self.values = path, values

    def text(self, name: str, default: str) -> str:
        """Returns a value as a word; an empty one is the default."""
        return str(self.values.get(name) or default).strip(" \n\"'") or default

    def numbers(self, *names: str, count: int | None = None, optional: bool = False) -> list[float]:
        """Returns the finite numbers of the first of the names that is there."""
        name = next((name for name in names if name in self.values), names[-1])
        if name not in self.values:
            if optional:
                return []
            raise InputError(f"{self.path} has no {name}; it is incomplete or of another kind")
        numbers = numbers_in(self.values[name])
        if numbers is None or not (np.abs(numbers) <= _LARGEST).all():
            raise InputError(f"{self.path}: {name} is not made of a camera's numbers; correct it")
        if count is not None and len(numbers) != count:
            raise InputError(
                f"{self.path}: {name} has {len(numbers)} numbers, not {count}; correct it"
            )
        return numbers

    def matrix(self, *names: str, columns: int = 3) -> Floats:
        """Returns the numbers of the first of the names that is there, as three rows."""
        return np.reshape(self.numbers(*names, count=3 * columns), (3, columns))

    def pose(self, shift: str) -> Extrinsics:
        """Returns the pose of the rotation R and a translation of this name."""
        translation = np.array(self.numbers(shift, count=3))
        return check_pose(self.path, "R", self.matrix("R"), translation)


def read_calibration(path: Path, camera: int | None = None) -> Calibration:
    """Returns the calibration in a file, or in a folder of KITTI's raw data.

    Args:
        path: File or folder.
        camera: 0 to 3 of KITTI's, None for 2, the left colour camera; or the number of a camera of
            Kalibr's, None for cam0.

    Raises:
        InputError: The file cannot be read, or a matrix is missing or not made of numbers that a
            camera can have.
        UsageError: There is no such camera.
    """
    # Files that name their kind, by their own names or by words in them.
    if path.is_dir() or path.name in (_360_FILES[0], *_RAW_FILES):
        return _kitti_folder(path if path.is_dir() else path.parent, camera)
    is_json = path.suffix.lower() == ".json"  # of any length: Record3D's has all poses
    text = "" if is_json else read_text(path)
    if text.lstrip().startswith("%YAML") or any(mark in text for mark in _YAML_MARKS):
        return camera_in_yaml(path, parse_yaml(path, text), camera)
    # JSON, named values, or numbers alone.
    source = "calibration"
    if is_json or text.lstrip().startswith("{"):
        fields = _Fields(path, read_json(path))
        if {"K", "w", "h", "poses"} <= set(fields.values):  # Record3D's, with K by columns
            source = "Record3D's metadata"
            size = [fields.values["w"], fields.values["h"]]
            fields = _Fields(path, {"K": fields.matrix("K").T, "size": size})
        elif set(_OF_OPEN3D) <= set(fields.values):  # with K by columns, and much of the sensor
            source = "Open3D's camera"
            size = [fields.values["width"], fields.values["height"]]
            by_columns = fields.matrix("intrinsic_matrix")
            fields = _Fields(path, {"K": by_columns.T, "size": size})
    elif _FIELD.search(plain := _COMMENT.sub("", text)):
        fields = _named_values(path, text)
    else:
        numbers = numbers_in(plain) or []
        sized = {"K": numbers[:4], "size": numbers[4:]}
        fields = _Fields(path, sized if len(numbers) == 6 else {"K": plain})
    if set(_SINGLE) <= set(fields.values):
        others = {name: value for name, value in fields.values.items() if name not in _SINGLE}
        k = [fields.numbers(name, count=1)[0] for name in _SINGLE]
        fields = _Fields(path, {"K": k, **others})
    if any(re.fullmatch(r"P\d", str(name)) for name in fields.values):
        numbers = fields.numbers("Tr", "Tr_velo_cam", "Tr_velo_to_cam")
        return _kitti(fields, camera, "KITTI", pose_of_matrix(path, "Tr", numbers))
    if unknown := sorted(set(fields.values) - {*_PLAIN, "width", "height"}):
        raise InputError(
            f"{path}: the name {unknown[0]!r} is none of {', '.join(_PLAIN)}; correct it, or take"
            " it out"
        )
    return _single(fields, camera, source)


def read_inertial_pose(path: Path) -> Extrinsics:
    """Returns the pose of KITTI's inertial system in the scanner's coordinates.

    Raises:
        InputError: The file is no calib_imu_to_velo.txt.
    """
    return _named_values(path, read_text(path)).pose("T")


def camera_in_yaml(path: Path, content: object, camera: int | None) -> Calibration:
    """Returns a camera of the content of a YAML file of OpenCV, ROS or Kalibr.

    `camera` is the number of a camera of a camchain, None for cam0.
    """
    if not isinstance(content, Mapping):
        raise InputError(f"{path} is not a calibration; give OpenCV's, ROS's or Kalibr's YAML")
    chain = {str(k): v for k, v in content.items() if isinstance(v, Mapping) and "intrinsics" in v}
    if chain:
        name = f"cam{0 if camera is None else camera}"
        if name not in chain:
            raise UsageError(f"{path} has no {name}; --camera can be one of: {', '.join(chain)}")
        fields = _Fields(path, chain[name])
        if (model := fields.text("camera_model", "pinhole")) != "pinhole":
            raise InputError(
                f"{path}: {name} is of model {one_line(model)[:20]}; calibrate it as a pinhole"
                " camera"
            )
        return _single(fields, None, f"Kalibr camchain, {name}")
    kind = "ROS camera_info" if "distortion_model" in content else "OpenCV calibration"
    plain = {name: content[name] for name in content if name != "R"}  # the rectification
    calibration = _single(_Fields(path, plain), camera, kind)
    rectified = _rectified_cameras(_Fields(path, content), calibration.camera)
    return replace(calibration, rectified=rectified)


def _rectified_cameras(fields: _Fields, raw: Camera) -> dict[str, tuple[Camera, Extrinsics]]:
    """The cameras of a rectified image of camera_info, without distortion; none without P.

    Whether transforms lead to the rectified camera (kitti2bag) or to the raw one, which R and the
    last column of P turn and shift into it, no file says.
    """
    p = np.array(fields.numbers("projection_matrix", "P", "p", optional=True))
    r = np.array(fields.numbers("rectification_matrix", "R", "r", optional=True))
    if p.size != 12 or min(p[0], p[5], np.linalg.det(p.reshape(3, 4)[:, :3])) <= 0:
        return {}
    intrinsics, column = p.reshape(3, 4)[:, :3], p.reshape(3, 4)[:, 3]
    offset = np.linalg.solve(intrinsics, column)
    turn = r.reshape(3, 3) if r.size == 9 and r.any() else np.eye(3)
    is_turned = not np.allclose(turn, np.eye(3), atol=1e-9)
    is_shifted = np.abs(offset).max() > 1e-9
    # The poses of the raw camera that may be meant, by what says them.
    poses: dict[str, Extrinsics] = {}
    if is_shifted and is_turned:
        poses["P with its offset, and R"] = Extrinsics(turn, offset)
    elif is_shifted:
        poses["P with its offset"] = Extrinsics(turn, offset)
    if is_turned:
        poses["P and R"] = Extrinsics(turn, np.zeros(3))
    if not poses and np.allclose(intrinsics, raw.intrinsics, atol=1e-3) and not raw.distortion:
        return {}
    plain = Camera(intrinsics=intrinsics, size=raw.size, source=raw.source)
    return {name: (plain, pose) for name, pose in {**poses, "P": SAME_PLACE}.items()}


def _kitti(fields: _Fields, camera: int | None, kind: str, lidar: Extrinsics | None) -> Calibration:
    """The calibration P · R_rect · [R t]; the last column of P gives the camera's own offset."""
    # The number of the camera; the benchmarks have images of the left colour camera.
    number = 2 if camera is None else camera
    path = fields.path
    matches = (re.fullmatch(r"P(?:_rect_0)?(\d)", name) for name in fields.values)
    present = sorted(int(match[1]) for match in matches if match)
    if number not in present:
        listing = ", ".join(map(str, present)) or "none"
        raise UsageError(f"{path} has no camera {number}; --camera can be one of: {listing}")
    # Its intrinsics, and the rotation and offset that rectify it. Odometry's pose is already
    # rectified; of raw data and KITTI-360, camera 0's rectification is that of all.
    projection = fields.matrix(f"P{number}", f"P_rect_0{number}", columns=4)
    turn = np.eye(3)
    if "Tr" not in fields.values:
        turn = fields.matrix("R_rect", "R_rect_00", "R0_rect")
    intrinsics = _check_intrinsics(path, projection[:, :3])
    offset = np.asarray(np.linalg.solve(intrinsics, projection[:, 3]), np.float64)
    pose = check_pose(path, "rectification", turn, offset)
    size = _height_width(path, fields.numbers(f"S_rect_0{number}", count=2, optional=True))
    size = size or _kitti_size(intrinsics)
    source = f"{kind} calibration, camera {number}"
    return Calibration(
        camera=Camera(intrinsics=intrinsics, size=size, source=source),
        scanner=None if lidar is None else pose @ lidar,
        rectification=pose,
    )


def _kitti_folder(folder: Path, camera: int | None) -> Calibration:
    """KITTI's raw data or KITTI-360; without the file of the scanner, the camera alone."""
    is_360 = (folder / _360_FILES[0]).is_file()
    cameras, scanner = (folder / name for name in (_360_FILES if is_360 else _RAW_FILES))
    if not cameras.is_file():
        raise InputError(f"{folder} has no {cameras.name}; give KITTI's raw folder, or one file")
    # The pose of the scanner; KITTI-360's file maps camera 0 to the scanner.
    pose = None
    if scanner.is_file() and is_360:
        pose = pose_of_matrix(scanner, "the matrix", numbers_in(read_text(scanner)) or []).inverse()
    elif scanner.is_file():
        pose = _named_values(scanner, read_text(scanner)).pose("T")
    fields = _named_values(cameras, read_text(cameras))
    number, kind = (camera or 0, "KITTI-360") if is_360 else (camera, "KITTI raw")
    return _kitti(fields, number, kind, pose)


def _single(fields: _Fields, camera: int | None, source: str) -> Calibration:
    """The camera of a plain file, or of one of OpenCV, ROS or Kalibr."""
    path = fields.path
    if camera is not None:
        raise UsageError(f"{path} describes one camera; leave out --camera {camera}")
    # The intrinsics: fx fy cx cy, 3×3, 3×4, or 4×4 as ScanNet has them.
    numbers = fields.numbers(*_MATRICES)
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    if len(numbers) not in (9, 12, 16):
        raise InputError(
            f"{path}: K has {len(numbers)} numbers; give 4 (fx fy cx cy), or 9, 12 or 16 of a"
            " matrix"
        )
    rows = np.reshape(numbers, (-1, 3 if len(numbers) == 9 else 4))
    if rows[:3, 3:].any():
        raise InputError(
            f"{path}: the last column of K is not 0, so it is the projection of a moved camera;"
            " give its 3×3 intrinsics alone"
        )
    matrix = rows[:3, :3]
    matrix = _check_intrinsics(path, matrix)
    lens, distortion = _lens(fields)
    if distortion:
        source += f", {lens} lens"
    # The pose of the scanner, as a matrix or as R and t.
    scanner = None
    if pose := fields.numbers("T_camera_lidar", "T_cam_lidar", optional=True):
        scanner = pose_of_matrix(path, "T_cam_lidar", pose)
    elif "R" in fields.values or "t" in fields.values:
        scanner = fields.pose("t")
    # The size of the image.
    sides = fields.numbers("size", "resolution", count=2, optional=True)
    for side in () if sides else ("width", "height"):
        sides += fields.numbers(f"image_{side}", side, count=1, optional=True)
    size = _height_width(path, sides) or _kitti_size(matrix)
    seen = Camera(intrinsics=matrix, lens=lens, distortion=distortion, size=size, source=source)
    return Calibration(camera=seen, scanner=scanner)


def _kitti_size(intrinsics: Floats) -> tuple[int, int] | None:
    """(H, W) of the images of KITTI's that have these intrinsics; None for all others."""
    own = intrinsics[[0, 0, 1], [0, 2, 2]]
    for numbers, size in _KITTI_SIZES.items():
        if np.abs(own - numbers).max() < _KITTI_TOLERANCE:
            return size
    return None


def _lens(fields: _Fields) -> tuple[str, tuple[float, ...]]:
    """A name of `choices.LENSES` and the coefficients; "none" leaves them out."""
    model = fields.text("lens", fields.text("distortion_model", "none"))
    if "distortion_model" not in fields.values and fields.text("fisheye_model", "0") not in _FALSE:
        model = "fisheye"  # of OpenCV
    lens = _LENSES.get(model)
    if lens is None:
        raise InputError(
            f"{fields.path}: distortion model {one_line(model)[:30]!r} is none of"
            f" {', '.join(_LENSES)}; calibrate the camera with one of these"
        )
    coefficients = tuple(fields.numbers(*_OF_LENS, optional=True))
    if lens == "radial-tangential" and not any(coefficients):
        coefficients = ()
    if len(coefficients) not in _COEFFICIENTS[lens]:
        raise InputError(
            f"{fields.path}: {len(coefficients)} coefficients of {lens} distortion, which has"
            f" {_COEFFICIENTS[lens]}; correct them, or their model"
        )
    return lens, coefficients


def _named_values(path: Path, text: str) -> _Fields:
    """`name: value`; a line without a name continues the value before it."""
    before, *parts = _FIELD.split(_COMMENT.sub("", text))
    names, values = parts[::2], parts[1::2]
    if before.strip():
        raise InputError(
            f"{path}: {one_line(before)[:60]!r} has no name before it; write it as `name: value`"
        )
    if len(set(names)) < len(names):
        raise InputError(f"{path} has a name twice ({one_line(', '.join(names))}); keep one")
    return _Fields(path, dict(zip(names, values, strict=True)))


def _check_intrinsics(path: Path, matrix: Floats) -> Floats:
    """The matrix (3, 3). InputError if it is not that of a pinhole camera."""
    has_last_row = np.array_equal(matrix[2], [0, 0, 1])
    if not (has_last_row and matrix[0, 0] > 0 and matrix[1, 1] > 0 and matrix[1, 0] == 0):
        raise InputError(f"{path}: the intrinsics are not fx s cx, 0 fy cy, 0 0 1; correct them")
    return matrix


def _height_width(path: Path, size: list[float]) -> tuple[int, int] | None:
    """(H, W) of width and height; None without both."""
    if len(size) < 2:
        return None
    width, height = (round(value) for value in size)
    check_pixel_count(path, width, height)
    return height, width
