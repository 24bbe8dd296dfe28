"""OpenEXR: every flat channel of a file, in the frame of its display window."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.opening import check_pixel_count, damaged

_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000  # bits of the version field


def read_exr_channels(path: Path, data: bytes) -> dict[str, NDArray[Any]]:
    """Name -> (H, W) array, float16, float32 or uint32; `data` is the content of `path`.

    Channels of a file with several parts are called `part.channel`. Pixels of the display
    window outside the data window are 0.
    """
    _check_complete(path, data)
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            headers = [file.header(index) for index in range(len(file.parts))]
        for header in headers:
            _check_header(path, header)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [_part_channels(part) for part in file.parts]
            names = [str(part.name()) for part in file.parts]
    except FileFormatError:
        raise
    except Exception as error:  # the binding raises many kinds, UnicodeDecodeError among them
        raise damaged(path, "EXR", f"cannot be read ({error})") from error
    if len(parts) == 1:
        channels = parts[0]
    else:
        channels = {
            f"{name}.{channel}": pixels
            for name, part in zip(names, parts, strict=True)
            for channel, pixels in part.items()
        }
    if not channels:
        raise FileFormatError(f"{path} holds no channel; export the depth again")
    return channels


def write_exr_channel(path: Path, name: str, values: NDArray[np.float32]) -> None:
    """`path` holds the one float32 channel, ZIP compressed. Raises OSError if it cannot."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channel = OpenEXR.Channel(np.ascontiguousarray(values, dtype=np.float32))
    try:
        with OpenEXR.File(header, {name: channel}) as file:
            file.write(str(path))
    except RuntimeError as error:  # how the binding reports a full disk, say
        raise OSError(str(error)) from error


def _check_header(path: Path, header: dict[str, Any]) -> None:
    for window in ("dataWindow", "displayWindow"):
        low, high = header[window]
        width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        check_pixel_count(path, width, height)
    for channel in header["channels"]:
        if (channel.xSampling, channel.ySampling) != (1, 1):
            raise FileFormatError(
                f"{path}: channel {channel.name} is subsampled; export it at full resolution"
            )


def _part_channels(part: Any) -> dict[str, NDArray[Any]]:
    data, display = (np.asarray(part.header[key]) for key in ("dataWindow", "displayWindow"))
    channels = {name: np.asarray(channel.pixels) for name, channel in part.channels.items()}
    if np.array_equal(data, display):
        return channels
    return {name: _in_display(pixels, data, display) for name, pixels in channels.items()}


def _in_display(
    pixels: NDArray[Any], data: NDArray[np.int64], display: NDArray[np.int64]
) -> NDArray[Any]:
    width, height = display[1] - display[0] + 1
    placed = np.zeros((height, width), dtype=pixels.dtype)
    left, top = np.maximum(data[0], display[0])
    right, bottom = np.minimum(data[1], display[1]) + 1
    if left < right and top < bottom:
        (x0, y0), (x1, y1) = data[0], display[0]
        placed[top - y1 : bottom - y1, left - x1 : right - x1] = pixels[
            top - y0 : bottom - y0, left - x0 : right - x0
        ]
    return placed


def _check_complete(path: Path, data: bytes) -> None:
    """Raises FileFormatError unless every block of pixels lies within the file.

    The OpenEXR binding prints its complaints about a file cut short to standard output,
    which belongs to our own data; so such a file must not reach it.
    """
    try:
        (version,) = struct.unpack_from("<I", data, 4)
        if version & _DEEP:
            raise FileFormatError(f"{path} is a deep EXR; export it flattened")
        offsets, table_end = _chunk_offsets(data, version)
        last = max(offsets)
        multipart = 4 if version & _MULTIPART else 0
        # A multi-part file may mix tiles and lines; there only the block's start is checked.
        start = last + multipart + (16 if version & _TILED else 4)
        (size,) = struct.unpack_from("<i", data, start)
        complete = min(offsets) >= table_end and last + 8 <= len(data)
        if not multipart:
            complete = complete and size >= 0 and start + 4 + size <= len(data)
    except (struct.error, ValueError) as error:
        raise damaged(path, "EXR", "is cut short or corrupt") from error
    if not complete:
        raise damaged(path, "EXR", f"is cut short after {len(data):,} bytes")


def _chunk_offsets(data: bytes, version: int) -> tuple[list[int], int]:
    """The table that follows the header: it ends where the first block of pixels begins."""
    position = _end_of_header(data, 8)
    while version & _MULTIPART and data[position] != 0:
        position = _end_of_header(data, position)
    position += 1 if version & _MULTIPART else 0
    offsets: list[int] = []
    first = len(data)
    while position < first:
        (offset,) = struct.unpack_from("<Q", data, position)
        offsets.append(offset)
        first = min(first, offset)
        position += 8
    return offsets, position


def _end_of_header(data: bytes, position: int) -> int:
    while position < len(data) and data[position] != 0:
        name_end = data.index(0, position)
        type_end = data.index(0, name_end + 1)
        (size,) = struct.unpack_from("<i", data, type_end + 1)
        if size < 0:
            raise ValueError("an attribute has a negative size")
        position = type_end + 5 + size
    if position >= len(data):
        raise ValueError("the header has no end")
    return position + 1
