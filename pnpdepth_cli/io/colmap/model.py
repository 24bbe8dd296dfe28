"""A sparse model of COLMAP, and how its numbers become cameras, poses and points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.extrinsics import rotation_of
from pnpdepth_cli.io.file_bytes import check_pixel_count, one_line

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ColmapCamera:
    """A camera of the model; several images may share it."""

    model: str
    """COLMAP's name, such as "SIMPLE_RADIAL"."""
    size: tuple[int, int]
    """(H, W) of its images."""
    intrinsics: Floats
    """(3, 3) in pixels, with whole numbers at pixel centres (COLMAP has them at .5)."""
    lens: str
    """One of `choices.LENSES`."""
    distortion: tuple[float, ...]
    """Coefficients of the lens, or none."""


@dataclass(frozen=True, kw_only=True)
class ColmapImage:
    """A registered image: x_camera = rotation · x_model + translation."""

    camera: int
    rotation: Floats
    """(3, 3)."""
    translation: Floats
    """(3,) in model units."""
    points: NDArray[np.int64]
    """Numbers of the points that are observed in it, sorted and unique."""


@dataclass(frozen=True, kw_only=True)
class ColmapPoints:
    """The points of a model, sorted by number."""

    number: NDArray[np.int64]
    """(N,) COLMAP's numbers."""
    xyz: Floats
    """(N, 3) in model units."""
    error: Floats
    """(N,) mean reprojection error in pixels, negative where it was not computed."""
    track: NDArray[np.int64]
    """(N,) images that observe the point."""


@dataclass(frozen=True, kw_only=True)
class ColmapModel:
    """A sparse model."""

    folder: Path
    cameras: dict[int, ColmapCamera]
    """By number."""
    images: dict[str, ColmapImage]
    """The registered images by name, a path below the image folder."""
    points: ColmapPoints


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
    """Returns the camera of a model `name` with its parameters in COLMAP's order.

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


def image_of(
    path: Path, name: str, camera: int, pose: Sequence[float], points: NDArray[np.int64]
) -> ColmapImage:
    """Returns the image with a pose qw qx qy qz tx ty tz from the model's frame to the camera's.

    `points` (K,) are the numbers of the points at its keypoints, -1 for none.

    Raises:
        FileFormatError: The numbers are no pose.
    """
    values = np.array(pose, np.float64)
    length = float(np.linalg.norm(values[:4]))
    if not np.isfinite(values).all() or not 1e-6 < length < 1e6:
        raise FileFormatError(
            f"{path}: the pose of {one_line(name)!r} is not made of finite numbers; create the"
            " model again"
        )
    return ColmapImage(
        camera=camera,
        rotation=rotation_of(values[:4]),
        translation=values[4:],
        points=np.unique(points[points != -1]),
    )


def points_of(
    path: Path, number: NDArray[np.int64], rows: Floats, track: NDArray[np.int64]
) -> ColmapPoints:
    """Returns the points, sorted by number, from rows (N, 4) of x y z and reprojection error.

    Raises:
        FileFormatError: A coordinate is not finite.
    """
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise FileFormatError(
            f"{path}: {int(bad.sum()):,} of {len(rows):,} points have no finite coordinates;"
            " create the model again"
        )
    order = np.argsort(number, kind="stable")
    return ColmapPoints(
        number=number[order], xyz=rows[order, :3], error=rows[order, 3], track=track[order]
    )
