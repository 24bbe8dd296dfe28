"""The named arrays of a numpy file as tensors; nothing in it is run.

A .npz holds arrays by name. A .npy may hold a pickled dict of arrays, or of dicts of arrays, as
converters from Caffe write it; numpy would run that pickle, `Machine` reads it without a call.
Memory stays bounded by the size of the file.
"""

from __future__ import annotations

import io
import math
import mmap
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.pickle_machine import NONSENSE, Broken, Instance, Machine, brief

SUFFIXES = (".npy", ".npz")

_NUMBERS = frozenset({"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "b1"})
_RECONSTRUCT = (
    "numpy.core.multiarray._reconstruct",
    "numpy._core.multiarray._reconstruct",
)
_ENCODED = ("_codecs.encode", "__builtin__.bytes")
_DEEPEST = 3  # dicts inside each other
_MOST_ENTRIES = 10_000
_INFLATES = 4  # a compressed archive of weights is hardly smaller than they are


def read_numpy_file(path: Path) -> dict[str, Tensor]:
    """The arrays of a .npz by name, or of a .npy by "layer.name". CheckpointError if it has none.

    The arrays keep their type and their order of axes.
    """
    try:
        if zipfile.is_zipfile(path):
            return _read_archive(path)
        with path.open("rb") as file:
            return _read_pickled_dict(file, path.stat().st_size)
    except Broken as error:
        reason: object = error
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError) as error:
        reason = error
    except NONSENSE as error:
        reason = f"{type(error).__name__}: {error}"
    raise CheckpointError(f"checkpoint {path} cannot be read as a numpy file ({brief(reason)})")


def _read_archive(path: Path) -> dict[str, Tensor]:
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        limit = _INFLATES * path.stat().st_size + (1 << 20)
        if sum(info.file_size for info in entries) > limit or len(entries) > _MOST_ENTRIES:
            raise Broken("its arrays are far larger than the file")
        return {
            # TensorFlow writes the number of an operation's output behind its name
            info.filename.removesuffix(".npy").removesuffix(":0"): _plain_array(
                archive.read(info), info.filename
            )
            for info in entries
        }


def _plain_array(content: bytes, name: str) -> Tensor:
    file = io.BytesIO(content)
    shape, fortran, dtype = _header(file)
    if dtype.hasobject:
        raise Broken(f"{name} holds objects, not numbers")
    return _tensor(content[file.tell() :], dtype.str, shape, fortran, name)


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in Fortran's order, and type; the file stands behind it."""
    try:
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        return read[npy.read_magic(file)](file)
    except Exception as error:  # numpy lets out whatever Python's own parser raises at it
        raise Broken(f"its header makes no sense, {type(error).__name__}: {error}") from None


def _read_pickled_dict(file: IO[bytes], size: int) -> dict[str, Tensor]:
    shape, _, dtype = _header(file)
    if not dtype.hasobject or shape != ():
        raise Broken(f"it holds one array of shape {shape}, not named arrays")
    start = file.tell()
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as pickled:
        pickled.seek(start)
        array = Machine(_no_storage, longest=size).run(pickled, size)
    objects = array.built[4] if _is_array(array) else None
    if not (isinstance(objects, list) and len(objects) == 1 and isinstance(objects[0], Mapping)):
        raise Broken("it holds no dict of arrays")
    return _Arrays(size).named(objects[0])


def _no_storage(_: Any) -> Tensor:
    raise Broken("its pickle refers to something outside it")


def _is_array(value: Any) -> bool:
    """True for a stand-in of a numpy array, built with (version, shape, type, order, data)."""
    made = isinstance(value, Instance) and value.path in _RECONSTRUCT
    return made and isinstance(value.built, tuple) and len(value.built) == 5


class _Arrays:
    """Tensors from the arrays of a pickled dict, no more than the file can hold."""

    def __init__(self, size: int) -> None:
        self._left, self._entries = size, _MOST_ENTRIES
        self._made: dict[int, Tensor] = {}

    def named(self, content: Mapping[Any, Any]) -> dict[str, Tensor]:
        """Every array of the dict and of the dicts in it, by the keys that lead to it."""
        return dict(self._walk(content, "", _DEEPEST))

    def _walk(
        self, content: Mapping[Any, Any], prefix: str, deeper: int
    ) -> Iterator[tuple[str, Tensor]]:
        for key, value in content.items():
            name = f"{prefix}{key}"
            self._entries -= 1
            if self._entries < 0 or (isinstance(value, Mapping) and deeper == 1):
                raise Broken("its dicts hold more, or deeper, than the layers of a network")
            if isinstance(value, Mapping):
                yield from self._walk(value, f"{name}.", deeper - 1)
            else:
                yield name, self._array(value, name)

    def _array(self, value: Any, name: str) -> Tensor:
        if not _is_array(value):
            kind = value.path if isinstance(value, Instance) else type(value).__name__
            raise Broken(f"{name} is no array but a {kind}")
        if id(value) not in self._made:
            _, shape, dtype, fortran, data = value.built
            content = _bytes(data, name)
            self._left -= len(content)
            if self._left < 0:
                raise Broken("its arrays are larger than the file")
            sizes = tuple(map(int, shape))
            self._made[id(value)] = _tensor(content, _type(dtype), sizes, bool(fortran), name)
        return self._made[id(value)]


def _bytes(data: Any, name: str) -> bytes:
    """An array's data: Python 2 pickles bytes as text, Python 3 in old protocols as encoded text"""
    if isinstance(data, Instance) and data.path in _ENCODED:
        data = data.arguments[0] if data.arguments else b""
    if isinstance(data, str):
        return data.encode("latin-1")
    if not isinstance(data, bytes):
        raise Broken(f"{name} holds objects, not numbers")
    return data


def _type(dtype: Any) -> str:
    """A pickled numpy.dtype as its code, such as "<f4"."""
    if not isinstance(dtype, Instance) or dtype.path != "numpy.dtype" or not dtype.arguments:
        raise Broken("an array without a type")
    order = dtype.built[1] if isinstance(dtype.built, tuple) and len(dtype.built) > 1 else "|"
    return f"{order}{dtype.arguments[0]}"


def _tensor(content: bytes, code: str, shape: tuple[int, ...], fortran: bool, name: str) -> Tensor:
    if code[:1] not in "<>|=" or code[1:] not in _NUMBERS:
        raise Broken(f"{name} is an array of {code}, not of numbers")
    dtype = np.dtype(code)
    if any(n < 0 for n in shape) or math.prod(shape) * dtype.itemsize != len(content):
        raise Broken(f"{name} of shape {shape} does not have its {len(content)} bytes")
    flat = np.frombuffer(content, dtype)
    array: NDArray[Any] = flat.reshape(shape, order="F" if fortran else "C")
    native = array.astype(dtype.newbyteorder("="), order="C")
    return torch.from_numpy(native)
