"""Reads frames from one array of many: `(N, H, W)` NPY, and NPZ such as monodepth2's `gt_depths`.

monodepth2 stores images of different sizes as an object array, which NumPy pickles. It is read with
an unpickler that creates NumPy arrays and nothing else.
"""

from __future__ import annotations

import functools
import io
import pickle
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.formats import StoredArray
from pnpdepth_cli.io.formats.npy import HEADER_LOCK

STACK_SUFFIXES = (".npy", ".npz")
_ARRAY_PARTS = {
    (module, name)
    for module in ("numpy.core.multiarray", "numpy._core.multiarray")
    for name in ("_reconstruct", "scalar")
} | {("numpy", "ndarray"), ("numpy", "dtype")}


def stack_size(path: Path) -> int | None:
    """Returns how many frames a file stacks; None for a single depth map or an unreadable file."""
    if path.suffix.lower() not in STACK_SUFFIXES:
        return None
    try:
        stack = _stack(path)
    except FileFormatError:  # the reader of single maps reports it
        return None
    return None if stack is None else len(stack)


def load_stacked(path: Path, index: int) -> StoredArray:
    """Returns frame `index` of a stack as it is stored."""
    stack = _stack(path)
    assert stack is not None
    values = np.asarray(stack[index])
    if values.ndim != 2:
        raise FileFormatError(f"{path}: frame {index} is of shape {values.shape}, not (H, W)")
    kind = path.suffix.removeprefix(".").upper()
    return StoredArray(values=values, description=f"{values.dtype} {kind} of {len(stack):,} frames")


@functools.lru_cache(maxsize=4)
def _stack(path: Path) -> Sequence[NDArray[Any]] | NDArray[Any] | None:
    """The stack in a file; None if it holds a single map."""
    try:
        if path.suffix.lower() == ".npy":
            array = _member(path.open("rb"), path)
        else:
            with zipfile.ZipFile(path) as archive:
                names = archive.namelist()
                if len(names) != 1:
                    return None
                array = _member(io.BytesIO(archive.read(names[0])), path)
    except FileFormatError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, pickle.UnpicklingError) as error:
        raise FileFormatError(f"{path} is not a NumPy file: {error}") from error
    if array.dtype == object:
        return [np.asarray(each) for each in array.ravel()]
    return array if array.ndim == 3 and 1 not in (array.shape[0], array.shape[2]) else None


def _member(file: Any, path: Path) -> NDArray[Any]:
    with file, HEADER_LOCK:
        version = np.lib.format.read_magic(file)
        read = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if read is None:
            raise FileFormatError(f"{path}: NPY version {version} is unknown")
        shape, _, dtype = read(file)
        if not dtype.hasobject:
            file.seek(0)
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
        array = _ArrayUnpickler(file).load()
        if not isinstance(array, np.ndarray) or array.shape != shape:
            raise FileFormatError(f"{path}: its object array does not fit its header")
        return array


class _ArrayUnpickler(pickle.Unpickler):
    """Creates NumPy arrays of numbers; refuses every other class and function."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ARRAY_PARTS:
            raise pickle.UnpicklingError(f"{module}.{name} is not part of an array")
        return super().find_class(module, name)
