"""Parts of a frame from their files: image, camera, masks, and depth of an image's view."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.frame_files import IMAGE_SUFFIXES, ImageSource, file_of
from pnpdepth_cli.errors import InputError, UsageError, unequal_sizes
from pnpdepth_cli.file_record import FileKind, FileRecord
from pnpdepth_cli.io import file_bytes
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import known_metres, load_stored
from pnpdepth_cli.io.formats import DepthFile, Reading
from pnpdepth_cli.io.rgb import (
    read_exr_colour,
    read_focal_length,
    read_rgb,
    read_video_frame,
    sizes_of,
)
from pnpdepth_cli.points import Size
from pnpdepth_cli.sensors.projection import Points, as_depth_image

_OFF_CENTRE_ACROSS = 0.15
"""Fraction of the image's width by which a principal point may be off its middle."""
_OFF_CENTRE_DOWN = 0.35
"""The same of its height. Rows are cut off above, where a LiDAR sees nothing, with the calibration
adjusted."""
_ASPECT_TOLERANCE = 0.02
"""Relative difference of aspect ratios up to which images may be of one view."""


def record_of(
    source: ImageSource, reading: Reading | None = None, *, kind: FileKind = "depth"
) -> FileRecord:
    """Returns what a record keeps of a file, and of how it was read.

    Args:
        source: The file, or a frame of a video, whose file's digest is kept.
        reading: How depth was read from it. None: it holds none, or that is not kept.
        kind: What the file is.
    """
    digest = file_bytes.fingerprint(file_of(source)).sha256
    record = FileRecord(path=str(source), kind=kind, sha256=digest)
    if reading is None:
        return record
    return replace(record, read_as=reading.source, scale=reading.scale, assumed=reading.assumed)


def read_image(source: ImageSource) -> NDArray[np.float32]:
    """Returns an image (H, W, 3) in 0…1. Raises InputError for a file that is no image."""
    if isinstance(source, Path):
        return read_rgb(source).values
    return read_video_frame(source.path, source.index)


def image_of_size(source: ImageSource, size: tuple[int, ...]) -> NDArray[np.float32]:
    """Returns an image (H, W, 3) in 0…1 at the size of its depth: upright, or as it is stored.

    COLMAP reads photos as they are stored, so its depth is of that size.

    Args:
        source: The image.
        size: (H, W) of its depth.

    Raises:
        InputError: It has that size neither upright nor as it is stored.
    """
    rgb = read_image(source)
    if rgb.shape[:2] != size and isinstance(source, Path):
        rgb = read_rgb(source, upright=False).values
    if rgb.shape[:2] != size:
        raise unequal_sizes(
            str(source),
            rgb.shape,
            "its depth",
            size,
            "; give the image of this depth with --image",
        )
    return rgb


def read_levels(path: Path) -> NDArray[np.floating | np.integer]:
    """Returns the numbers (H, W) in the file of a mask or of the confidence of depth.

    They are as stored. Of a pixel in colour it is the largest channel.

    Raises:
        InputError: The file holds no such numbers.
    """
    if path.suffix.lower() == ".exr":
        return np.asarray(read_exr_colour(path, file_bytes.read_bytes(path)).max(axis=2))
    if path.suffix.lower() in IMAGE_SUFFIXES:
        image = read_rgb(path)
        return np.asarray(np.rint(image.values.max(axis=2) * image.white))
    values = load_stored(path, is_mask=True).values
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    if values.ndim != 2:
        raise InputError(f"{path}: mask or confidence is (H, W), not of shape {values.shape}")
    return values


def apply_masks(depth: NDArray[np.float32], masks: tuple[Path, ...]) -> NDArray[np.float32]:
    """Returns the depth (H, W), 0 where unknown, with 0 also where any of the masks is 0.

    Args:
        depth: (H, W) ground truth.
        masks: Files of masks, of the same size.

    Raises:
        InputError: A mask has another size.
    """
    for path in masks:
        mask = read_levels(path) > 0
        if mask.shape != depth.shape:
            raise unequal_sizes(f"mask {path}", mask.shape, "the ground truth", depth.shape)
        depth = np.where(mask, depth, np.float32(0))
    return depth


def same_aspect_ratio(first: tuple[int, ...], second: tuple[int, ...]) -> bool:
    """Returns whether images of two sizes (H, W) can show one view."""
    return abs(first[1] * second[0] / (first[0] * second[1]) - 1) <= _ASPECT_TOLERANCE


def check_same_view(what: str, map_size: tuple[int, ...], size: Size) -> None:
    """Raises InputError unless a map and the image have one aspect ratio.

    Args:
        what: Name of the map, as a sentence begins.
        map_size: (H, W) of the map.
        size: (H, W) of the image.
    """
    if not same_aspect_ratio(map_size, size):
        sizes = f"{map_size[1]}×{map_size[0]} and the image {size[1]}×{size[0]}"
        if same_aspect_ratio(map_size[::-1], size):
            raise InputError(
                f"{what} is {sizes}: they do not show the same view; one is turned by 90°, turn it"
                " back"
            )
        raise InputError(f"{what} is {sizes}: they do not show the same view")


def moved_note(map_size: tuple[int, ...], size: Size) -> str:
    """Returns a line for a person on points of a map (H, W) in an image of another size (H, W)."""
    return f"points of {map_size[1]}×{map_size[0]} are moved to the image of {size[1]}×{size[0]}"


def move_depth(path: Path, depth: NDArray[np.float32], size: Size) -> NDArray[np.float32]:
    """Returns a depth map of the image's size, with each known depth on its pixel; others are 0.

    No depth is interpolated: in a larger image most pixels stay unknown. In a smaller one the
    nearest of the depths on a pixel wins.

    Args:
        path: The file of the depth, for messages.
        depth: (h, w), 0 where unknown.
        size: (H, W) of the image, of the same view.

    Raises:
        InputError: The two have different aspect ratios.
    """
    check_same_view(str(path), depth.shape[:2], size)
    rows, columns = np.nonzero(depth)
    xy = np.column_stack([columns, rows]).astype(np.float32)
    points = Points(xy=xy, depth=depth[rows, columns], size=(depth.shape[0], depth.shape[1]))
    return as_depth_image(points.resized(*size))


def raw_depth(path: Path, image: ImageSource | None) -> DepthFile | None:
    """Returns the depth (H, W) in a file without a header, as ETH3D has it; None of other files.

    Such a file holds float32 metres, row by row, at its image's size. It is named as the image,
    *.JPG, and is told from a picture by its length.

    Args:
        path: The file.
        image: The image of this depth. None: there is none, so there is no such depth.
    """
    if path.suffix.lower() != ".jpg" or not isinstance(image, Path):
        return None
    _, size = sizes_of(image)  # of the pixels as they are stored
    if file_bytes.size_of_regular_file(path) != 4 * math.prod(size):
        return None
    file_bytes.check_value_count(path, math.prod(size), value_bytes=4)
    values = known_metres(np.fromfile(path, "<f4").reshape(size))
    return DepthFile(values=values, reading=Reading("float32 without a header"))


def depth_of_inverse(file: DepthFile, factor: float, scale: float | None) -> DepthFile:
    """Returns depth in metres of the numbers of a file that hold disparity or 1/depth.

    Args:
        file: Numbers of any shape, 0 where unknown, as `read_depth` returns them.
        factor: The constant that depth × number is: 1 for 1/depth, and baseline × focal length in
            metres × pixels for disparity.
        scale: Numbers per 1/m or per pixel of disparity that the user states. Floats are divided by
            it first; integers have been already. None: none is stated.
    """
    values = file.values.astype(np.float64)
    if file.reading.scale is None and scale is not None:
        values = values / scale
    with np.errstate(divide="ignore"):
        depth = known_metres(np.where(values > 0, factor / values, 0))
    source = f"{file.reading.source}, depth = {factor:g} / value"
    return DepthFile(values=depth, reading=Reading(source, assumed=file.reading.assumed))


def camera_of_file(
    path: Path, number: int | None, size: Size, image: Path | None = None
) -> tuple[Camera, list[str]]:
    """Returns the camera of a calibration file, and warnings if it seems not to be of the image.

    Args:
        path: The calibration.
        number: Number of the camera in a file of several. None: the file's usual one.
        size: (H, W) of the image.
        image: File of the image, for messages. None: there is none.

    Raises:
        InputError: The file is no calibration, or is of another image.
    """
    camera = read_calibration(path, number).camera
    notes = check_camera(path, camera, size, image)
    return replace(camera, source=f"{path}: {camera.source}"), notes


def check_camera(path: Path, camera: Camera, size: Size, image: Path | None = None) -> list[str]:
    """Returns warnings if an image seems to be of another camera than a calibration, or none.

    Args:
        path: The calibration, for messages.
        camera: Its camera.
        size: (H, W) of the image.
        image: File of the image, for messages. None: there is none.

    Raises:
        InputError: They cannot belong together.
    """
    name = str(image or "the image")
    if camera.size is not None and camera.size != size:
        raise unequal_sizes(
            name, size, f"the image of {path}", camera.size, "; give the image at that size"
        )
    x, y = camera.intrinsics[:2, 2]
    if not (0 <= x < size[1] and 0 <= y < size[0]):
        raise InputError(
            f"{name} is {size[1]}×{size[0]}, which does not contain the principal point"
            f" ({x:.1f}, {y:.1f}) of {path}; one of them is of another camera or size"
        )
    across = abs(x / size[1] - 0.5)
    down = abs(y / size[0] - 0.5)
    if across > _OFF_CENTRE_ACROSS or down > _OFF_CENTRE_DOWN:
        return [
            f"warning: the principal point ({x:.1f}, {y:.1f}) of {path} is far from the centre of"
            f" a {size[1]}×{size[0]} image; does the calibration belong to this image?"
        ]
    return []


def camera_of_exif(image: ImageSource | None, size: Size, lacking: str) -> tuple[Camera, list[str]]:
    """Returns a camera of the focal length in an image's EXIF, and a line for a person.

    Its principal point is the image's middle, and it has no distortion.

    Args:
        image: The image. None: there is none.
        size: (H, W) of the image.
        lacking: Words that say what else has no camera, as the error begins.

    Raises:
        UsageError: EXIF states no focal length.
    """
    focal = read_focal_length(image, size) if isinstance(image, Path) else None
    if focal is None:
        raise UsageError(f"{lacking} nor a focal length in EXIF; give --calib")
    focal_px, source = focal
    height, width = size
    intrinsics = np.array(
        [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    )
    note = f"camera: {focal_px:.1f} pixels of focal length, no distortion ({source})"
    return Camera(intrinsics=intrinsics, size=size, source=source), [note]
