"""COLMAP's camera models as intrinsics and a lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.colmap.parts import ColmapCamera
from pnpdepth_cli.io.file_bytes import check_pixel_count, one_line


@dataclass(frozen=True)
class _Model:
    """Number in binary files, count of focal lengths, and the lens with its coefficients."""

    number: int
    focals: int
    lens: str
    coefficients: int

    @property
    def parameters(self) -> int:
        return self.focals + 2 + self.coefficients


_RADIAL, _FISHEYE = "radial-tangential", "fisheye"
MODELS = {
    "SIMPLE_PINHOLE": _Model(0, 1, _RADIAL, 0),
    "PINHOLE": _Model(1, 2, _RADIAL, 0),
    "SIMPLE_RADIAL": _Model(2, 1, _RADIAL, 1),
    "RADIAL": _Model(3, 1, _RADIAL, 2),
    "OPENCV": _Model(4, 2, _RADIAL, 4),
    "OPENCV_FISHEYE": _Model(5, 2, _FISHEYE, 4),
    "FULL_OPENCV": _Model(6, 2, _RADIAL, 8),
    "FOV": _Model(7, 2, "fov", 1),
    "SIMPLE_RADIAL_FISHEYE": _Model(8, 1, _FISHEYE, 1),
    "RADIAL_FISHEYE": _Model(9, 1, _FISHEYE, 2),
    "THIN_PRISM_FISHEYE": _Model(10, 2, "thin-prism-fisheye", 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": _Model(11, 2, "rad-tan-thin-prism-fisheye", 12),
    "SIMPLE_DIVISION": _Model(12, 1, "division", 1),
    "DIVISION": _Model(13, 2, "division", 1),
    "SIMPLE_FISHEYE": _Model(14, 1, _FISHEYE, 0),
    "FISHEYE": _Model(15, 2, _FISHEYE, 0),
    "EUCM": _Model(16, 2, "eucm", 2),
}
"""COLMAP 4.2's camera models except EQUIRECTANGULAR, whose images have no z axis."""

NAME_OF_NUMBER = {model.number: name for name, model in MODELS.items()} | {17: "EQUIRECTANGULAR"}
_LARGEST = 1e9


def parameter_count(path: Path, name: str) -> int:
    """Returns how many parameters a camera model has. Raises FileFormatError if it is unknown."""
    if name == "EQUIRECTANGULAR":
        raise FileFormatError(
            f"{path}: a camera of model EQUIRECTANGULAR has no z axis; render perspective views of"
            " its panoramas"
        )
    if name not in MODELS:
        raise FileFormatError(
            f"{path}: {one_line(name)[:40]!r} is no camera model of COLMAP 4.2; the file is"
            " damaged, or written by a newer COLMAP"
        )
    return MODELS[name].parameters


def camera_of(
    path: Path, name: str, size: tuple[int, int], parameters: Sequence[float]
) -> ColmapCamera:
    """Returns the camera with these parameters, which are as many as its model has.

    Args:
        path: Named in messages.
        name: Of the camera model.
        size: (H, W).
        parameters: In COLMAP's order.

    Raises:
        FileFormatError: No camera has these parameters.
    """
    model = MODELS[name]
    check_pixel_count(path, size[1], size[0])
    fx, fy = parameters[0], parameters[model.focals - 1]
    cx, cy = parameters[model.focals : model.focals + 2]
    values = np.array(parameters)
    if not (np.abs(values) < _LARGEST).all() or min(fx, fy) <= 0:
        raise FileFormatError(
            f"{path}: a {name} camera with parameters {one_line(list(parameters))[:80]} cannot"
            " exist; create the model again"
        )
    distortion = tuple(parameters[model.focals + 2 :])
    if model.lens == _RADIAL and distortion:
        distortion = (*distortion, *[0.0] * (4 - len(distortion)))
    return ColmapCamera(
        model=name,
        size=size,
        intrinsics=np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]),
        lens=model.lens,
        distortion=distortion,
    )
