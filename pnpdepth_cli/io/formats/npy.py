"""NPY: one array of numbers; the header is checked before memory is allocated."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import check_value_count, damaged
from pnpdepth_cli.io.formats import DepthFormat, StoredArray

LONGEST_HEADER = 1 << 14
_DTYPE = re.compile(r"['\"]descr['\"]\s*:\s*['\"]([^'\"]{1,20})['\"]")
_FORTRAN = re.compile(r"['\"]fortran_order['\"]\s*:\s*(True|False)\b")
_SHAPE = re.compile(r"['\"]shape['\"]\s*:\s*\(\s*((?:\d{1,18}\s*,\s*)*(?:\d{1,18}\s*)?)\)")
"""The fields of a header. NumPy evaluates it as Python, and threads of CPython 3.11 that do so at
once raise SystemError for a good file."""


def parse_npy(path: Path, data: bytes, kind: str = "NPY") -> NDArray[Any]:
    """Returns the array of an NPY file, of any shape; numbers only, never pickled objects.

    Messages name `path` and `kind`. Raises FileFormatError if it is damaged or holds no numbers.
    """
    shape, order, dtype, start = read_npy_header(path, data, kind)
    count = math.prod(shape)
    if len(data) - start < count * dtype.itemsize:
        fact = f"{len(data) - start:,} bytes of data instead of {count * dtype.itemsize:,}"
        raise damaged(path, kind, f"cannot be read ({fact})")
    return np.frombuffer(data, dtype, count=count, offset=start).reshape(shape, order=order)


def read_npy_header(
    path: Path, data: bytes, kind: str = "NPY"
) -> tuple[tuple[int, ...], Any, np.dtype[Any], int]:
    """Returns shape, order ("C" or "F"), dtype, and the position of the data, from the beginning.

    Raises FileFormatError if the header is damaged, or its array is not made of numbers.
    """
    length = "<H" if data[6:8] == b"\1\0" else "<I"
    start = 8 + struct.calcsize(length)
    end = start + (struct.unpack_from(length, data, 8)[0] if len(data) >= start else 0)
    text = data[start : min(end, start + LONGEST_HEADER)].decode("latin-1")
    descr, fortran, sides = (field.search(text) for field in (_DTYPE, _FORTRAN, _SHAPE))
    known = data[6:8] in (b"\1\0", b"\2\0") and end <= len(data)
    if not (known and descr and fortran and sides):
        raise damaged(path, kind, "cannot be read (its header is damaged or of another version)")
    if "O" in descr[1]:
        raise FileFormatError(
            f"{path} holds pickled Python objects, which are never loaded; save numbers, with"
            " allow_pickle=False"
        )
    try:
        dtype = np.dtype(descr[1])
    except (TypeError, ValueError, SyntaxError) as error:
        raise damaged(path, kind, f"cannot be read ({error})") from error
    if dtype.kind not in "fiu":
        raise FileFormatError(f"{path} holds {dtype} values; depth is float or integer, save it so")
    shape = tuple(int(length) for length in re.findall(r"\d+", sides[1]))
    return shape, "F" if fortran[1] == "True" else "C", dtype, end


def _read(path: Path, data: bytes, channel: str | None) -> StoredArray:
    array = parse_npy(path, data)
    check_value_count(path, array.size)
    return StoredArray(values=array, description=f"{array.dtype} NPY", is_image=False)


def _write(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    with file.open("wb") as stream:
        np.save(stream, metres)


FORMAT = DepthFormat(
    name="NPY", suffixes=(".npy",), magic=(b"\x93NUMPY",), read=_read, write=_write
)
