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
"""Names of the files of the cameras and of the scanner in KITTI-360."""
_RAW_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")
"""Names of the files of the cameras and of the scanner in KITTI's raw data."""
_PLAIN = ("K", "R", "t", "distortion", "lens", "size")
"""Names of the values of a plain file."""
_SINGLE = ("fx", "fy", "cx", "cy")
"""Names of the intrinsics of a plain file that has no K."""
_OF_RECORD3D = ("K", "w", "h", "poses")
_OF_OPEN3D = ("intrinsic_matrix", "width", "height")
"""Names of values by which the files of these programs are known."""
_YAML_MARKS = ("camera_matrix:", "distortion_model:", "camera_model:", "distortion_coeffs:")
"""Names in OpenCV's, ROS's and Kalibr's YAML, by which such a file is known."""
_MATRICES = ("camera_matrix", "cameraMatrix", "intrinsics", "k", "K")
"""Names of the intrinsics, of all programs."""
_OF_LENS = ("distortion_coefficients", "distCoeffs", "distortion_coeffs", "distortion", "D", "d")
"""Names of the coefficients of distortion, of all programs."""
_LENSES = dict.fromkeys(
    ("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "none", "pinhole"),
    "radial-tangential",
) | dict.fromkeys(("equidistant", "fisheye", "kannala_brandt", "equi"), "fisheye")
"""Distortion models by their names in ROS and Kalibr."""

_COEFFICIENTS = {"radial-tangential": (0, 4, 5, 8, 12, 14), "fisheye": (0, 4)}
"""How many coefficients a lens may have in OpenCV."""
_FALSE = ("0", "false", "False")
_SAME_TURN = 1e-9  # of the entries of two rotations that are one
_SAME_SHIFT_M = 1e-9
_SAME_INTRINSICS_PX = 1e-3
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
    """The named values of a calibration file, each a text or what JSON and YAML have."""

    def __init__(self, path: Path, values: Mapping[str, object]) -> None:
        self.path = path
        self.values = values

    def text(self, name: str, default: str) -> str:
        """Returns a value as a word without quotes; the default if it is missing, empty or 0."""
        value = self.values.get(name) or default
        return str(value).strip(" \n\"'") or default

    def numbers(self, *names: str, count: int | None = None, optional: bool = False) -> list[float]:
        """Returns the numbers of a value, a matrix row by row.

        Args:
            names: Names that the value may have, of which the first that is there counts.
            count: How many numbers it must have. None: any number.
            optional: Whether the value may be missing, which gives an empty list.

        Raises:
            InputError: The value is missing, or is not made of so many finite numbers that a camera
                can have.
        """
        name = next((name for name in names if name in self.values), names[-1])
        if name not in self.values:
            if optional:
                return []
            raise InputError(f"{self.path} has no {name}; it is incomplete or of another kind")
        numbers = numbers_in(self.values[name])
        if numbers is None or not (np.abs(numbers) <= _LARGEST).all():  # NaN is refused, too
            raise InputError(f"{self.path}: {name} is not made of a camera's numbers; correct it")
        if count is not None and len(numbers) != count:
            raise InputError(
                f"{self.path}: {name} has {len(numbers)} numbers, not {count}; correct it"
            )
        return numbers

    def matrix(self, *names: str, columns: int = 3) -> Floats:
        """Returns a matrix of three rows, as `numbers` takes the names and raises errors."""
        return np.reshape(self.numbers(*names, count=3 * columns), (3, columns))

    def pose(self, shift: str) -> Extrinsics:
        """Returns the pose of the rotation R and a translation.

        Args:
            shift: Name of the translation.

        Raises:
            InputError: One of them is missing or not made of numbers, or R is no rotation.
        """
        translation = np.array(self.numbers(shift, count=3))
        return check_pose(self.path, "R", self.matrix("R"), translation)


def read_calibration(path: Path, camera: int | None = None) -> Calibration:
    """Returns the calibration in a file, or in a folder of KITTI's raw data or KITTI-360.

    Args:
        path: File or folder.
        camera: Number of a camera: 0 to 3 of KITTI's, None for 2, the left colour camera, or for 0
            of KITTI-360; or of Kalibr's, None for cam0. None for a file of one camera.

    Raises:
        InputError: The file cannot be read, or a matrix is missing or not made of numbers that a
            camera can have.
        UsageError: There is no such camera.
    """
    # A folder, or a file of one, and YAML, which are known by their names or by words in them.
    if path.is_dir() or path.name in (_360_FILES[0], *_RAW_FILES):
        return _kitti_folder(path if path.is_dir() else path.parent, camera)
    is_json = path.suffix.lower() == ".json"  # of any length: Record3D's has all poses
    text = "" if is_json else read_text(path)
    if text.lstrip().startswith("%YAML") or any(mark in text for mark in _YAML_MARKS):
        return camera_in_yaml(path, parse_yaml(path, text), camera)
    # JSON, named values, or numbers alone.
    source = "calibration"
    without_comments = _COMMENT.sub("", text)
    if is_json or text.lstrip().startswith("{"):
        fields, source = _values_of_json(path)
    elif _FIELD.search(without_comments):
        fields = _named_values(path, text)
    else:
        fields = _bare_numbers(path, without_comments)
    if set(_SINGLE) <= set(fields.values):
        intrinsics = [fields.numbers(name, count=1)[0] for name in _SINGLE]
        others = {name: value for name, value in fields.values.items() if name not in _SINGLE}
        fields = _Fields(path, {"K": intrinsics, **others})
    # KITTI's object, odometry and tracking files have a projection P0, P1, … for each camera.
    if any(re.fullmatch(r"P\d", str(name)) for name in fields.values):
        numbers = fields.numbers("Tr", "Tr_velo_cam", "Tr_velo_to_cam")
        return _kitti(fields, camera, "KITTI", pose_of_matrix(path, "Tr", numbers))
    # All others are plain; a misspelt name would be overlooked.
    unknown_names = sorted(set(fields.values) - {*_PLAIN, "width", "height"})
    if unknown_names:
        raise InputError(
            f"{path}: the name {unknown_names[0]!r} is none of {', '.join(_PLAIN)}; correct it, or"
            " take it out"
        )
    return _single_camera(fields, camera, source)


def _values_of_json(path: Path) -> tuple[_Fields, str]:
    """The values of a JSON file, and a name of the file's kind for a person.

    Files of Record3D and Open3D are known by the names in them. Only K and size of these are taken,
    as they hold more than a camera. Any other file has all its values as they are.

    Raises:
        InputError: The file is no JSON, or K is not made of 9 numbers that a camera can have.
    """
    fields = _Fields(path, read_json(path))
    if set(_OF_RECORD3D) <= set(fields.values):
        by_columns = fields.matrix("K")  # so its transpose is K by rows
        size = [fields.values["w"], fields.values["h"]]
        return _Fields(path, {"K": by_columns.T, "size": size}), "Record3D's metadata"
    if set(_OF_OPEN3D) <= set(fields.values):
        by_columns = fields.matrix("intrinsic_matrix")  # so its transpose is K by rows
        size = [fields.values["width"], fields.values["height"]]
        return _Fields(path, {"K": by_columns.T, "size": size}), "Open3D's camera"
    return fields, "calibration"


def _bare_numbers(path: Path, text: str) -> _Fields:
    """The values of a text of numbers alone: K; or K and the size, of fx fy cx cy width height."""
    numbers = numbers_in(text) or []
    if len(numbers) == 6:
        return _Fields(path, {"K": numbers[:4], "size": numbers[4:]})
    return _Fields(path, {"K": text})


def read_inertial_pose(path: Path) -> Extrinsics:
    """Returns the pose of KITTI's inertial system in the scanner's coordinates.

    Args:
        path: calib_imu_to_velo.txt of KITTI's raw data.

    Raises:
        InputError: The file is no calib_imu_to_velo.txt.
    """
    return _named_values(path, read_text(path)).pose("T")


def camera_in_yaml(path: Path, content: object, camera: int | None) -> Calibration:
    """Returns the calibration that a YAML file of OpenCV, ROS or Kalibr holds.

    Args:
        path: The file, for messages.
        content: Content of the file, as `parse_yaml` returns it, or the values of a camera_info.
        camera: Number of a camera of Kalibr's camchain, None for cam0. None for OpenCV and ROS.

    Raises:
        InputError: The content is no such calibration, or a value is missing or no camera's.
        UsageError: There is no such camera.
    """
    if not isinstance(content, Mapping):
        raise InputError(f"{path} is not a calibration; give OpenCV's, ROS's or Kalibr's YAML")
    # Kalibr's camchain has the values of each camera under its name.
    chain = {
        str(name): values
        for name, values in content.items()
        if isinstance(values, Mapping) and "intrinsics" in values
    }
    if chain:
        name = f"cam{0 if camera is None else camera}"
        if name not in chain:
            raise UsageError(f"{path} has no {name}; --camera can be one of: {', '.join(chain)}")
        fields = _Fields(path, chain[name])
        model = fields.text("camera_model", "pinhole")
        if model != "pinhole":
            raise InputError(
                f"{path}: {name} is of model {one_line(model)[:20]}; calibrate it as a pinhole"
                " camera"
            )
        return _single_camera(fields, None, f"Kalibr camchain, {name}")
    # OpenCV and ROS have one camera, whose R is a rectification and no pose of a scanner.
    kind = "ROS camera_info" if "distortion_model" in content else "OpenCV calibration"
    without_r = {name: value for name, value in content.items() if name != "R"}
    calibration = _single_camera(_Fields(path, without_r), camera, kind)
    rectified = _rectified_cameras(_Fields(path, content), calibration.camera)
    return replace(calibration, rectified=rectified)


def _rectified_cameras(fields: _Fields, raw: Camera) -> dict[str, tuple[Camera, Extrinsics]]:
    """The cameras that rectified images may have, where a ROS camera_info states the raw camera.

    ROS rectifies an image by R and P, and removes its distortion. No file says whether the poses of
    other sensors are in the coordinates of the rectified camera, as kitti2bag has it, or of the raw
    one, which R turns and the last column of P shifts into the rectified one. So there are several.

    Args:
        fields: Values of camera_info.
        raw: Camera of the images before rectification.

    Returns:
        The rectified camera and the pose of the raw camera in its coordinates, by the names of the
        values that give this pose. Empty without P, or if rectification changes nothing.
    """
    # P is [K' | K' · offset] of the rectified camera, R its rotation.
    p_numbers = np.array(fields.numbers("projection_matrix", "P", "p", optional=True))
    r_numbers = np.array(fields.numbers("rectification_matrix", "R", "r", optional=True))
    if p_numbers.size != 12:
        return {}
    projection = p_numbers.reshape(3, 4)
    intrinsics = projection[:, :3]
    if min(intrinsics[0, 0], intrinsics[1, 1], np.linalg.det(intrinsics)) <= 0:
        return {}  # an uncalibrated camera has zeros
    offset = np.linalg.solve(intrinsics, projection[:, 3])
    has_rotation = r_numbers.size == 9 and r_numbers.any()
    turn = r_numbers.reshape(3, 3) if has_rotation else np.eye(3)
    is_turned = not np.allclose(turn, np.eye(3), atol=_SAME_TURN)
    is_shifted = np.abs(offset).max() > _SAME_SHIFT_M
    # The poses of the raw camera that may be meant, by what gives them.
    poses: dict[str, Extrinsics] = {}
    if is_shifted and is_turned:
        poses["P with its offset, and R"] = Extrinsics(turn, offset)
    elif is_shifted:
        poses["P with its offset"] = Extrinsics(turn, offset)
    if is_turned:
        poses["P and R"] = Extrinsics(turn, np.zeros(3))
    # In any case other sensors may refer to the rectified camera itself, unless it is the raw one.
    has_same_intrinsics = np.allclose(intrinsics, raw.intrinsics, atol=_SAME_INTRINSICS_PX)
    if not poses and has_same_intrinsics and not raw.distortion:
        return {}
    poses["P"] = SAME_PLACE
    rectified = Camera(intrinsics=intrinsics, size=raw.size, source=raw.source)
    return {name: (rectified, pose) for name, pose in poses.items()}


def _kitti(fields: _Fields, camera: int | None, kind: str, lidar: Extrinsics | None) -> Calibration:
    """The calibration of one of KITTI's rectified cameras: pixels = P · R_rect · [R t] · x.

    Args:
        fields: Values of KITTI's file of cameras.
        camera: Number of the camera, None for 2.
        kind: Name of the data set, for a person.
        lidar: Pose of the scanner in the coordinates of camera 0, [R t]; None if it is not known.

    Raises:
        InputError: A value is missing, or no camera's.
        UsageError: There is no such camera.
    """
    # The number of the camera; the benchmarks have images of the left colour camera.
    number = 2 if camera is None else camera
    path = fields.path
    matches = (re.fullmatch(r"P(?:_rect_0)?(\d)", name) for name in fields.values)
    numbers = sorted(int(match[1]) for match in matches if match)
    if number not in numbers:
        listing = ", ".join(map(str, numbers)) or "none"
        raise UsageError(f"{path} has no camera {number}; --camera can be one of: {listing}")
    # Its intrinsics and its offset from camera 0, which are P = [K | K · offset], and the rotation
    # that rectifies camera 0. The pose in odometry's file, Tr, is already rectified.
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
    """The calibration in a folder of KITTI's raw data or KITTI-360.

    It has no pose of the scanner if the folder lacks the file of the scanner.

    Args:
        folder: The folder.
        camera: Number of the camera; None for 2 of raw data, and for 0 of KITTI-360.

    Raises:
        InputError: The file of the cameras is missing, or a file is damaged.
        UsageError: There is no such camera.
    """
    is_360 = (folder / _360_FILES[0]).is_file()
    camera_file, scanner_file = (folder / name for name in (_360_FILES if is_360 else _RAW_FILES))
    if not camera_file.is_file():
        raise InputError(
            f"{folder} has no {camera_file.name}; give KITTI's raw folder, or one file"
        )
    # The pose of the scanner; KITTI-360's file maps camera 0 to the scanner.
    scanner = None
    if scanner_file.is_file() and is_360:
        numbers = numbers_in(read_text(scanner_file)) or []
        scanner = pose_of_matrix(scanner_file, "the matrix", numbers).inverse()
    elif scanner_file.is_file():
        scanner = _named_values(scanner_file, read_text(scanner_file)).pose("T")
    # The camera.
    fields = _named_values(camera_file, read_text(camera_file))
    if is_360:
        return _kitti(fields, camera or 0, "KITTI-360", scanner)
    return _kitti(fields, camera, "KITTI raw", scanner)


def _single_camera(fields: _Fields, camera: int | None, source: str) -> Calibration:
    """The calibration of one camera, and of the scanner beside it if its pose is among the values.

    Args:
        fields: Values of the camera, by the names of `_PLAIN`, or those of OpenCV, ROS or Kalibr.
        camera: Number that the user gave, of which such a file has none; None if none was given.
        source: Name of the file's kind, for a person.

    Raises:
        InputError: A value is missing, or no camera's.
        UsageError: A number was given.
    """
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
    matrix = np.reshape(numbers, (-1, 3 if len(numbers) == 9 else 4))
    if matrix[:3, 3:].any():
        raise InputError(
            f"{path}: the last column of K is not 0, so it is the projection of a moved camera;"
            " give its 3×3 intrinsics alone"
        )
    intrinsics = _check_intrinsics(path, matrix[:3, :3])
    lens, distortion = _lens(fields)
    if distortion:
        source += f", {lens} lens"
    # The pose of the scanner, as a matrix or as R and t.
    scanner = None
    pose_numbers = fields.numbers("T_camera_lidar", "T_cam_lidar", optional=True)
    if pose_numbers:
        scanner = pose_of_matrix(path, "T_cam_lidar", pose_numbers)
    elif "R" in fields.values or "t" in fields.values:
        scanner = fields.pose("t")
    # The size of the image; KITTI's files do not state it, but their intrinsics are known.
    sides = fields.numbers("size", "resolution", count=2, optional=True)
    if not sides:
        width = fields.numbers("image_width", "width", count=1, optional=True)
        height = fields.numbers("image_height", "height", count=1, optional=True)
        sides = width + height
    size = _height_width(path, sides) or _kitti_size(intrinsics)
    return Calibration(
        camera=Camera(
            intrinsics=intrinsics, lens=lens, distortion=distortion, size=size, source=source
        ),
        scanner=scanner,
    )


def _kitti_size(intrinsics: Floats) -> tuple[int, int] | None:
    """(H, W) of KITTI's images, if the intrinsics (3, 3) are those of a day of KITTI; else None."""
    fx_cx_cy = intrinsics[[0, 0, 1], [0, 2, 2]]
    for fx_cx_cy_of_day, size in _KITTI_SIZES.items():
        if np.abs(fx_cx_cy - fx_cx_cy_of_day).max() < _KITTI_TOLERANCE:
            return size
    return None


def _lens(fields: _Fields) -> tuple[str, tuple[float, ...]]:
    """The lens, a name of `choices.LENSES`, and its coefficients; none without distortion.

    Raises:
        InputError: The distortion is of another model, or has another number of coefficients.
    """
    model = fields.text("lens", fields.text("distortion_model", "none"))
    # OpenCV's file has fisheye_model instead of a model's name.
    if "distortion_model" not in fields.values and fields.text("fisheye_model", "0") not in _FALSE:
        model = "fisheye"
    lens = _LENSES.get(model)
    if lens is None:
        raise InputError(
            f"{fields.path}: distortion model {one_line(model)[:30]!r} is none of"
            f" {', '.join(_LENSES)}; calibrate the camera with one of these"
        )
    coefficients = tuple(fields.numbers(*_OF_LENS, optional=True))
    if lens == "radial-tangential" and not any(coefficients):
        coefficients = ()  # zeros, of any number, are no distortion
    if len(coefficients) not in _COEFFICIENTS[lens]:
        raise InputError(
            f"{fields.path}: {len(coefficients)} coefficients of {lens} distortion, which has"
            f" {_COEFFICIENTS[lens]}; correct them, or their model"
        )
    return lens, coefficients


def _named_values(path: Path, text: str) -> _Fields:
    """The values of a text of lines `name: value`; other lines continue the value before them.

    Raises:
        InputError: The text begins without a name, or has a name twice.
    """
    before, *names_and_values = _FIELD.split(_COMMENT.sub("", text))
    names = names_and_values[::2]
    values = names_and_values[1::2]
    if before.strip():
        raise InputError(
            f"{path}: {one_line(before)[:60]!r} has no name before it; write it as `name: value`"
        )
    if len(set(names)) < len(names):
        raise InputError(f"{path} has a name twice ({one_line(', '.join(names))}); keep one")
    return _Fields(path, dict(zip(names, values, strict=True)))


def _check_intrinsics(path: Path, matrix: Floats) -> Floats:
    """The matrix (3, 3) itself. InputError unless it is that of a pinhole camera."""
    has_last_row = np.array_equal(matrix[2], [0, 0, 1])
    has_focal_lengths = matrix[0, 0] > 0 and matrix[1, 1] > 0
    if not has_last_row or not has_focal_lengths or matrix[1, 0] != 0:
        raise InputError(f"{path}: the intrinsics are not fx s cx, 0 fy cy, 0 0 1; correct them")
    return matrix


def _height_width(path: Path, size: list[float]) -> tuple[int, int] | None:
    """(H, W) of an image whose width and height, in this order, a file states; None without both.

    Raises:
        InputError: The image has no pixels, or more than the budget allows.
    """
    if len(size) < 2:
        return None
    width, height = (round(side) for side in size)
    check_pixel_count(path, width, height)
    return height, width
