"""PNG: one channel of 16-bit codes; every chunk is checked, so that altered files are refused.

The chunks are read here because Pillow leaves the checksum of the last one unchecked and takes
80 ms to import, where a depth image is decoded by OpenCV.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, OutputError
from pnpdepth_cli.io.depth_scale import SATURATED_CODE, SCALE_KEY, check_scale, scale_in_text
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged
from pnpdepth_cli.io.formats import DepthFormat, StoredArray, WriteOptions
from pnpdepth_cli.io.opencv import decode_with_opencv

GREY = 0
RGB = 2
PALETTE = 3

LARGEST_CODE = SATURATED_CODE - 1
"""The largest code that is written."""

_COMPRESSION_LEVEL = 4  # of zlib: a third of the time of its default 6, files 4 per cent larger


@dataclass(frozen=True, kw_only=True)
class PngFacts:
    """Header and texts of a PNG."""

    width: int
    """Pixels."""

    height: int
    """Pixels."""

    bit_depth: int
    """Bits of one channel."""

    colour_type: int
    """GREY, RGB, PALETTE, or another number of the PNG specification."""

    text: dict[str, str]
    """The tEXt chunks by key."""


def read_png_facts(path: Path, data: bytes) -> PngFacts:
    """Returns the header and texts of a PNG.

    Raises:
        FileFormatError: A chunk is missing or altered, or the image is larger than the budget.
    """
    header: bytes | None = None
    text: dict[str, str] = {}
    position = 8
    kind = b""
    while kind != b"IEND":
        if position + 12 > len(data):
            raise damaged(path, "PNG", f"is cut short after {len(data):,} bytes")
        (length,) = struct.unpack_from(">I", data, position)
        kind = data[position + 4 : position + 8]
        body = data[position + 8 : position + 8 + length]
        end = position + 12 + length
        if end > len(data):
            raise damaged(path, "PNG", f"is cut short after {len(data):,} bytes")
        if zlib.crc32(kind + body) != struct.unpack_from(">I", data, end - 4)[0]:
            raise damaged(path, "PNG", f"has a wrong checksum at byte {position:,}")
        if kind == b"IHDR":
            header = body
        elif kind == b"tEXt":
            key, _, value = body.partition(b"\0")
            text[key.decode("latin-1")] = value.decode("latin-1")
        position = end
    if header is None or len(header) != 13:
        raise damaged(path, "PNG", "has no valid header")
    width, height, bit_depth, colour_type = struct.unpack_from(">IIBB", header)
    check_pixel_count(path, width, height, file_bytes=len(data))
    return PngFacts(
        width=width, height=height, bit_depth=bit_depth, colour_type=colour_type, text=text
    )


def eight_bits(path: Path, kind: str) -> FileFormatError:
    """Returns the error for an 8-bit image given as depth."""
    return FileFormatError(
        f"{path} is an 8-bit {kind}; 8 bits cannot hold depth and it is probably an image of a "
        "depth map, give the 16-bit PNG, EXR or NPY"
    )


def _read(path: Path, data: bytes, channel: str | None) -> StoredArray:
    facts = read_png_facts(path, data)
    if facts.bit_depth != 16 and facts.colour_type != PALETTE:
        raise eight_bits(path, "PNG")
    if facts.colour_type not in (GREY, RGB):
        raise _not_grey(path, "a palette" if facts.colour_type == PALETTE else "several channels")
    codes = decode_with_opencv(path, data, "PNG")
    description = "16-bit PNG"
    if facts.colour_type == RGB:
        codes = _equal_channel(path, codes)
        description += " of three equal channels"
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise damaged(path, "PNG", "cannot be decoded as 16-bit grey")
    scale = scale_in_text(path, f"{SCALE_KEY}={facts.text.get(SCALE_KEY, '')}")
    return StoredArray(values=codes, description=description, scale=scale)


def _equal_channel(path: Path, codes: NDArray[Any]) -> NDArray[Any]:
    """(H, W) of an image whose three colours are equal, as SYNTHIA's depth is stored."""
    if codes.ndim != 3 or codes.shape[2] < 3:
        raise damaged(path, "PNG", "cannot be decoded as 16-bit colour")
    first = codes[:, :, 0]
    # where the file makes one colour transparent, OpenCV adds a fourth channel
    if not all(np.array_equal(first, codes[:, :, k]) for k in (1, 2)):
        raise _not_grey(path, "several channels")
    return np.ascontiguousarray(first)


def _not_grey(path: Path, colours: str) -> FileFormatError:
    return FileFormatError(
        f"{path} is a PNG with {colours}; depth is one 16-bit grey channel, save it so"
    )


def _write(file: Path, metres: NDArray[np.float32], options: WriteOptions) -> None:
    scale = repr(float(options.scale)).removesuffix(".0")
    _save(file, _codes(options.path, metres, options.scale), {SCALE_KEY: scale, **options.text})


def _codes(path: Path, metres: NDArray[np.float32], scale: float) -> NDArray[np.uint16]:
    check_scale(scale)
    codes = np.rint(metres.astype(np.float64) * scale)
    if codes.max() > LARGEST_CODE:
        raise OutputError(
            f"{path}: the largest depth, {metres.max():.6g} m, does not fit a 16-bit PNG with "
            f"{scale:g} codes per metre (at most {LARGEST_CODE / scale:.6g} m); "
            "write .exr, .npy or .tiff"
        )
    lost = (metres > 0) & (codes == 0)
    if lost.any():
        raise OutputError(
            f"{path}: {int(lost.sum()):,} depths down to {metres[lost].min():.3g} m would become "
            f"0 (unknown) in a 16-bit PNG with {scale:g} codes per metre; write .exr, .npy or .tiff"
        )
    return codes.astype(np.uint16)


def _save(file: Path, codes: NDArray[np.uint16], text: Mapping[str, str]) -> None:
    from PIL import Image, PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    for key, value in text.items():
        chunks.add_text(key, value)
    Image.fromarray(codes).save(file, "PNG", pnginfo=chunks, compress_level=_COMPRESSION_LEVEL)


FORMAT = DepthFormat(
    name="PNG",
    suffixes=(".png",),
    magic=(b"\x89PNG\r\n\x1a\n",),
    read=_read,
    write=_write,
    integer=True,
)
