"""What a depth file format is, and the plain arrays NPY, NPZ and PFM.

`pnpdepth_cli.choices.FORMATS` has all. What a file claims is checked before memory is taken.
"""

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
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pnpdepth_cli.budget import check_claim, max_image_bytes
from pnpdepth_cli.choices import FORMATS
from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.io.file_bytes import check_pixel_count, check_value_count, damaged, one_line

KITTI_SCALE = 256.0
"""Codes per metre in the KITTI depth files, assumed for integers that do not say their own."""

SCALE_KEY = "pnpdepth:scale"
"""Key under which our own 16-bit files keep their codes per metre."""

SATURATED_CODE = 65535
"""The largest 16-bit code: what a sensor gives beyond its range, so never a measurement."""

LARGEST_CODE = SATURATED_CODE - 1
"""The largest code that is written."""

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_HEADER_ERRORS = (
    ValueError,
    TypeError,
    LookupError,
    SyntaxError,
    ArithmeticError,
    EOFError,
    struct.error,
    tokenize.TokenError,
    RecursionError,
)
"""What NumPy raises as it evaluates a damaged header, or one of another version of the format."""
_ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    LookupError,
    OverflowError,
    RuntimeError,  # if encrypted, or of another version
)
"""What zipfile raises on damaged archives."""
_MOST_AXES = 32  # of an array of NumPy 1
_LOCK = threading.Lock()
"""NumPy evaluates a header as Python, and threads of CPython 3.11 that do so at once may fail."""
_PFM_VALUE_BYTES = 4  # a float32


class Reading(NamedTuple):
    """How depth was read from a file, or made."""

    source: str  # in words, such as "16-bit PNG ÷ 256"
    scale: float | None = None  # codes per metre; None for floats
    assumed: bool = False
    """Whether the scale is assumed, as neither the file nor the user nor the data set states it."""

    def __str__(self) -> str:
        """How depth was read, for a person."""
        return f"{self.source}, assumed" if self.assumed else self.source


@dataclass(frozen=True, kw_only=True)
class DepthFile:
    """The numbers of a depth file: as stored, from a format; float32 metres, from `read_depth`."""

    values: NDArray[Any]
    """(H, W). As stored, floats in metres or integer codes, of any shape that `is_image` allows."""
    reading: Reading
    """How the file was read; of stored values, the scale is the one that the file itself states."""
    is_image: bool = True  # false for NPY and NPZ, whose arrays may also be lists of points
    header: tuple[str, ...] | None = None
    """Words of the header of a text, none without a header. None: the file is no text."""


@dataclass(frozen=True, kw_only=True)
class DepthFormat:
    """One file format of depth images."""

    name: str  # as messages call it, such as "PNG"
    suffixes: tuple[str, ...]
    """Suffixes of its files in lower case; "." and the name in `choices.FORMATS` is one of them."""
    magic: tuple[bytes, ...]
    """What the content begins with; files are recognised by content, never by suffix."""
    read: Callable[[Path, bytes], DepthFile]
    """Reader of path (for messages) and content. Raises InputError."""
    write: Callable[[Path, NDArray[Any], Mapping[str, str]], None]
    """(H, W) float32 metres or uint16 codes, 0 where unknown, into an existing empty file, with
    texts by key where the format has room for them."""
    integer: bool = False  # whether files hold 16-bit integer codes, not float32 metres


def format_of_content(data: bytes) -> DepthFormat | None:
    """Returns the format whose magic the content begins with; None for another kind of file."""
    return next((kind for kind in FORMATS.values() if data.startswith(kind.magic)), None)


def format_of_suffix(path: Path) -> DepthFormat:
    """Returns the format that is written for the suffix of a path, in upper or lower case.

    Raises:
        OutputError: No format of depth has the suffix.
    """
    by_suffix: dict[str, DepthFormat] = {
        suffix: depth_format
        for depth_format in FORMATS.values()
        for suffix in depth_format.suffixes
    }
    if path.suffix.lower() not in by_suffix:
        raise OutputError(f"{path}: the suffix for depth is one of {', '.join(by_suffix)}")
    return by_suffix[path.suffix.lower()]


def kind_of(data: bytes) -> str | None:
    """Returns the name of a file's format by its content; None for an unknown one.

    It is "JPEG", "WEBP", or the name of a depth format, such as "PNG".

    Args:
        data: Content of the file, or at least its first 16 bytes.
    """
    if data.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":  # the size is in between
        return "WEBP"
    depth_format = format_of_content(data)
    return None if depth_format is None else depth_format.name


def no_depth(path: Path, what: str) -> InputError:
    """Returns the error for an image whose pixels cannot hold depth.

    Args:
        path: The file.
        what: What it is, such as "an 8-bit PNG".
    """
    way_out = "give the 16-bit PNG, EXR or NPY that it is an image of"
    return InputError(f"{path} is {what}, which cannot hold depth; {way_out}")


def check_scale(scale: float | None) -> None:
    """Raises UsageError unless the scale is None or a finite number above 0."""
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise UsageError(f"--depth-scale must be a finite number above 0, not {scale:g}")


class _Header(NamedTuple):
    """What an NPY file says of its array."""

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype[Any]


def _parse_header(path: Path, stream: io.BytesIO, kind: str) -> _Header:
    """What the header at the stream's position says; the stream is after the header then.

    Args:
        path: The file, for messages.
        stream: An NPY file at its beginning.
        kind: Name of the file's format, for messages.

    Raises:
        InputError: The header is damaged.
    """
    try:
        version = npy.read_magic(stream)
        read_header = _HEADERS[version]
        with _LOCK:  # NumPy evaluates the header as Python, which threads must not do at once
            shape, is_fortran, dtype = read_header(stream)
        has_sizes = all(type(side) is int and 0 <= side <= sys.maxsize for side in shape)
        if not has_sizes or len(shape) > _MOST_AXES:
            raise ValueError(f"a shape of {shape}")
    except _HEADER_ERRORS as error:
        raise damaged(path, kind, f"cannot be read ({type(error).__name__}: {error})") from error
    return _Header(shape, is_fortran, dtype)


def parse_npy(path: Path, data: bytes, kind: str = "NPY") -> NDArray[np.generic]:
    """Returns the array of an NPY file, of any shape.

    Args:
        path: The file, for messages.
        data: Content of the NPY file.
        kind: Name of the format of `path`, for messages.

    Raises:
        InputError: The content is damaged, or holds pickled objects or other values that are no
            numbers.
    """
    # The header.
    stream = io.BytesIO(data)
    shape, is_fortran, dtype = _parse_header(path, stream, kind)
    if dtype.hasobject:
        raise InputError(f"{path} holds pickled objects; save numbers with allow_pickle=False")
    if dtype.kind not in "fiub":  # floats, integers with and without sign, and truth values
        raise InputError(f"{path} holds {dtype} values; save numbers")
    # The numbers that it claims.
    count = math.prod(shape)
    start = stream.tell()
    check_value_count(path, count, value_bytes=dtype.itemsize)
    available_bytes = len(data) - start
    needed_bytes = count * dtype.itemsize
    if available_bytes < needed_bytes:
        raise damaged(
            path,
            kind,
            f"cannot be read ({available_bytes:,} bytes of data instead of {needed_bytes:,})",
        )
    array = np.frombuffer(data, dtype, count=count, offset=start)
    return array.reshape(shape, order="F" if is_fortran else "C")


def read_npy(path: Path, data: bytes) -> DepthFile:
    """Returns the array of an NPY file, of any shape.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: As `parse_npy` has it.
    """
    array = parse_npy(path, data)
    return DepthFile(values=array, reading=Reading(f"{array.dtype} NPY"), is_image=False)


def write_npy(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes an NPY file.

    Args:
        file: The file, which is replaced.
        metres: (H, W) depth, 0 where unknown.
        text: Texts by their keys, which the file does not keep.

    Raises:
        OSError: The file cannot be written.
    """
    with file.open("wb") as stream:
        np.save(stream, metres)


_OF_ARRAY = ".npy"  # suffix of an archive's members
_MOST_ARRAYS = 1000  # of an archive; a network's has ten
_LONGEST_HEADER = 1 << 16  # bytes of an array's header, which mostly has 128

COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions that numpy writes. Python decompresses bz2 and LZMA without a bound on memory."""


def read_npz(path: Path, data: bytes) -> DepthFile:
    """Returns the only array of an NPZ archive, of any shape.

    Args:
        path: The archive, for messages.
        data: Content of the archive.

    Raises:
        InputError: The archive is damaged or beyond the budget, or has no or several arrays, or one
            whose name says that it is no depth.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) != 1:
                listing = one_line(", ".join(member.filename for member in members)) or "none"
                raise InputError(f"{path} holds several arrays or none ({listing}); save one")
            (member,) = members
            array = _parse_member(path, archive, member)
    except _ARCHIVE_ERRORS as error:
        raise damaged(path, "NPZ", f"cannot be read ({error})") from error
    # An array that its own name calls something else is not taken for depth.
    name = member.filename.removesuffix(_OF_ARRAY)
    match = _NO_DEPTH.search(name.lower())
    if match is not None:
        raise InputError(
            f"{path} holds the array {name!r}, which is {match[0]} and no depth by its name;"
            " save depth as `depth`, or give an NPY file with --sparse-kind if it is disparity"
        )
    reading = Reading(f"{array.dtype} NPZ array {name}")
    return DepthFile(values=array, reading=reading, is_image=False)


def _parse_member(
    path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo
) -> NDArray[np.generic]:
    """The array of one member of an NPZ archive, of any shape.

    Args:
        path: The archive, for messages.
        archive: The archive, which is open.
        member: Entry of the array in it.

    Raises:
        InputError: The member is compressed by a method that NumPy does not use, is beyond the
            budget, or holds no numbers.
    """
    if member.compress_type not in COMPRESSIONS:
        raise InputError(f"{path} is compressed; save it by numpy.savez_compressed")
    check_claim(
        f"{path} holds {member.file_size:,} bytes",
        member.file_size,
        max_image_bytes(),
        way_out="create it again",
    )
    return parse_npy(path, archive.read(member), "NPZ")


class ArrayKind(NamedTuple):
    """What an archive says of one of its arrays, none of which is decoded."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def list_npz(path: Path, data: bytes) -> dict[str, ArrayKind]:
    """Returns shape and type of each array in an NPZ archive, by the arrays' names.

    Args:
        path: The archive, for messages.
        data: Content of the archive.

    Raises:
        InputError: The archive is damaged, has too many arrays, or has none, as a ZIP of other
            files.
    """
    arrays = dict[str, ArrayKind]()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [
                member for member in archive.infolist() if member.filename.endswith(_OF_ARRAY)
            ]
            claim = f"{path} holds {len(members):,} arrays"
            check_claim(claim, len(members), _MOST_ARRAYS, way_out="save those of this image")
            # Only the header of each array is decompressed.
            for member in members:
                if member.compress_type not in COMPRESSIONS:
                    raise InputError(f"{path} is compressed; save it by numpy.savez_compressed")
                with archive.open(member) as stream:
                    beginning = io.BytesIO(stream.read(_LONGEST_HEADER))
                shape, _, dtype = _parse_header(path, beginning, "NPZ")
                arrays[member.filename.removesuffix(_OF_ARRAY)] = ArrayKind(shape, dtype)
    except _ARCHIVE_ERRORS as error:
        raise damaged(path, "NPZ", f"cannot be read ({error})") from error
    if not arrays:
        raise InputError(f"{path} is an archive without arrays; save one with numpy.savez")
    return arrays


def read_npz_array(path: Path, data: bytes, name: str) -> DepthFile:
    """Returns the array of this name in an NPZ archive, of any shape.

    Args:
        path: The archive, for messages.
        data: Content of the archive.
        name: Name of the array, as `list_npz` has it.

    Raises:
        InputError: The archive is damaged or has no such array, or the array is beyond the budget.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            array = _parse_member(path, archive, archive.getinfo(name + _OF_ARRAY))
    except _ARCHIVE_ERRORS as error:
        raise damaged(path, "NPZ", f"cannot be read ({error})") from error
    reading = Reading(f"{array.dtype} NPZ array {name}")
    return DepthFile(values=array, reading=reading, is_image=False)


def write_npz(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes an NPZ archive of one array, `depth`; equal depth gives equal bytes.

    Args:
        file: The file, which is replaced.
        metres: (H, W) depth, 0 where unknown.
        text: Texts by their keys, which the file does not keep.

    Raises:
        OSError: The file cannot be written.
    """
    with file.open("wb") as stream:
        np.savez_compressed(stream, depth=metres)  # all members have the time 1980-01-01


_NO_DEPTH = re.compile("disp|conf|mask|sigma|uncert|label|normal|flow")
"""Words in names of arrays beside depth."""

_NUMBER = rb"[-+]?\d{0,20}\.?\d{1,20}(?:[eE][-+]?\d{1,2})?"
_PFM_HEADER = re.compile(rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+(" + _NUMBER + rb")[ \t]*\r?\n")


def read_pfm(path: Path, data: bytes) -> DepthFile:
    """Returns the only channel of a PFM, (H, W) float32 as stored.

    The sign of the scale factor in the header gives the byte order. Its amount is not applied, and
    the reading says so.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The header or the size is wrong, or the image is beyond the budget.
    """
    # The header: size and scale factor.
    match = _PFM_HEADER.match(data)
    if match is None or float(match[3]) == 0:
        raise damaged(path, "PFM", "has no valid header of one channel (Pf)")
    width, height = (int(side) for side in (match[1], match[2]))
    factor = float(match[3])
    check_pixel_count(path, width, height)
    # The numbers, from the lowest row on.
    body = data[match.end() :]
    needed_bytes = _PFM_VALUE_BYTES * width * height
    if len(body) != needed_bytes:
        raise damaged(
            path,
            "PFM",
            f"holds {len(body):,} bytes where {width}x{height} needs {needed_bytes:,}",
        )
    stored = np.frombuffer(body, "<f4" if factor < 0 else ">f4").reshape(height, width)
    from_the_top = np.ascontiguousarray(stored[::-1], dtype=np.float32)
    source = "PFM"
    if abs(factor) != 1:
        source += f", scale factor {abs(factor):g} of its header not applied"
    return DepthFile(values=from_the_top, reading=Reading(source))


def write_pfm(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes a PFM of one channel.

    Args:
        file: The file, which is replaced.
        metres: (H, W) depth, 0 where unknown.
        text: Texts by their keys, which the file does not keep.

    Raises:
        OSError: The file cannot be written.
    """
    height, width = metres.shape
    # A negative scale factor means little-endian; rows are stored from the bottom.
    header = f"Pf\n{width} {height}\n-1.0\n".encode()
    file.write_bytes(header + metres[::-1].astype("<f4").tobytes())
