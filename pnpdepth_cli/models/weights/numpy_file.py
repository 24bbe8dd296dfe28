"""The named arrays of a numpy file as tensors; nothing in it is run.

A .npz holds arrays by name. A .npy may hold a pickled dict of arrays, or of dicts of arrays, as
converters from Caffe write it; numpy would run that pickle, `pickle_reader` reads it without a
call. Memory stays bounded by the size of the file.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.pickle_reader import (
    READ_ERRORS,
    BrokenFileError,
    PickleReader,
    StandIn,
    brief,
)

SUFFIXES = (".npy", ".npz")

_NUMBERS = frozenset({"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "b1"})
_RECONSTRUCT = (
    "numpy.core.multiarray._reconstruct",
    "numpy._core.multiarray._reconstruct",
)
_ENCODED = ("_codecs.encode", "__builtin__.bytes")
_MAX_DEPTH = 3  # dicts inside each other
_MAX_ENTRIES = 10_000
_MAX_AXES = 64
_MAX_INFLATION = 4  # a compressed archive of weights is hardly smaller than they are
_CHUNK = 1 << 20  # bytes that are inflated at once


def read_numpy_file(path: Path) -> dict[str, Tensor]:
    """Returns the arrays of a .npz by name, or of a .npy by "layer.name".

    The arrays keep their type and their order of axes.

    Raises:
        CheckpointError: The file is broken or holds no named arrays.
    """
    try:
        if zipfile.is_zipfile(path):
            return _read_archive(path)
        with path.open("rb") as file:
            return _read_pickled_dict(file, path.stat().st_size)
    except (BrokenFileError, zipfile.BadZipFile, OSError, *READ_ERRORS) as error:
        reason = brief(error)
    raise CheckpointError(f"checkpoint {path} cannot be read as a numpy file ({reason})")


def _read_archive(path: Path) -> dict[str, Tensor]:
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        limit = _MAX_INFLATION * path.stat().st_size + _CHUNK
        if sum(info.file_size for info in entries) > limit or len(entries) > _MAX_ENTRIES:
            raise BrokenFileError("its arrays are far larger than the file")
        return {
            # TensorFlow writes the number of an operation's output behind its name
            info.filename.removesuffix(".npy").removesuffix(":0"): _plain_array(
                _inflated(archive, info), info.filename
            )
            for info in entries
        }


def _inflated(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """The bytes of an entry, inflated in chunks, no more of them than the directory says."""
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise BrokenFileError(f"{info.filename[:60]} is compressed as numpy never does")
    content = bytearray()
    with archive.open(info) as file:
        while chunk := file.read(_CHUNK):
            content += chunk
    if len(content) != info.file_size:
        raise BrokenFileError(f"{info.filename[:60]} is not of the size that the directory says")
    return bytes(content)


def _plain_array(content: bytes, name: str) -> Tensor:
    file = io.BytesIO(content)
    shape, fortran, dtype = _header(file)
    if dtype.hasobject:
        raise BrokenFileError(f"{name} holds objects, not numbers")
    return _tensor(content[file.tell() :], dtype.str, shape, fortran, name)


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in Fortran order, and type; afterwards the file stands behind the header."""
    try:
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        return read[npy.read_magic(file)](file)
    except Exception as error:  # numpy passes on whatever Python's parser raises
        raise BrokenFileError(
            f"its header makes no sense, {type(error).__name__}: {error}"
        ) from None


def _read_pickled_dict(file: IO[bytes], size: int) -> dict[str, Tensor]:
    shape, _, dtype = _header(file)
    if not dtype.hasobject or shape != ():
        raise BrokenFileError(f"it holds one array of shape {shape}, not named arrays")
    array = PickleReader(file, _no_storage, max_bytes=size).read_object()
    objects = array.built[4] if _is_array(array) else None
    if not (isinstance(objects, list) and len(objects) == 1 and isinstance(objects[0], Mapping)):
        raise BrokenFileError("it holds no dict of arrays")
    return _Arrays(size).named(objects[0])


def _no_storage(_: Any) -> Tensor:
    raise BrokenFileError("its pickle refers to something outside it")


def _is_array(value: Any) -> bool:
    """True for a stand-in of a numpy array, built with (version, shape, type, order, data)."""
    is_array = isinstance(value, StandIn) and value.path in _RECONSTRUCT
    return is_array and isinstance(value.built, tuple) and len(value.built) == 5


class _Arrays:
    """Makes tensors from the arrays of a pickled dict; together no larger than the file."""

    def __init__(self, size: int) -> None:
        self._left, self._entries = size, _MAX_ENTRIES
        self._tensors: dict[int, Tensor] = {}

    def named(self, content: Mapping[Any, Any]) -> dict[str, Tensor]:
        """Returns every array of the dict and of the dicts in it; "." joins the keys."""
        return dict(self._walk(content, "", _MAX_DEPTH))

    def _walk(
        self, content: Mapping[Any, Any], prefix: str, levels_left: int
    ) -> Iterator[tuple[str, Tensor]]:
        for key, value in content.items():
            name = f"{prefix}{key}"
            self._entries -= 1
            if self._entries < 0 or (isinstance(value, Mapping) and levels_left == 1):
                raise BrokenFileError(
                    "its dicts are larger or nested deeper than the layers of any network"
                )
            if isinstance(value, Mapping):
                yield from self._walk(value, f"{name}.", levels_left - 1)
            else:
                yield name, self._array(value, name)

    def _array(self, value: Any, name: str) -> Tensor:
        if not _is_array(value):
            kind = value.path if isinstance(value, StandIn) else type(value).__name__
            raise BrokenFileError(f"{name} is no array but a {kind}")
        if id(value) not in self._tensors:
            _, shape, dtype, fortran, data = value.built
            if not isinstance(shape, tuple) or len(shape) > _MAX_AXES:
                raise BrokenFileError(f"{name} is an array without a shape")
            content = _bytes(data, name)
            self._left -= len(content)
            if self._left < 0:
                raise BrokenFileError("its arrays are larger than the file")
            sizes = tuple(map(int, shape))
            self._tensors[id(value)] = _tensor(content, _type(dtype), sizes, bool(fortran), name)
        return self._tensors[id(value)]


def _bytes(data: Any, name: str) -> bytes:
    """An array's data; Python 2 pickles bytes as text, Python 3's old protocols as encoded text."""
    if isinstance(data, StandIn) and data.path in _ENCODED:
        data = data.arguments[0] if data.arguments else b""
    if isinstance(data, str):
        return data.encode("latin-1")
    if not isinstance(data, bytes):
        raise BrokenFileError(f"{name} holds objects, not numbers")
    return data


def _type(dtype: Any) -> str:
    """The code of a pickled numpy.dtype, such as "<f4"."""
    if not isinstance(dtype, StandIn) or dtype.path != "numpy.dtype" or not dtype.arguments:
        raise BrokenFileError("an array without a type")
    order = dtype.built[1] if isinstance(dtype.built, tuple) and len(dtype.built) > 1 else "|"
    code = dtype.arguments[0]
    if not isinstance(order, str) or not isinstance(code, str):
        raise BrokenFileError("an array without a type")
    return f"{order[:1]}{code[:8]}"


def _tensor(content: bytes, code: str, shape: tuple[int, ...], fortran: bool, name: str) -> Tensor:
    """The tensor of an array's bytes, copied to native byte order; `code` is such as "<f4"."""
    if code[:1] not in ("<", ">", "|", "=") or code[1:] not in _NUMBERS:
        raise BrokenFileError(f"{name} is an array of {code}, not of numbers")
    dtype = np.dtype(code)
    if any(n < 0 for n in shape) or math.prod(shape) * dtype.itemsize != len(content):
        raise BrokenFileError(f"{name} of shape {shape} does not have its {len(content)} bytes")
    flat = np.frombuffer(content, dtype)
    array: NDArray[Any] = flat.reshape(shape, order="F" if fortran else "C")
    native = array.astype(dtype.newbyteorder("="), order="C")
    return torch.from_numpy(native)
