"""PFM (portable float map), one channel: rows from bottom to top, either byte order."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged
from pnpdepth_cli.io.formats import DepthFormat, StoredArray

_HEADER = re.compile(rb"(Pf|PF)\s+(\d{1,9})\s+(\d{1,9})\s+([-+0-9.eE]{1,40})[ \t]*\r?\n")


def parse_pfm(path: Path, data: bytes) -> tuple[NDArray[np.float32], float]:
    """Returns the (H, W) values, top row first, and the header's scale factor without its sign.

    The sign gives the byte order: negative is little-endian.

    Raises:
        FileFormatError: The content is damaged, in colour, or has too many pixels.
    """
    match = _HEADER.match(data)
    if match is None:
        raise damaged(path, "PFM", "has no valid header")
    if match[1] == b"PF":
        raise FileFormatError(f"{path} is a colour PFM; depth is one channel (Pf), save it so")
    width, height = int(match[2]), int(match[3])
    check_pixel_count(path, width, height)
    try:
        factor = float(match[4])
    except ValueError as error:
        raise damaged(path, "PFM", "has no valid scale factor") from error
    if not math.isfinite(factor) or factor == 0:
        raise damaged(path, "PFM", f"has the scale factor {factor:g}")
    body = data[match.end() :]
    if len(body) != 4 * width * height:
        fact = f"holds {len(body):,} bytes where {width}x{height} needs {4 * width * height:,}"
        raise damaged(path, "PFM", fact)
    values = np.frombuffer(body, "<f4" if factor < 0 else ">f4").reshape(height, width)
    return np.ascontiguousarray(values[::-1], dtype=np.float32), abs(factor)


def _read(path: Path, data: bytes, channel: str | None) -> StoredArray:
    values, factor = parse_pfm(path, data)
    unused = "" if factor == 1 else f", scale factor {factor:g} of its header not applied"
    return StoredArray(values=values, description=f"PFM{unused}")


def _write(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    height, width = metres.shape
    header = f"Pf\n{width} {height}\n-1.0\n".encode()  # little-endian
    file.write_bytes(header + metres[::-1].astype("<f4").tobytes())


FORMAT = DepthFormat(name="PFM", suffixes=(".pfm",), magic=(b"Pf", b"PF"), read=_read, write=_write)
