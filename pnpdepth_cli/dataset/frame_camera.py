"""The camera of an image, from a calibration or from EXIF."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.errors import SizeError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.rgb import read_focal_length

_OFF_CENTRE = 0.15  # of the image's side: principal points nearer the centre give no warning


def camera_of_file(
    path: Path, number: int | None, size: tuple[int, int], image: Path | None = None
) -> tuple[Camera, list[str]]:
    """Returns the camera of a calibration file for an image (H, W) of this file, and warnings.

    Raises:
        InputError: The file is no calibration.
        SizeError: It is of another image.
    """
    camera = read_calibration(path, number).camera
    notes = check_size(path, camera, size, image)
    return replace(camera, source=f"{path}: {camera.source}"), notes


def check_size(
    path: Path, camera: Camera, size: tuple[int, int], image: Path | None = None
) -> list[str]:
    """Returns warnings if an image (H, W) seems to be of another camera than a calibration.

    Raises:
        SizeError: They cannot belong together.
    """
    name = f"{image} is" if image else "the image is"
    if camera.size is not None and camera.size != size:
        height, width = camera.size
        raise SizeError(
            f"{name} {size[1]}×{size[0]} but {path} is for images of {width}×{height}; give the"
            " image at that size"
        )
    x, y = camera.intrinsics[:2, 2]
    if not (0 <= x < size[1] and 0 <= y < size[0]):
        raise SizeError(
            f"{name} {size[1]}×{size[0]}, which does not contain the principal point"
            f" ({x:.1f}, {y:.1f}) of {path}; one of them is of another camera or size"
        )
    if max(abs(x / size[1] - 0.5), abs(y / size[0] - 0.5)) > _OFF_CENTRE:
        return [
            f"warning: the principal point ({x:.1f}, {y:.1f}) of {path} is far from the centre of"
            f" a {size[1]}×{size[0]} image; does the calibration belong to this image?"
        ]
    return []


def camera_of_exif(image: Path, size: tuple[int, int]) -> tuple[Camera, list[str]] | None:
    """Returns the camera of EXIF, without distortion, and a line for a person; None for none."""
    if (focal := read_focal_length(image, size)) is None:
        return None
    (focal_px, source), (height, width) = focal, size
    intrinsics = np.array(
        [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    )
    note = f"camera: {focal_px:.1f} pixels of focal length, no distortion ({source})"
    return Camera(intrinsics=intrinsics, size=size, source=source), [note]
