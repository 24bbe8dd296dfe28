"""Parts of a frame from their files: images, masked depth, arrays of HDF5 files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset.frame_files import (
    IMAGE_SUFFIXES,
    Hdf5Array,
    ImageSource,
    RawDepth,
    VideoFrame,
    file_of,
)
from pnpdepth_cli.errors import FileFormatError, InputError, SizeError, UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import known_metres, load_stored
from pnpdepth_cli.io.file_bytes import (
    check_value_count,
    fingerprint,
    one_line,
    read_bytes,
    size_of_regular_file,
)
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.io.rgb import read_exr_colour, read_rgb, read_video_frame, sizes_of

_ASPECT_TOLERANCE = 0.02
"""Relative difference of aspect ratios of images of one view."""


def record_of(source: ImageSource | RawDepth, reading: Reading | None = None) -> FileRecord:
    """Returns what a record keeps of a file, and of how it was read."""
    record = FileRecord(path=str(source), sha256=fingerprint(file_of(source)).sha256)
    if reading is None:
        return record
    return replace(record, read_as=reading.source, scale=reading.scale, assumed=reading.assumed)


def read_image(source: ImageSource) -> NDArray[np.float32]:
    """Returns (H, W, 3) float32 in 0..1. Raises InputError for a file or array that is no image."""
    if isinstance(source, Path):
        return read_rgb(source).values
    if isinstance(source, VideoFrame):
        return read_video_frame(source.path, source.index)
    pixels = _read(source)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise FileFormatError(f"{source} is {pixels.dtype} of shape {pixels.shape}, not an image")
    return pixels.astype(np.float32) / np.float32(255)


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


def read_levels(path: Path) -> NDArray[Any]:
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
    values = load_stored(path).values
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


def shape_of(path: Path, name: str) -> tuple[int, ...]:
    """Returns the shape of an array of the file. Raises InputError if it has none."""
    with _open_array(path, name) as array:
        return tuple(array.shape)


def depth_of(source: Hdf5Array | RawDepth) -> NDArray[np.float32]:
    """Returns (H, W) float32 metres, 0 where unknown, of floats. Raises InputError for others."""
    if isinstance(source, RawDepth):
        _, size = sizes_of(source.image)
        if size_of_regular_file(source.path) != 4 * math.prod(size):
            raise FileFormatError(
                f"{source} does not hold 4 bytes for each pixel of {source.image}; unpack it again"
            )
        check_value_count(source.path, math.prod(size), value_bytes=4)
        return known_metres(np.fromfile(source.path, "<f4").reshape(size))
    metres = _read(source)
    if metres.dtype.kind != "f" or metres.ndim != 2:
        raise FileFormatError(f"{source} is {metres.dtype} of shape {metres.shape}, not depth")
    return known_metres(metres)


def _read(source: Hdf5Array) -> NDArray[Any]:
    with _open_array(source.path, source.name) as array:
        if array.dtype.kind not in "fiu":
            raise FileFormatError(f"{source} holds {array.dtype} values, not numbers")
        one = array.shape if source.index is None else array.shape[1:]
        check_value_count(source.path, math.prod(one), size_of_regular_file(source.path))
        if source.index is not None and source.index >= array.shape[0]:
            raise FileFormatError(f"{source}: there are only {array.shape[0]}")
        values = np.asarray(array[()] if source.index is None else array[source.index])
    if values.ndim != len(source.axes):
        raise FileFormatError(f"{source} has {values.ndim} axes instead of {len(source.axes)}")
    return values.transpose(source.axes)


@contextmanager
def _open_array(path: Path, name: str) -> Iterator[Any]:
    """An array of an HDF5 file, which lies in the file itself."""
    try:
        import h5py
    except ImportError:
        raise UsageError(f"reading {path} needs h5py: pip install 'pnpdepth[nyu]'") from None
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path")
    try:
        with h5py.File(path, "r") as file:
            link = file.get(name, getlink=True)
            if link is None:
                raise FileFormatError(f"{path} has no array {name}; it is of another kind")
            array = file[name] if isinstance(link, h5py.HardLink) else None
            if array is None or array.external or array.is_virtual:
                raise FileFormatError(
                    f"{path}: {name} is stored outside the file; copy its values into this one"
                )
            yield array
    except (OSError, RuntimeError, ValueError, LookupError, TypeError) as error:  # as h5py has it
        raise FileFormatError(f"{path} cannot be read as HDF5 ({one_line(error)})") from error
