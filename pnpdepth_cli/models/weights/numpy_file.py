"""The named arrays of a numpy file as tensors; nothing in it is run.

A .npz holds arrays by name. A .npy may hold a pickled dict of arrays, or of dicts of arrays, as
converters from Caffe write it; numpy would run that pickle, `read_pickle` reads it without a call.
Memory stays bounded by the size of the file.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection, Iterator, Mapping
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.budget import check_claim
from pnpdepth_cli.models.weights.pickle_reader import BrokenFileError, StandIn, read_pickle

_RECONSTRUCT = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
_MAX_DEPTH = 3  # dicts inside each other
_MAX_ENTRIES = 10_000
_MAX_INFLATION = 4  # a compressed archive of weights is hardly smaller than they are
_ALWAYS_ALLOWED = 1 << 20  # bytes


def read_numpy_file(path: Path) -> dict[str, Tensor]:
    """Returns the arrays of a .npz by name, or of a .npy by "layer.name".

    The arrays keep their type and their order of axes. A broken file raises whatever its parts do.
    """
    if not zipfile.is_zipfile(path):
        return _read_pickled_dict(path)
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    claimed = sum(info.file_size for info in entries)
    most = _MAX_INFLATION * path.stat().st_size + _ALWAYS_ALLOWED
    check_claim(f"its arrays have {claimed:,} bytes", claimed, most, error=BrokenFileError)
    _check_entries(entries)
    if any(i.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for i in entries):
        raise BrokenFileError("it is compressed as numpy never does")
    with zipfile.ZipFile(path) as archive:
        for info in entries:
            _check_member(archive, info)
    with np.load(path, allow_pickle=False) as arrays:
        # TensorFlow writes the number of an operation's output behind its name.
        return {name.removesuffix(":0"): _tensor(arrays[name], name) for name in arrays.files}


def _check_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> None:
    """Raises BrokenFileError if an array of the archive claims more bytes than are stored."""
    with archive.open(info) as member:
        version = npy.read_magic(member)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = header(member)
    claimed = math.prod(shape) * dtype.itemsize
    check_claim(
        f"{info.filename} has {claimed:,} bytes", claimed, info.file_size, error=BrokenFileError
    )


def _read_pickled_dict(path: Path) -> dict[str, Tensor]:
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        if npy.read_magic(content) != (1, 0):
            raise BrokenFileError("it holds no dict of arrays")
        shape, _, dtype = npy.read_array_header_1_0(content)
        if not dtype.hasobject or shape != ():
            raise BrokenFileError(f"it holds one array of shape {shape}, not named arrays")
        array, _ = read_pickle(content)
        left = len(content)
    objects = _state_of_array(array)[4]
    if not (isinstance(objects, list) and len(objects) == 1 and isinstance(objects[0], Mapping)):
        raise BrokenFileError("it holds no dict of arrays")
    tensors: dict[str, Tensor] = {}
    made: dict[int, Tensor] = {}
    for name, value in _entries(objects[0]):
        if id(value) not in made:
            made[id(value)] = _unpickle(value, name, left)
            left -= made[id(value)].nbytes
        tensors[name] = made[id(value)]
        _check_entries(tensors)
    return tensors


def _check_entries(entries: Collection[Any]) -> None:
    count = len(entries)
    check_claim(f"it has {count:,} arrays", count, _MAX_ENTRIES, error=BrokenFileError)


def _state_of_array(value: Any) -> tuple[Any, ...]:
    """(version, shape, type, order, data) of a pickled numpy array; nothing for anything else."""
    is_array = isinstance(value, StandIn) and value.path in _RECONSTRUCT
    state = value.state if is_array else None
    return state if isinstance(state, tuple) and len(state) == 5 else (None,) * 5


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


def _unpickle(value: Any, name: str, most: int) -> Tensor:
    """The tensor of a pickled array of at most so many bytes."""
    _, shape, dtype, fortran, data = _state_of_array(value)
    if not isinstance(shape, tuple):
        kind = value.path if isinstance(value, StandIn) else type(value).__name__
        raise BrokenFileError(f"{name} is a {kind}, not an array")
    shape, code, order = tuple(map(int, shape)), dtype.arguments[0], dtype.state[1]
    data = data.encode("latin-1") if isinstance(data, str) else data  # as Python 2 has it
    if not isinstance(data, bytes):
        raise BrokenFileError(f"{name} holds objects, not numbers")
    check_claim(f"{name} has {len(data):,} bytes", len(data), most, error=BrokenFileError)
    if any(side < 0 for side in shape):
        raise BrokenFileError(f"{name} has a shape of {shape}")
    if not isinstance(code, str) or not isinstance(order, str):
        raise BrokenFileError("an array without a type")
    number = np.dtype(f"{order[:1]}{code[:8]}")
    array = np.frombuffer(data, number) if data else np.empty(0, number)
    return _tensor(array.reshape(shape, order="F" if fortran else "C"), name)


def _tensor(array: NDArray[Any], name: str) -> Tensor:
    """The tensor of an array of numbers, copied to native byte order."""
    if not isinstance(array, np.ndarray):
        raise BrokenFileError(f"{name} is no array")
    if array.dtype.kind not in "fiub":
        raise BrokenFileError(f"{name} is an array of {array.dtype.str}, not of numbers")
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))
