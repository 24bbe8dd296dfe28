"""NPY and NPZ: plain number arrays only, never pickled objects."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.file_bytes import damaged

# A fixed time in the archive: the same depth gives the same bytes.
_EPOCH = (1980, 1, 1, 0, 0, 0)


def parse_npy(path: Path, data: bytes) -> NDArray[Any]:
    """The one array of an NPY file, of any shape."""
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as error:  # a damaged file makes numpy raise many kinds
        raise damaged(path, "NPY", f"cannot be read ({error})") from error
    return _numbers(path, array)


def parse_npz(path: Path, data: bytes, key: str | None) -> tuple[str, NDArray[Any]]:
    """The array called `key`, or the only one, with its name."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            keys = list(archive.files)
            name = _choose(path, keys, key)
            array = archive[name]
    except (FileFormatError, UsageError):
        raise
    except Exception as error:  # zipfile, zlib and numpy each have their own
        raise damaged(path, "NPZ", f"cannot be read ({error})") from error
    if not isinstance(array, np.ndarray):
        raise FileFormatError(f"{path}: {name} is not an array; save it with numpy.savez")
    return name, _numbers(path, array)


def npy_bytes(array: NDArray[Any]) -> bytes:
    """An NPY file of the array."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def npz_bytes(name: str, array: NDArray[Any]) -> bytes:
    """A compressed NPZ file with the one array."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        member = zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH)
        member.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(member, npy_bytes(array))
    return buffer.getvalue()


def _choose(path: Path, keys: list[str], key: str | None) -> str:
    listing = ", ".join(keys)
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


def _numbers(path: Path, array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype.kind not in "fiu":
        raise FileFormatError(
            f"{path} holds {array.dtype} values; depth is float or integer, save it so"
        )
    return array
