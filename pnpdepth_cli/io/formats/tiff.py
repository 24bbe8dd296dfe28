"""TIFF: one channel of float metres or 16-bit codes, of its first page.

The tags are read here because tifffile takes 0.15 s to import and decodes LZW only with a compiled
package more, where OpenCV decodes all that occurs.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.depth_scale import scale_in_text
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged
from pnpdepth_cli.io.formats import DepthFormat, StoredArray, WriteOptions
from pnpdepth_cli.io.formats.png import eight_bits
from pnpdepth_cli.io.opencv import decode_with_opencv

_WIDTH, _HEIGHT, _BITS, _DESCRIPTION, _SAMPLES, _FORMAT = 256, 257, 258, 270, 277, 339
_ORIENTATION = 274
_BLOCK_TAGS = ((273, 279), (324, 325))  # offsets and byte counts, of strips or of tiles
_ASCII, _SHORT, _LONG = 2, 3, 4
_SIZE = {_ASCII: 1, _SHORT: 2, _LONG: 4}


@dataclass(frozen=True, kw_only=True)
class TiffFacts:
    """Tags of the first page."""

    width: int
    """Pixels."""

    height: int
    """Pixels."""

    bits: int
    """Bits of one sample."""

    number: str
    """Kind of the samples: "uint", "int" or "float"."""

    samples: int
    """Channels of a pixel."""

    orientation: int
    """1 to 8 as in EXIF."""

    description: str
    """The image description; empty without one."""


def read_tiff_facts(path: Path, data: bytes) -> TiffFacts:
    """Returns the tags of the first page.

    Raises:
        FileFormatError: Tags or pixels lie outside the file, or the image exceeds the budget.
    """
    try:
        tags = _first_page(data)
        width, height = int(tags[_WIDTH][0]), int(tags[_HEIGHT][0])
    except (struct.error, KeyError, IndexError) as error:
        raise damaged(path, "TIFF", "is cut short or corrupt") from error
    check_pixel_count(path, width, height, file_bytes=len(data))
    _check_not_cut_short(path, data, tags)
    return TiffFacts(
        width=width,
        height=height,
        bits=_first(tags, _BITS, 1),
        number={2: "int", 3: "float"}.get(_first(tags, _FORMAT, 1), "uint"),
        samples=_first(tags, _SAMPLES, 1),
        orientation=_first(tags, _ORIENTATION, 1),
        description=bytes(tags.get(_DESCRIPTION, ())).decode("utf-8", "replace").rstrip("\0"),
    )


def _first_page(data: bytes) -> dict[int, tuple[int, ...]]:
    order = "<" if data[:2] == b"II" else ">"
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    end = start + 2 + 12 * count
    struct.unpack_from(order + "I", data, end)  # where the next page is: the list is complete
    tags: dict[int, tuple[int, ...]] = {}
    for entry in range(start + 2, end, 12):
        tag, kind, number = struct.unpack_from(order + "HHI", data, entry)
        if kind not in _SIZE:
            continue
        where = entry + 8
        if number * _SIZE[kind] > 4:
            (where,) = struct.unpack_from(order + "I", data, where)
        if where + number * _SIZE[kind] > len(data):
            raise struct.error("a tag points outside the file")
        letter = {_ASCII: "B", _SHORT: "H", _LONG: "I"}[kind]
        tags[tag] = struct.unpack_from(f"{order}{number}{letter}", data, where)
    return tags


def _first(tags: dict[int, tuple[int, ...]], tag: int, default: int) -> int:
    return (tags.get(tag) or (default,))[0]


def _check_not_cut_short(path: Path, data: bytes, tags: dict[int, tuple[int, ...]]) -> None:
    """Raises if the file ends before its last strip or tile, or lists none."""
    for offsets_tag, counts_tag in _BLOCK_TAGS:
        offsets, counts = tags.get(offsets_tag, ()), tags.get(counts_tag, ())
        if offsets and len(offsets) == len(counts):
            needed = max(a + b for a, b in zip(offsets, counts, strict=True))
            if needed > len(data):
                raise damaged(path, "TIFF", f"is cut short: {len(data):,} of {needed:,} bytes")
            return
    raise damaged(path, "TIFF", "does not say where its pixels are")


def _read(path: Path, data: bytes, channel: str | None) -> StoredArray:
    facts = read_tiff_facts(path, data)
    if facts.samples != 1:
        raise FileFormatError(
            f"{path} is a TIFF with {facts.samples} channels; depth is one channel, save it so"
        )
    if (facts.number, facts.bits) not in (("uint", 16), ("float", 32), ("float", 64)):
        if facts.bits <= 8:
            raise eight_bits(path, "TIFF")
        raise FileFormatError(
            f"{path} is a {facts.bits}-bit {facts.number} TIFF; save depth as float32 or uint16"
        )
    values = decode_with_opencv(path, data, "TIFF")
    if values.ndim != 2 or values.dtype.itemsize * 8 != facts.bits:
        raise damaged(path, "TIFF", "cannot be decoded as one channel")
    description = f"{facts.bits}-bit {'float ' if facts.number == 'float' else ''}TIFF"
    scale = scale_in_text(path, facts.description)
    return StoredArray(values=values, description=description, scale=scale)


def _write(file: Path, metres: NDArray[np.float32], options: WriteOptions) -> None:
    from PIL import Image

    Image.fromarray(metres).save(file, "TIFF", compression="tiff_adobe_deflate")


FORMAT = DepthFormat(
    name="TIFF",
    suffixes=(".tif", ".tiff"),
    magic=(b"II*\x00", b"MM\x00*"),
    read=_read,
    write=_write,
)
