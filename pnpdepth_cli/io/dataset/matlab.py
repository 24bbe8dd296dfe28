"""An array of whole numbers in a MATLAB 5 file.

Own reader, because scipy's aborts the process on about one in a thousand damaged files.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import damaged, read_bytes

_HEADER_BYTES = 128
_TYPES = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_MATRIX, _COMPRESSED = 14, 15
_MOST_BYTES = 1 << 20
"""Of a decompressed variable."""


def read_matlab_array(path: Path, name: str) -> NDArray[np.int64]:
    """Returns the values of a variable as (N,) int64, in the order of the file.

    Source: MAT-File Format, MathWorks, chapter "Level 5 MAT-File Format".

    Raises:
        FileFormatError: The file is damaged or not of versions 5 to 7, or lacks the variable.
    """
    data = read_bytes(path)
    order = {b"IM": "<", b"MI": ">"}.get(data[126:_HEADER_BYTES])
    if order is None:
        raise FileFormatError(f"{path} is no MATLAB 5 file; save it with -v7 or older")
    try:
        for kind, content in _elements(data, _HEADER_BYTES, order):
            if kind == _COMPRESSED:
                content = zlib.decompressobj().decompress(content, _MOST_BYTES)
                kind, content = next(_elements(content, 0, order))
            values = _numbers(content, name, order) if kind == _MATRIX else None
            if values is not None:
                return values
    except (struct.error, zlib.error, StopIteration, ValueError, OverflowError) as error:
        raise damaged(path, "MATLAB file", f"cannot be read ({error})") from error
    raise FileFormatError(f"{path} has no {name}; it is of another kind")


def _elements(data: bytes, position: int, order: str) -> Iterator[tuple[int, bytes]]:
    """The type and the content of each element; short ones have both in one word."""
    while position < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, position)
        if kind >> 16:
            kind, size, begin, end = kind & 0xFFFF, kind >> 16, position + 4, position + 8
        else:
            begin = position + 8
            end = begin + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if begin + size > len(data):
            raise ValueError(f"an element of {size:,} bytes goes beyond the end")
        yield kind, data[begin : begin + size]
        position = end


def _numbers(matrix: bytes, name: str, order: str) -> NDArray[np.int64] | None:
    """The values of a variable of this name; None for another."""
    _, _, (_, variable), (kind, content) = list(_elements(matrix, 0, order))[:4]
    if variable.decode("ascii", "replace") != name:
        return None
    if kind not in _TYPES:
        raise ValueError(f"{name} is not made of numbers")
    values = np.frombuffer(content, order + _TYPES[kind])
    if not (np.isfinite(values) & (np.abs(values) < 2.0**53) & (values == np.rint(values))).all():
        raise ValueError(f"{name} is not made of whole numbers")
    return values.astype(np.int64)
