"""Depth images in every format: float32 metres inside, 0 where depth is unknown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import check_pixel_count, read_bytes
from pnpdepth_cli.io.formats import (
    KITTI_SCALE,
    SATURATED_CODE,
    StoredArray,
    check_scale,
    depth_formats,
    format_of_content,
    kind_of,
)
from pnpdepth_cli.io.formats.png import eight_bits


@dataclass(frozen=True, kw_only=True)
class DepthImage:
    """A depth image as read from a file."""

    values: NDArray[np.float32]
    """(H, W) metres, 0 where unknown."""

    source: str
    """What was read, for a person."""

    assumed_scale: bool
    """True if neither the file nor the user gave the scale."""

    scale: float | None = None
    """Codes per metre that integers were divided by; None for a float file."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(H, W), true where depth is known."""
        return self.values > 0


def read_depth(path: Path, *, scale: float | None = None, channel: str | None = None) -> DepthImage:
    """Returns the depth image in a file of any of `choices.FORMATS`.

    Zero, NaN, infinite and negative values are unknown, and so is the largest 16-bit code.

    Args:
        path: The file, recognised by its content.
        scale: Codes per metre of an integer file; float files hold metres and ignore it.
        channel: The EXR channel or NPZ array to read; other formats have one and ignore it.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or not a depth image.
        UsageError: The scale is not above 0, or there is no such channel.
    """
    check_scale(scale)
    return depth_from_stored(path, load_stored(path, channel), scale)


def load_stored(path: Path, channel: str | None) -> StoredArray:
    """Returns the one array of numbers in the file that can be depth, of whatever shape.

    Args:
        path: A file of any of `choices.FORMATS`, recognised by its content.
        channel: The EXR channel or NPZ array to read; None if there is one candidate.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or not a depth file.
    """
    data = read_bytes(path)
    depth_format = format_of_content(data)
    if depth_format is not None:
        return depth_format.read(path, data, channel)
    kind = kind_of(data)
    if kind is not None:
        raise eight_bits(path, kind)
    names = [each.name for each in depth_formats() if each.name != "PNG"]
    raise FileFormatError(
        f"{path} is not a depth file; give a 16-bit PNG, {', '.join(names[:-1])} or {names[-1]}"
    )


def depth_from_stored(path: Path, stored: StoredArray, scale: float | None) -> DepthImage:
    """Returns the stored numbers as a depth image: one channel, metres, 0 where unknown.

    Args:
        path: Named in messages.
        stored: Numbers of a file.
        scale: Codes per metre; None for the file's own, or KITTI's.

    Raises:
        FileFormatError: The numbers are no image of one channel, or exceed the budget.
    """
    values = _as_image(path, stored.values)
    check_pixel_count(path, values.shape[1], values.shape[0])
    if values.dtype.kind == "f":
        return DepthImage(
            values=known_metres(values), source=stored.description, assumed_scale=False
        )
    divisor = scale or stored.scale or KITTI_SCALE
    assumed = scale is None and stored.scale is None
    source = f"{stored.description} ÷ {divisor:.12g}"
    if scale is None and stored.scale is not None:
        source += " (from the file)"
    saturated = (values == SATURATED_CODE) & (values.dtype == np.uint16)
    if saturated.any():
        count = int(saturated.sum())
        source += f", {count:,} pixels of value {SATURATED_CODE} taken as unknown"
        values = np.where(saturated, 0, values)
    metres = values.astype(np.float64) / divisor
    return DepthImage(
        values=known_metres(metres), source=source, assumed_scale=assumed, scale=divisor
    )


def known_metres(values: NDArray[Any]) -> NDArray[np.float32]:
    """Returns float32 of the same shape with 0 for everything but a finite depth above 0."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        metres = np.array(values, dtype=np.float32)
        metres[~(np.isfinite(metres) & (metres > 0))] = 0
    return metres


def _as_image(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    shape = values.shape
    if len(shape) == 4 and shape[0] == 1:  # a batch of one, as networks give it
        return _as_image(path, values[0])
    if len(shape) == 3 and 1 in (shape[0], shape[2]):
        return values.reshape(shape[1:] if shape[0] == 1 else shape[:2])
    if len(shape) == 2:
        return values
    listing = "x".join(str(length) for length in shape) or "a single number"
    raise FileFormatError(
        f"{path} holds an array of shape {listing}; a depth image is (H, W), save one channel"
    )
