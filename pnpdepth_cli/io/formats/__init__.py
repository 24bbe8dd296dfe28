"""What a depth file format is; those of this package are in `TABLE` of `pnpdepth_cli.io.depth`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from pnpdepth_cli.choices import FORMATS
from pnpdepth_cli.errors import InputError, UsageError

KITTI_SCALE = 256.0
"""Codes per metre in the KITTI depth files, assumed for integers that do not say their own."""

SCALE_KEY = "pnpdepth:scale"
"""Key under which our own 16-bit files keep their codes per metre."""

SATURATED_CODE = 65535
"""The largest 16-bit code: what a sensor gives beyond its range, so never a measurement."""

LARGEST_CODE = SATURATED_CODE - 1
"""The largest code that is written."""


class Reading(NamedTuple):
    """How depth was read from a file, or made."""

    source: str  # in words, such as "16-bit PNG ÷ 256"
    scale: float | None = None  # codes per metre; None for floats
    assumed: bool = False
    """Whether the scale is assumed, as neither the file nor the user nor the data set states it."""

    def __str__(self) -> str:
        return self.source + ", assumed" * self.assumed


@dataclass(frozen=True, kw_only=True)
class DepthFile:
    """The numbers of a depth file: as stored, from a format; float32 metres, from `read_depth`."""

    values: NDArray[Any]
    """(H, W). As stored, floats in metres or integer codes, of any shape that `is_image` allows."""
    reading: Reading
    """How the file was read; of stored values, the scale is the one that the file itself states."""
    is_image: bool = True  # false for NPY and NPZ, whose arrays may also be lists of points


@dataclass(frozen=True, kw_only=True)
class DepthFormat:
    """One file format of depth images."""

    name: str  # as messages call it, such as "PNG"
    suffixes: tuple[str, ...]
    """Suffixes of its files in lower case; "." and the name in `choices.FORMATS` is one of them."""
    magic: tuple[bytes, ...]
    """What the content begins with; files are recognised by content, never by suffix."""
    read: Callable[[Path, bytes], DepthFile]
    """Reader of path (for messages) and content. Raises InputError."""
    write: Callable[[Path, NDArray[Any], Mapping[str, str]], None]
    """(H, W) float32 metres or uint16 codes, 0 where unknown, into an existing empty file, with
    texts by key where the format has room for them."""
    integer: bool = False  # whether files hold 16-bit integer codes, not float32 metres


def format_of_content(data: bytes) -> DepthFormat | None:
    """The format whose magic the content begins with; None for another kind of file."""
    return next((kind for kind in FORMATS.values() if data.startswith(kind.magic)), None)


def format_of_suffix(suffix: str) -> DepthFormat | None:
    """The format that is written for a suffix in any case; None for an unknown one."""
    return next((kind for kind in FORMATS.values() if suffix.lower() in kind.suffixes), None)


def kind_of(data: bytes) -> str | None:
    """Returns "PNG", "JPEG", "TIFF", "WEBP" or the name of another depth format; None if unknown.

    Args:
        data: Content of the file, or at least its first 16 bytes.
    """
    if data.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WEBP"
    depth_format = format_of_content(data)
    return None if depth_format is None else depth_format.name


def no_depth(path: Path, what: str) -> InputError:
    """Returns the error for an image of pixels that hold no depth."""
    way_out = "give the 16-bit PNG, EXR or NPY that it is an image of"
    return InputError(f"{path} is {what}, which cannot hold depth; {way_out}")


def check_scale(scale: float | None) -> None:
    """Raises UsageError unless the scale is None or a finite number above 0."""
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise UsageError(f"--depth-scale must be a finite number above 0, not {scale:g}")
