"""TIFF structure: what the first page says of itself, and whether all its data is there."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged

_WIDTH, _HEIGHT, _BITS, _DESCRIPTION, _SAMPLES, _FORMAT = 256, 257, 258, 270, 277, 339
_ORIENTATION = 274
_STRIPS = ((273, 279), (324, 325))  # offsets and byte counts, of strips or of tiles
_ASCII, _SHORT, _LONG = 2, 3, 4
_SIZE = {_ASCII: 1, _SHORT: 2, _LONG: 4}


@dataclass(frozen=True, kw_only=True)
class TiffFacts:
    """Of the first page: bits and kind ("uint", "int" or "float") of each of `samples`."""

    width: int
    height: int
    bits: int
    number: str
    samples: int
    orientation: int
    description: str


def read_tiff_facts(path: Path, data: bytes) -> TiffFacts:
    """The facts of the first page of a TIFF whose pixel data lies within the file."""
    try:
        tags = _first_page(data)
        width, height = int(tags[_WIDTH][0]), int(tags[_HEIGHT][0])
    except (struct.error, KeyError, IndexError) as error:
        raise damaged(path, "TIFF", "is cut short or corrupt") from error
    check_pixel_count(path, width, height)
    _check_extent(path, data, tags)
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


def _check_extent(path: Path, data: bytes, tags: dict[int, tuple[int, ...]]) -> None:
    for offsets, counts in _STRIPS:
        if offsets in tags and len(tags[offsets]) == len(tags.get(counts, ())):
            needed = max((a + b for a, b in zip(tags[offsets], tags[counts], strict=True)))
            if needed > len(data):
                raise damaged(path, "TIFF", f"is cut short: {len(data):,} of {needed:,} bytes")
            return
    raise damaged(path, "TIFF", "does not say where its pixels are")
