"""NPZ: named arrays of numbers in a ZIP archive, decompressed no further than an array needs."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.file_bytes import check_value_count, damaged, one_line
from pnpdepth_cli.io.formats import DepthFormat, StoredArray
from pnpdepth_cli.io.formats.npy import LONGEST_HEADER, parse_npy, read_npy_header

_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Those that numpy writes. Python decompresses bz2 and LZMA without a bound on memory."""


def parse_npz(path: Path, data: bytes, key: str | None) -> tuple[str, NDArray[Any]]:
    """Returns the name and content of the array called `key`, or of the only one.

    Raises:
        FileFormatError: The archive is damaged or holds no such array of numbers, or sizes in it
            are false or too large.
        UsageError: There is no array `key`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            name = _choose(path, list(members), key)
            if members[name].compress_type not in _COMPRESSIONS:
                raise FileFormatError(
                    f"{path}: array {name} has a compression that numpy does not write;"
                    " save it with numpy.savez_compressed"
                )
            with archive.open(members[name]) as member:
                return name, _array(path, name, member, len(data))
    except (FileFormatError, UsageError):
        raise
    except Exception as error:  # zipfile and zlib each have their own
        raise damaged(path, "NPZ", f"cannot be read ({error})") from error


def _array(path: Path, name: str, member: IO[bytes], file_bytes: int) -> NDArray[Any]:
    """The array of a member, after its claimed size is checked."""
    beginning = member.read(LONGEST_HEADER)
    if not beginning.startswith(b"\x93NUMPY"):
        raise FileFormatError(f"{path}: {name} is not an array; save it with numpy.savez")
    shape, _, dtype, start = read_npy_header(path, beginning, "NPZ")
    check_value_count(path, math.prod(shape), file_bytes, value_bytes=dtype.itemsize)
    needed = start + math.prod(shape) * dtype.itemsize
    content = beginning + member.read(max(0, needed - len(beginning)))
    member.read(1)  # at the end of the member, its checksum is compared
    return parse_npy(path, content, "NPZ")


def _choose(path: Path, keys: list[str], key: str | None) -> str:
    listing = one_line(", ".join(keys))
    if not keys:
        raise FileFormatError(f"{path} holds no array; save one with numpy.savez")
    if key is not None:
        if key not in keys:
            raise UsageError(f"{path} has no array {key!r}; --channel can be one of: {listing}")
        return key
    if len(keys) > 1:
        raise FileFormatError(
            f"{path} holds {len(keys)} arrays ({listing}); choose one with --channel"
        )
    return keys[0]


def _read(path: Path, data: bytes, channel: str | None) -> StoredArray:
    name, array = parse_npz(path, data, channel)
    return StoredArray(values=array, description=f"{array.dtype} NPZ array {name}", is_image=False)


def _write(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    with file.open("wb") as stream:
        np.savez_compressed(stream, depth=metres)  # all members have the time 1980-01-01


FORMAT = DepthFormat(
    name="NPZ",
    suffixes=(".npz",),
    magic=(b"PK\x03\x04", b"PK\x05\x06"),  # the second is an archive without any array
    read=_read,
    write=_write,
)
