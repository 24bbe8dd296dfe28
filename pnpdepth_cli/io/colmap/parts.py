"""What a sparse model of COLMAP holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
    """Number of its camera."""

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
    """Where it was read."""

    cameras: dict[int, ColmapCamera]
    """By number."""

    images: dict[str, ColmapImage]
    """The registered images by name, a path below the image folder."""

    points: ColmapPoints
    """All points."""
