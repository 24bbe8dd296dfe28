"""Calibrations in YAML: OpenCV's FileStorage, ROS camera_info, and Kalibr's camchain.

A pose of the scanner is read from a 4×4 matrix T_camera_lidar (or T_cam_lidar, T_camera_scanner):
x_camera = T · x_scanner. Distortion is radial-tangential or fisheye (equidistant). The intrinsics
are those of the raw image, not of a rectified one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.extrinsics import pose_of_matrix
from pnpdepth_cli.io.file_bytes import one_line

Floats = NDArray[np.float64]

_MATRICES = ("camera_matrix", "cameraMatrix", "CameraMat", "camera_mat", "K", "k")
_DISTORTIONS = (
    *("distortion_coefficients", "distCoeffs", "dist_coeffs", "DistCoeff", "distortion_coeffs"),
    *("D", "d"),
)
_POSES = ("T_camera_lidar", "T_cam_lidar", "T_camera_scanner", "T_cam_velo")
_LENSES = {
    **dict.fromkeys(
        ("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "none", "", "pinhole"),
        "radial-tangential",
    ),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt", "equi"), "fisheye"),
    "fov": "fov",
}
"""Distortion models by their names in ROS and Kalibr."""

_COUNTS = {"radial-tangential": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "fov": (1,), "eucm": (2,)}
_LARGEST = 1e9


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A camera and a scanner: x_camera = rotation · x_scanner + translation."""

    intrinsics: Floats
    """(3, 3), last row 0 0 1, in pixels."""

    rotation: Floats
    """(3, 3), from the scanner's frame to the camera's."""

    translation: Floats
    """(3,) metres, the scanner's origin in the camera's frame."""

    distortion: tuple[float, ...]
    """Coefficients of the lens, or none."""

    size: tuple[int, int] | None
    """(H, W) of the images; None if the file does not give it."""

    has_pose: bool
    """False if the file has no pose of a scanner; rotation and translation are then identity."""

    source: str
    """What was read, for a person."""

    lens: str = "radial-tangential"
    """One of `choices.LENSES`."""


def is_robot_calibration(text: str) -> bool:
    """Returns whether a text looks like one of these formats."""
    if text.lstrip().startswith("%YAML") or "!!opencv-matrix" in text:
        return True
    marks = ("camera_matrix:", "distortion_model:", "camera_model:", "distortion_coeffs:")
    return any(mark in text for mark in marks)


def camera_in_yaml(path: Path, content: Any, camera: int | None) -> Calibration:
    """Returns a camera of the file.

    Args:
        path: Named in messages.
        content: Of the file.
        camera: Number of a camera of a camchain; None for cam0.

    Raises:
        FileFormatError: The camera is incomplete, or of a model that is not known here.
        UsageError: There is no such camera.
    """
    if not isinstance(content, Mapping):
        raise FileFormatError(f"{path} is not a calibration; give OpenCV's, ROS's or Kalibr's YAML")
    chain = {str(k): v for k, v in content.items() if str(k).startswith("cam") and _is_cam(v)}
    if chain:
        name = f"cam{0 if camera is None else camera}"
        if name not in chain:
            raise UsageError(f"{path} has no {name}; --camera can be one of: {', '.join(chain)}")
        return _kalibr(path, name, chain[name])
    if camera is not None:
        raise UsageError(f"{path} describes one camera; leave out --camera {camera}")
    return _opencv_or_ros(path, content)


def _is_cam(value: Any) -> bool:
    return isinstance(value, Mapping) and "intrinsics" in value


def _kalibr(path: Path, name: str, fields: Mapping[str, Any]) -> Calibration:
    model = str(fields.get("camera_model", "pinhole"))
    values = _numbers(path, f"{name}: intrinsics", fields["intrinsics"])
    coefficients = _numbers(path, f"{name}: distortion_coeffs", fields.get("distortion_coeffs", []))
    lens = _lens(path, str(fields.get("distortion_model", "none")))
    if model == "eucm" and len(values) == 6:
        lens, coefficients, values = "eucm", values[:2], values[2:]
    elif model != "pinhole" or len(values) != 4:
        raise FileFormatError(
            f"{path}: {name} is a {one_line(model)[:20]} camera with {len(values)} intrinsics; only"
            " pinhole (4) and eucm (6) are known, so calibrate it as one of them"
        )
    fx, fy, cx, cy = values
    size = _numbers(path, f"{name}: resolution", fields.get("resolution", []))
    return _checked(
        path,
        matrix=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        lens=lens,
        distortion=coefficients,
        size=(int(size[1]), int(size[0])) if len(size) == 2 else None,
        pose=_pose(path, fields),
        source=f"Kalibr camchain, {name}",
    )


def _opencv_or_ros(path: Path, fields: Mapping[str, Any]) -> Calibration:
    matrix = next((fields[name] for name in _MATRICES if name in fields), None)
    if matrix is None:
        raise FileFormatError(f"{path} has no {_MATRICES[0]}; this calibration is incomplete")
    values = _numbers(path, _MATRICES[0], matrix)
    if len(values) != 9:
        raise FileFormatError(f"{path}: {_MATRICES[0]} has {len(values)} numbers instead of 9")
    coefficients: Any = next((fields[name] for name in _DISTORTIONS if name in fields), [])
    model = fields.get("distortion_model")
    width, height = (fields.get(f"image_{n}", fields.get(n)) for n in ("width", "height"))
    fisheye = bool(fields.get("fisheye_model")) if model is None else False
    size = None
    if width is not None and height is not None:
        size = (int(_numbers(path, "height", height)[0]), int(_numbers(path, "width", width)[0]))
    return _checked(
        path,
        matrix=np.reshape(values, (3, 3)),
        lens="fisheye" if fisheye else _lens(path, str(model or "none")),
        distortion=_numbers(path, "distortion", coefficients),
        size=size,
        pose=_pose(path, fields),
        source="ROS camera_info" if model is not None else "OpenCV calibration",
    )


def _checked(
    path: Path,
    *,
    matrix: Floats,
    lens: str,
    distortion: Sequence[float],
    size: tuple[int, int] | None,
    pose: tuple[Floats, Floats] | None,
    source: str,
) -> Calibration:
    coefficients = tuple(distortion)
    if lens == "radial-tangential" and not any(coefficients):
        coefficients = ()
    if len(coefficients) not in _COUNTS[lens]:
        wanted = " or ".join(str(count) for count in _COUNTS[lens])
        raise FileFormatError(
            f"{path}: {len(coefficients)} coefficients of {lens} distortion instead of {wanted}"
        )
    if size is not None and min(size) < 1:
        raise FileFormatError(f"{path}: images of {size[1]}×{size[0]} pixels are none; correct it")
    rotation, translation = pose or (np.eye(3), np.zeros(3))
    return Calibration(
        intrinsics=matrix,
        rotation=rotation,
        translation=translation,
        distortion=coefficients,
        size=size,
        has_pose=pose is not None,
        source=f"{source}, {lens} lens" if coefficients else source,
        lens=lens,
    )


def _pose(path: Path, fields: Mapping[str, Any]) -> tuple[Floats, Floats] | None:
    name = next((name for name in _POSES if name in fields), None)
    return None if name is None else pose_of_matrix(path, name, _numbers(path, name, fields[name]))


def _lens(path: Path, model: str) -> str:
    if model not in _LENSES:
        known = ", ".join(name for name in _LENSES if name)
        raise FileFormatError(
            f"{path}: distortion model {one_line(model)[:30]!r} is not known; known are {known}"
        )
    return _LENSES[model]


def _numbers(path: Path, name: str, value: Any) -> list[float]:
    """The numbers of a list, of nested lists, or of the `data` of a matrix."""
    if isinstance(value, Mapping):
        value = value.get("data", [])
    flat: list[Any] = []
    for each in value if isinstance(value, list) else [value]:
        flat += each if isinstance(each, list) else [each]
    try:
        numbers = [float(each) for each in flat]
    except (TypeError, ValueError, OverflowError):
        numbers = [np.nan]
    if not (np.abs(np.array(numbers)) < _LARGEST).all():
        raise FileFormatError(f"{path}: {name} is not made of numbers below 1e9; correct it")
    return numbers
