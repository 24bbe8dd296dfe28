"""PNG structure: every chunk checked, so that a file cut short or altered is refused."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged

GREY = 0
RGB = 2
PALETTE = 3


@dataclass(frozen=True, kw_only=True)
class PngFacts:
    """What a PNG says of itself; `text` holds its tEXt chunks."""

    width: int
    height: int
    bit_depth: int
    colour_type: int
    text: dict[str, str]


def read_png_facts(path: Path, data: bytes) -> PngFacts:
    """The header and texts of a PNG of which every chunk is present and unaltered."""
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
    check_pixel_count(path, width, height)
    return PngFacts(
        width=width, height=height, bit_depth=bit_depth, colour_type=colour_type, text=text
    )
