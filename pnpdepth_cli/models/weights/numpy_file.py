"""The arrays of a pickled dict in a .npy file as tensors; nothing in it is run.

Converters from Caffe write such dicts of arrays, or of dicts of arrays; numpy would run the pickle,
`read_pickle` reads it without a call. Memory stays bounded by the size of the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib import format as npy
from torch import Tensor

from pnpdepth_cli.budget import check_claim
from pnpdepth_cli.models.weights.pickle_reader import BrokenFileError, StandIn, read_pickle

_RECONSTRUCT = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
_MAX_DEPTH = 3  # dicts inside each other
_MAX_ENTRIES = 10_000


def read_numpy_file(path: Path) -> dict[str, Tensor]:
    """Returns the arrays of a .npy with a dict by name, those in a dict of it as "layer.name".

    The arrays keep their type and their order of axes. A broken file raises whatever its parts do.
    """
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
    for name, value in _entries(objects[0]):
        tensors[name] = _unpickle(value, name, left)
        left -= tensors[name].nbytes
        count = len(tensors)
        check_claim(f"it has {count:,} arrays", count, _MAX_ENTRIES, error=BrokenFileError)
    return tensors


def _state_of_array(value: object) -> tuple[Any, ...]:
    """(version, shape, type, order, data) of a pickled numpy array; nothing for anything else."""
    state = value.state if isinstance(value, StandIn) and value.path in _RECONSTRUCT else None
    return state if isinstance(state, tuple) and len(state) == 5 else (None,) * 5


def _entries(
    content: Mapping[Any, object], prefix: str = "", depth: int = 1
) -> Iterator[tuple[str, object]]:
    """All that lies in the dict and in the dicts in it, by name; "." joins the keys."""
    if depth > _MAX_DEPTH:
        raise BrokenFileError("its dicts are nested deeper than the layers of any network")
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _entries(value, f"{prefix}{key}.", depth + 1)
        else:
            yield f"{prefix}{key}", value


def _unpickle(value: object, name: str, most: int) -> Tensor:
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
    if array.dtype.kind not in "fiub":
        raise BrokenFileError(f"{name} is an array of {array.dtype.str}, not of numbers")
    array = array.reshape(shape, order="F" if fortran else "C")
    return torch.from_numpy(array.astype(number.newbyteorder("="), order="C"))
