"""The focal length that a camera wrote into a photo."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.decoding import check_exif, silence

_EXIF_FOLDER = 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_RESOLUTION, _RESOLUTION_UNIT = 0xA20E, 0xA210
_WIDTH, _HEIGHT = 0xA002, 0xA003
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_PLAUSIBLE = (0.2, 50.0)
"""Focal length as a multiple of the image's longer side: fields of view of 136° to 1°."""


@dataclass(frozen=True, kw_only=True)
class ExifFocalLength:
    """A focal length from EXIF."""

    pixels: float
    """In pixels of the image."""
    source: str
    """What it was computed from, for a person."""


def read_focal_length(path: Path, size: tuple[int, int]) -> ExifFocalLength | None:
    """Returns the focal length in an image's EXIF; None if there is none that a camera can have.

    The 35 mm equivalent is preferred. It is taken as one of equal diagonal field of view, which is
    how CIPA DCG-001 has it. Else the focal length and the resolution of the sensor are used
    (Exif 2.32, tags 0x920A, 0xA20E, 0xA210). The image is used at the size (H, W).
    """
    values = _tags(path)
    focal = _of_film(values, size) or _of_sensor(values, size)
    if focal is None or not _PLAUSIBLE[0] <= focal.pixels / max(size) <= _PLAUSIBLE[1]:
        return None
    return focal


def _of_film(values: Mapping[int, float], size: tuple[int, int]) -> ExifFocalLength | None:
    film_mm = values.get(_FOCAL_LENGTH_35MM)
    if not film_mm:
        return None
    pixels = film_mm / _FILM_DIAGONAL_MM * math.hypot(*size)
    return ExifFocalLength(pixels=pixels, source=f"EXIF, equivalent to {film_mm:g} mm on film")


def _of_sensor(values: Mapping[int, float], size: tuple[int, int]) -> ExifFocalLength | None:
    focal_mm, resolution = values.get(_FOCAL_LENGTH), values.get(_RESOLUTION)
    unit_mm = _UNIT_MM.get(int(values.get(_RESOLUTION_UNIT, 2)))
    if not focal_mm or not resolution or unit_mm is None:
        return None
    taken = max(values.get(_WIDTH, 0), values.get(_HEIGHT, 0)) or max(size)
    pixels = focal_mm * resolution / unit_mm * max(size) / taken
    return ExifFocalLength(pixels=pixels, source=f"EXIF, {focal_mm:g} mm and the sensor's pixels")


def _tags(path: Path) -> dict[int, float]:
    """The numbers among the EXIF tags; none if they cannot be read."""
    from PIL import Image

    try:
        with silence(), Image.open(path) as image:
            check_exif(image)
            folder: Mapping[int, Any] = image.getexif().get_ifd(_EXIF_FOLDER)
    except Exception:  # Pillow raises many kinds; damaged EXIF gives no focal length
        return {}
    numbers = {}
    for tag, value in folder.items():
        try:
            number = float(value)
        except (TypeError, ValueError, ZeroDivisionError):
            continue
        if math.isfinite(number) and number > 0:
            numbers[tag] = number
    return numbers
