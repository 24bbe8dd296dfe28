"""Writes OpenEXR files."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenEXR

TILED, DEEP, PARTS = 0x200, 0x800, 0x1000


def write_exr(path: Path, channels: dict[str, np.ndarray], **header: object) -> None:
    """Writes a file with these channels; `header` adds or replaces attributes."""
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(attributes, {k: OpenEXR.Channel(v) for k, v in channels.items()}) as file:
        file.write(str(path))


def exr_attribute(name: str, kind: str, value: bytes) -> bytes:
    """Returns an attribute of a header."""
    return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value


def exr_header(
    window: Sequence[int],
    *,
    display: Sequence[int] | None = None,
    names: Sequence[str] = ("Z",),
    more: bytes = b"",
    sampling: int = 1,
) -> bytes:
    """Returns the header of a part of uncompressed float32 channels; `more` are attributes."""
    entry = struct.pack("<iB3x2i", 2, 0, sampling, sampling)
    listed = b"".join(name.encode() + b"\0" + entry for name in names) + b"\0"
    return b"".join(
        (
            exr_attribute("channels", "chlist", listed),
            exr_attribute("compression", "compression", bytes(1)),
            exr_attribute("dataWindow", "box2i", struct.pack("<4i", *window)),
            exr_attribute("displayWindow", "box2i", struct.pack("<4i", *(display or window))),
            exr_attribute("lineOrder", "lineOrder", bytes(1)),
            exr_attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
            exr_attribute("screenWindowCenter", "v2f", bytes(8)),
            exr_attribute("screenWindowWidth", "float", struct.pack("<f", 1)),
            more + b"\0",
        )
    )


def exr_file(header: bytes, chunks: Sequence[bytes] = (), flags: int = 0) -> bytes:
    """Returns a file: its start, header, table of offsets, and chunks."""
    start = struct.pack("<2i", 20000630, 2 | flags) + header
    at, offsets = len(start) + 8 * len(chunks), []
    for chunk in chunks:
        offsets.append(at)
        at += len(chunk)
    return start + struct.pack(f"<{len(offsets)}Q", *offsets) + b"".join(chunks)


def exr_line(y: int, values: int) -> bytes:
    """Returns a chunk: one row of that many values of 2."""
    return struct.pack("<2i", y, 4 * values) + np.full(values, 2, "<f4").tobytes()
