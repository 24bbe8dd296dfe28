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
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.pickle_reader import (
    MAX_AXES,
    READ_ERRORS,
    BrokenFileError,
    PickleReader,
    StandIn,
    brief,
)

SUFFIXES = (".npy", ".npz")

_NUMBERS = frozenset({"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "b1"})
_RECONSTRUCT = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
_ENCODED = ("_codecs.encode", "__builtin__.bytes")
_MAX_DEPTH = 3  # dicts inside each other
_MAX_ENTRIES = 10_000
_MAX_INFLATION = 4  # a compressed archive of weights is hardly smaller than they are
_ALWAYS_ALLOWED = 1 << 20  # bytes


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
    tensors = {}
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        limit = _MAX_INFLATION * path.stat().st_size + _ALWAYS_ALLOWED
        if sum(info.file_size for info in entries) > limit or len(entries) > _MAX_ENTRIES:
            raise BrokenFileError("its arrays are far larger than the file")
        for info in entries:
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise BrokenFileError(f"{info.filename[:60]} is compressed as numpy never does")
            with archive.open(info) as entry:  # reading so many bytes inflates no more than them
                content = entry.read(info.file_size)
            if len(content) != info.file_size:
                raise BrokenFileError(f"{info.filename[:60]} is shorter than its directory says")
            file = io.BytesIO(content)
            shape, fortran, dtype = _header(file)
            if dtype.hasobject:
                raise BrokenFileError(f"{info.filename} holds objects, not numbers")
            # TensorFlow writes the number of an operation's output behind its name
            name = info.filename.removesuffix(".npy").removesuffix(":0")
            tensors[name] = _tensor(file.read(), dtype.str, shape, fortran, info.filename)
    return tensors


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

    def no_storage(_: Any) -> Tensor:
        raise BrokenFileError("its pickle refers to something outside it")

    array = PickleReader(file, no_storage, size).load()
    objects = array.built[4] if _is_array(array) else None
    if not (isinstance(objects, list) and len(objects) == 1 and isinstance(objects[0], Mapping)):
        raise BrokenFileError("it holds no dict of arrays")
    tensors: dict[str, Tensor] = {}
    made: dict[int, Tensor] = {}
    for name, value in _entries(objects[0]):
        if len(tensors) >= _MAX_ENTRIES:
            raise BrokenFileError(f"it has more than {_MAX_ENTRIES:,} arrays")
        if id(value) not in made:
            made[id(value)] = _unpickled(value, name, size)
            size -= made[id(value)].nbytes
        tensors[name] = made[id(value)]
    return tensors


def _is_array(value: Any) -> bool:
    """True for a stand-in of a numpy array, built with (version, shape, type, order, data)."""
    is_array = isinstance(value, StandIn) and value.path in _RECONSTRUCT
    return is_array and isinstance(value.built, tuple) and len(value.built) == 5


def _entries(
    content: Mapping[Any, Any], prefix: str = "", depth: int = 1
) -> Iterator[tuple[str, Any]]:
    """All that lies in the dict and in the dicts in it, by name; "." joins the keys."""
    if depth > _MAX_DEPTH:
        raise BrokenFileError("its dicts are nested deeper than the layers of any network")
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _entries(value, f"{prefix}{key}.", depth + 1)
        else:
            yield f"{prefix}{key}", value


def _unpickled(value: Any, name: str, most: int) -> Tensor:
    """The tensor of a pickled array of at most so many bytes."""
    if not _is_array(value):
        kind = value.path if isinstance(value, StandIn) else type(value).__name__
        raise BrokenFileError(f"{name} is a {kind}, not an array")
    _, shape, dtype, fortran, data = value.built
    if not isinstance(shape, tuple) or len(shape) > MAX_AXES:
        raise BrokenFileError(f"{name} is an array without a shape")
    # Python 2 pickles bytes as text, Python 3's old protocols as encoded text.
    if isinstance(data, StandIn) and data.path in _ENCODED:
        data = data.arguments[0] if data.arguments else b""
    data = data.encode("latin-1") if isinstance(data, str) else data
    if not isinstance(data, bytes):
        raise BrokenFileError(f"{name} holds objects, not numbers")
    if len(data) > most:
        raise BrokenFileError("its arrays are larger than the file")
    return _tensor(data, _type(dtype), tuple(map(int, shape)), bool(fortran), name)


def _type(dtype: Any) -> str:
    """The code of a pickled numpy.dtype, such as "<f4"."""
    is_dtype = isinstance(dtype, StandIn) and dtype.path == "numpy.dtype" and dtype.arguments
    code = dtype.arguments[0] if is_dtype else None
    order = dtype.built[1] if is_dtype and isinstance(dtype.built, tuple) else "|"
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
    array = np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")
    native = array.astype(dtype.newbyteorder("="), order="C")
    return torch.from_numpy(native)
