"""Parts of a frame from their files: images, masks, and depth of an image's view."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset.frame_files import IMAGE_SUFFIXES, ImageSource, file_of
from pnpdepth_cli.errors import FileFormatError, SizeError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import known_metres, load_stored
from pnpdepth_cli.io.file_bytes import (
    check_value_count,
    fingerprint,
    read_bytes,
    size_of_regular_file,
)
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.io.rgb import read_exr_colour, read_rgb, read_video_frame, sizes_of

_ASPECT_TOLERANCE = 0.02
"""Relative difference of aspect ratios of images of one view."""


def record_of(source: ImageSource, reading: Reading | None = None) -> FileRecord:
    """Returns what a record keeps of a file, and of how it was read."""
    record = FileRecord(path=str(source), sha256=fingerprint(file_of(source)).sha256)
    if reading is None:
        return record
    return replace(record, read_as=reading.source, scale=reading.scale, assumed=reading.assumed)


def read_image(source: ImageSource) -> NDArray[np.float32]:
    """Returns (H, W, 3) float32 in 0..1. Raises InputError for a file that is no image."""
    if isinstance(source, Path):
        return read_rgb(source).values
    return read_video_frame(source.path, source.index)


def image_of_size(source: ImageSource, size: tuple[int, ...]) -> NDArray[np.float32]:
    """Returns (H, W, 3) in 0..1 of the image that has this size: upright, or as COLMAP reads it.

    Raises:
        SizeError: It has neither.
    """
    rgb = read_image(source)
    if rgb.shape[:2] != size and isinstance(source, Path):
        rgb = read_rgb(source, upright=False).values
    if rgb.shape[:2] != size:
        raise SizeError(
            f"{source} is {rgb.shape[1]}×{rgb.shape[0]} but its depth {size[1]}×{size[0]}; give the"
            " image of this depth with --image"
        )
    return rgb


def read_levels(path: Path) -> NDArray[np.floating | np.integer]:
    """Returns the numbers (H, W) in the file of a mask or of the confidence of depth.

    They are as stored. Of a pixel in colour it is the largest channel.

    Raises:
        InputError: The file holds no such numbers.
    """
    if path.suffix.lower() == ".exr":
        return np.asarray(read_exr_colour(path, read_bytes(path)).max(axis=2))
    if path.suffix.lower() in IMAGE_SUFFIXES:
        image = read_rgb(path)
        return np.asarray(np.rint(image.values.max(axis=2) * image.white))
    values = load_stored(path, is_mask=True).values
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    if values.ndim != 2:
        raise FileFormatError(f"{path}: mask or confidence is (H, W), not of shape {values.shape}")
    return values


def apply_masks(depth: NDArray[np.float32], masks: tuple[Path, ...]) -> NDArray[np.float32]:
    """Returns the depth (H, W) with 0 where any of the masks is 0.

    Raises:
        SizeError: A mask has another size.
    """
    for path in masks:
        mask = read_levels(path) > 0
        if mask.shape != depth.shape:
            raise SizeError(
                f"mask {path} is {mask.shape[1]}×{mask.shape[0]} but the ground truth is"
                f" {depth.shape[1]}×{depth.shape[0]}"
            )
        depth = np.where(mask, depth, np.float32(0))
    return depth


def check_same_view(what: str, own: tuple[int, ...], size: tuple[int, int]) -> None:
    """Raises SizeError unless the sizes `own` and `size` (H, W) have one aspect ratio."""
    if abs(own[1] * size[0] / (own[0] * size[1]) - 1) > _ASPECT_TOLERANCE:
        turned = abs(own[0] * size[0] / (own[1] * size[1]) - 1) <= _ASPECT_TOLERANCE
        raise SizeError(
            f"{what} is {own[1]}×{own[0]} and the image {size[1]}×{size[0]}: they do not show the"
            " same view" + ("; one is turned by 90°, turn it back" if turned else "")
        )


def moved_note(own: tuple[int, ...], size: tuple[int, int]) -> str:
    """Returns a line for a person on points of a map (H, W) in an image of another size (H, W)."""
    return f"points of {own[1]}×{own[0]} are moved to the image of {size[1]}×{size[0]}"


def move_depth(
    path: Path, depth: NDArray[np.float32], size: tuple[int, int]
) -> NDArray[np.float32]:
    """Returns the known depths (H, W) at the pixels of an image of the same view; the nearest wins.

    No depth is interpolated: in an image that is larger, `size` (H, W), most pixels stay unknown.

    Raises:
        SizeError: The two have different aspect ratios.
    """
    check_same_view(str(path), depth.shape[:2], size)
    rows, columns = np.nonzero(depth)
    row = ((rows + 0.5) * size[0] / depth.shape[0]).astype(np.intp)
    column = ((columns + 0.5) * size[1] / depth.shape[1]).astype(np.intp)
    moved = np.full(size, np.inf, np.float32)
    np.minimum.at(moved, (row, column), depth[rows, columns])
    return np.where(np.isinf(moved), np.float32(0), moved)


def raw_depth(path: Path, image: ImageSource | None) -> NDArray[np.float32] | None:
    """Returns depth (H, W) of a file without a header, as ETH3D has it; None for other files.

    It holds float32 metres, row by row, of its image's size, and is named as that, *.JPG.
    """
    if path.suffix.lower() != ".jpg" or not isinstance(image, Path):
        return None
    _, size = sizes_of(image)
    if size_of_regular_file(path) != 4 * math.prod(size):
        return None
    check_value_count(path, math.prod(size), value_bytes=4)
    return known_metres(np.fromfile(path, "<f4").reshape(size))
