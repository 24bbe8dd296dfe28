"""NPY, NPZ and PFM: arrays of numbers, whose claimed size is checked before memory is allocated."""

from __future__ import annotations

import io
import lzma
import math
import re
import struct
import sys
import threading
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import check_pixel_count, check_value_count, damaged, one_line
from pnpdepth_cli.io.formats import DepthFile, DepthFormat, Reading

_LONGEST_HEADER = 1 << 14
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_HEADER_ERRORS = (
    *(ValueError, TypeError, LookupError, SyntaxError, ArithmeticError, EOFError, struct.error),
    *(tokenize.TokenError, RecursionError),
)
"""What NumPy raises as it evaluates a damaged header, or one of another version of the format."""
_ARCHIVE_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, OSError, EOFError),
    *(ValueError, LookupError, OverflowError),
    RuntimeError,  # encrypted, or of another version
)
"""What zipfile raises on damaged archives."""
_MOST_AXES = 32
"""Most axes of an array of NumPy 1."""
_LOCK = threading.Lock()
"""NumPy evaluates a header as Python, and threads of CPython 3.11 that do so at once may fail."""


def parse_npy(path: Path, data: bytes, kind: str = "NPY") -> NDArray[Any]:
    """Returns the array of an NPY file, of any shape; numbers only, never pickled objects.

    Messages name `path` and `kind`. Raises FileFormatError if it is damaged or holds no numbers.
    """
    shape, order, dtype, start = _npy_header(path, data, kind)
    count = math.prod(shape)
    if len(data) - start < count * dtype.itemsize:
        fact = f"{len(data) - start:,} bytes of data instead of {count * dtype.itemsize:,}"
        raise damaged(path, kind, f"cannot be read ({fact})")
    return np.frombuffer(data, dtype, count=count, offset=start).reshape(shape, order=order)


def _npy_header(
    path: Path, data: bytes, kind: str
) -> tuple[tuple[int, ...], Any, np.dtype[Any], int]:
    """Shape, order ("C" or "F"), dtype, and the position of the data, of numbers alone."""
    stream = io.BytesIO(data)
    try:
        with _LOCK:
            shape, is_fortran, dtype = _HEADERS[npy.read_magic(stream)](stream)
        if min(shape, default=0) < 0 or any(isinstance(side, bool) for side in shape):
            raise ValueError(f"a shape of {shape}")
        if len(shape) > _MOST_AXES or max(shape, default=0) > sys.maxsize:
            raise ValueError("a shape that no array has")
    except _HEADER_ERRORS as error:
        raise damaged(path, kind, f"cannot be read ({type(error).__name__}: {error})") from error
    if dtype.hasobject:
        raise FileFormatError(f"{path} holds pickled objects; save numbers with allow_pickle=False")
    if dtype.kind not in "fiu":
        raise FileFormatError(f"{path} holds {dtype} values; depth is float or integer, save it so")
    return shape, "F" if is_fortran else "C", dtype, stream.tell()


def _read_npy(path: Path, data: bytes) -> DepthFile:
    array = parse_npy(path, data)
    check_value_count(path, array.size)
    return DepthFile(values=array, reading=Reading(f"{array.dtype} NPY"), is_image=False)


def _write_npy(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    with file.open("wb") as stream:
        np.save(stream, metres)


NPY = DepthFormat(
    name="NPY", suffixes=(".npy",), magic=(b"\x93NUMPY",), read=_read_npy, write=_write_npy
)


COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions that numpy writes. Python decompresses bz2 and LZMA without a bound on memory."""


def _read_npz(path: Path, data: bytes) -> DepthFile:
    """The only array of an archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if len(members) != 1:
                listing = one_line(", ".join(members)) or "none"
                raise FileFormatError(f"{path} holds several arrays or none ({listing}); save one")
            (name,) = members
            if members[name].compress_type not in COMPRESSIONS:
                raise FileFormatError(f"{path} is compressed; save it by numpy.savez_compressed")
            with archive.open(members[name]) as member:
                array = _array(path, name, member, len(data))
    except _ARCHIVE_ERRORS as error:
        raise damaged(path, "NPZ", f"cannot be read ({error})") from error
    reading = Reading(f"{array.dtype} NPZ array {name}")
    return DepthFile(values=array, reading=reading, is_image=False)


def _array(path: Path, name: str, member: IO[bytes], file_bytes: int) -> NDArray[Any]:
    """The array of a member, after its claimed size is checked."""
    beginning = member.read(_LONGEST_HEADER)
    if not beginning.startswith(b"\x93NUMPY"):
        raise FileFormatError(f"{path}: {name} is not an array; save it with numpy.savez")
    shape, _, dtype, start = _npy_header(path, beginning, "NPZ")
    check_value_count(path, math.prod(shape), file_bytes, value_bytes=dtype.itemsize)
    needed = start + math.prod(shape) * dtype.itemsize
    content = beginning + member.read(max(0, needed - len(beginning)))
    member.read(1)  # at the end of the member, its checksum is compared
    return parse_npy(path, content, "NPZ")


def _write_npz(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    with file.open("wb") as stream:
        np.savez_compressed(stream, depth=metres)  # all members have the time 1980-01-01


NPZ = DepthFormat(
    name="NPZ",
    suffixes=(".npz",),
    magic=(b"PK\x03\x04", b"PK\x05\x06"),  # the second is an archive without any array
    read=_read_npz,
    write=_write_npz,
)


_PFM_HEADER = re.compile(rb"(Pf|PF)\s+(\d{1,9})\s+(\d{1,9})\s+([-+0-9.eE]{1,40})[ \t]*\r?\n")


def _read_pfm(path: Path, data: bytes) -> DepthFile:
    """Rows are stored from the bottom; the sign of the scale factor gives the byte order."""
    match = _PFM_HEADER.match(data)
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
    unused = "" if abs(factor) == 1 else f", scale factor {abs(factor):g} of its header not applied"
    values = np.ascontiguousarray(values[::-1], dtype=np.float32)
    return DepthFile(values=values, reading=Reading(f"PFM{unused}"))


def _write_pfm(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    height, width = metres.shape
    header = f"Pf\n{width} {height}\n-1.0\n".encode()  # little-endian
    file.write_bytes(header + metres[::-1].astype("<f4").tobytes())


PFM = DepthFormat(
    name="PFM", suffixes=(".pfm",), magic=(b"Pf", b"PF"), read=_read_pfm, write=_write_pfm
)
