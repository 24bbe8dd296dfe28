"""NPY: one array of numbers; the header is checked before memory is allocated."""

from __future__ import annotations

import io
import math
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import check_value_count, damaged
from pnpdepth_cli.io.formats import DepthFormat, StoredArray, WriteOptions

HEADER_LOCK = threading.Lock()
"""Held while numpy parses a header as Python: CPython 3.11 mixes up the recursion depths of threads
that do so at once, and raises SystemError for a good file."""


def parse_npy(path: Path, data: bytes) -> NDArray[Any]:
    """Returns the array of an NPY file, of any shape; numbers only, never pickled objects.

    Args:
        path: Named in messages.
        data: Content of the file.

    Raises:
        FileFormatError: The content is damaged, too large, or not made of numbers.
    """
    shape, fortran_order, dtype, start = read_npy_header(path, data)
    needed = math.prod(shape) * dtype.itemsize
    if len(data) - start < needed:
        fact = f"cannot be read ({len(data) - start:,} bytes of data instead of {needed:,})"
        raise damaged(path, "NPY", fact)
    values = np.frombuffer(data, dtype, count=math.prod(shape), offset=start)
    return values.reshape(shape, order="F" if fortran_order else "C")


def read_npy_header(
    path: Path, data: bytes, kind: str = "NPY"
) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Returns shape, Fortran order, dtype, and the position of the data.

    Args:
        path: Named in messages.
        data: The beginning of an NPY file, header included.
        kind: The kind of file that messages name.

    Raises:
        FileFormatError: The header is damaged, or its array is too large or not made of numbers.
    """
    stream = io.BytesIO(data)
    try:
        version = npy_format.read_magic(stream)
        with HEADER_LOCK:
            if version == (1, 0):
                shape, fortran_order, dtype = npy_format.read_array_header_1_0(stream)
            elif version == (2, 0):
                shape, fortran_order, dtype = npy_format.read_array_header_2_0(stream)
            else:
                raise ValueError(f"version {version[0]}.{version[1]} of the format")
    except Exception as error:  # numpy parses the header as Python, which raises many kinds
        raise damaged(path, kind, f"cannot be read ({error})") from error
    if dtype.hasobject:
        raise FileFormatError(
            f"{path} holds pickled Python objects, which are never loaded; save numbers, with"
            " allow_pickle=False"
        )
    if dtype.kind not in "fiu":
        raise FileFormatError(f"{path} holds {dtype} values; depth is float or integer, save it so")
    if min(shape, default=0) < 0:
        raise damaged(path, kind, f"cannot be read (its shape is {shape})")
    return shape, fortran_order, dtype, stream.tell()


def npy_bytes(array: NDArray[Any]) -> bytes:
    """Returns an NPY file of the array."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def _read(path: Path, data: bytes, channel: str | None) -> StoredArray:
    array = parse_npy(path, data)
    check_value_count(path, array.size)
    return StoredArray(values=array, description=f"{array.dtype} NPY", is_image=False)


def _write(file: Path, metres: NDArray[np.float32], options: WriteOptions) -> None:
    file.write_bytes(npy_bytes(metres))


FORMAT = DepthFormat(
    name="NPY", suffixes=(".npy",), magic=(b"\x93NUMPY",), read=_read, write=_write
)
