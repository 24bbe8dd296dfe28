"""NPY, NPZ and PFM: arrays of numbers, whose claimed size is checked before memory is allocated."""

from __future__ import annotations

import io
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

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pnpdepth_cli.budget import check_claim, max_image_bytes
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import check_pixel_count, check_value_count, damaged, one_line
from pnpdepth_cli.io.formats import DepthFile, Reading

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_HEADER_ERRORS = (
    *(ValueError, TypeError, LookupError, SyntaxError, ArithmeticError, EOFError, struct.error),
    *(tokenize.TokenError, RecursionError),
)
"""What NumPy raises as it evaluates a damaged header, or one of another version of the format."""
_ARCHIVE_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError, ValueError, LookupError),
    *(OverflowError, RuntimeError),  # the last if encrypted, or of another version
)
"""What zipfile raises on damaged archives."""
_MOST_AXES = 32  # of an array of NumPy 1
_LOCK = threading.Lock()
"""NumPy evaluates a header as Python, and threads of CPython 3.11 that do so at once may fail."""


def parse_npy(path: Path, data: bytes, kind: str = "NPY") -> NDArray[np.generic]:
    """Returns the array of an NPY file, of any shape; numbers only, never pickled objects.

    Messages name `path` and `kind`. Raises InputError if it is damaged or holds no numbers.
    """
    # The header.
    stream = io.BytesIO(data)
    try:
        with _LOCK:
            shape, is_fortran, dtype = _HEADERS[npy.read_magic(stream)](stream)
        are_sizes = (type(side) is int and 0 <= side <= sys.maxsize for side in shape)
        if len(shape) > _MOST_AXES or not all(are_sizes):
            raise ValueError(f"a shape of {shape}")
    except _HEADER_ERRORS as error:
        raise damaged(path, kind, f"cannot be read ({type(error).__name__}: {error})") from error
    if dtype.hasobject:
        raise InputError(f"{path} holds pickled objects; save numbers with allow_pickle=False")
    if dtype.kind not in "fiub":
        raise InputError(f"{path} holds {dtype} values; save numbers")
    # The numbers that it claims.
    count, start = math.prod(shape), stream.tell()
    check_value_count(path, count, value_bytes=dtype.itemsize)
    if len(data) - start < count * dtype.itemsize:
        fact = f"{len(data) - start:,} bytes of data instead of {count * dtype.itemsize:,}"
        raise damaged(path, kind, f"cannot be read ({fact})")
    array = np.frombuffer(data, dtype, count=count, offset=start)
    return array.reshape(shape, order="F" if is_fortran else "C")


def read_npy(path: Path, data: bytes) -> DepthFile:
    """Returns the array of an NPY file."""
    array = parse_npy(path, data)
    return DepthFile(values=array, reading=Reading(f"{array.dtype} NPY"), is_image=False)


def write_npy(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes depth (H, W) as an NPY file."""
    with file.open("wb") as stream:
        np.save(stream, metres)


COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions that numpy writes. Python decompresses bz2 and LZMA without a bound on memory."""


def read_npz(path: Path, data: bytes) -> DepthFile:
    """Returns the only array of an NPZ archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) != 1:
                listing = one_line(", ".join(each.filename for each in members)) or "none"
                raise InputError(f"{path} holds several arrays or none ({listing}); save one")
            (member,) = members
            if member.compress_type not in COMPRESSIONS:
                raise InputError(f"{path} is compressed; save it by numpy.savez_compressed")
            claim, most = f"{path} holds {member.file_size:,} bytes", max_image_bytes()
            check_claim(claim, member.file_size, most, way_out="create it again")
            array = parse_npy(path, archive.read(member), "NPZ")
    except _ARCHIVE_ERRORS as error:
        raise damaged(path, "NPZ", f"cannot be read ({error})") from error
    name = member.filename.removesuffix(".npy")
    reading = Reading(f"{array.dtype} NPZ array {name}")
    return DepthFile(values=array, reading=reading, is_image=False)


def write_npz(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes depth (H, W) as the array `depth` of an NPZ archive."""
    with file.open("wb") as stream:
        np.savez_compressed(stream, depth=metres)  # all members have the time 1980-01-01


_NUMBER = rb"[-+]?\d{0,20}\.?\d{1,20}(?:[eE][-+]?\d{1,2})?"
_PFM_HEADER = re.compile(rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+(" + _NUMBER + rb")[ \t]*\r?\n")


def read_pfm(path: Path, data: bytes) -> DepthFile:
    """Returns the only channel of a PFM, whose scale factor's sign gives the byte order."""
    match = _PFM_HEADER.match(data)
    if match is None or float(match[3]) == 0:
        raise damaged(path, "PFM", "has no valid header of one channel (Pf)")
    width, height, factor = int(match[1]), int(match[2]), float(match[3])
    check_pixel_count(path, width, height)
    body = data[match.end() :]
    if len(body) != 4 * width * height:
        fact = f"holds {len(body):,} bytes where {width}x{height} needs {4 * width * height:,}"
        raise damaged(path, "PFM", fact)
    values = np.frombuffer(body, "<f4" if factor < 0 else ">f4").reshape(height, width)
    unused = "" if abs(factor) == 1 else f", scale factor {abs(factor):g} of its header not applied"
    values = np.ascontiguousarray(values[::-1], dtype=np.float32)  # stored from the bottom
    return DepthFile(values=values, reading=Reading(f"PFM{unused}"))


def write_pfm(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes depth (H, W) as a PFM of one channel."""
    height, width = metres.shape
    header = f"Pf\n{width} {height}\n-1.0\n".encode()  # little-endian
    file.write_bytes(header + metres[::-1].astype("<f4").tobytes())
