"""Reads frames from one array of many: `(N, H, W)` NPY, or NPZ as monodepth2's `gt_depths`."""

from __future__ import annotations

import functools
import io
import pickle
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.formats import StoredArray

_ARRAY_PARTS = {
    *((f"numpy.{core}.multiarray", part) for core in ("core", "_core")
      for part in ("_reconstruct", "scalar")),
    *(("numpy", part) for part in ("ndarray", "dtype")),
}  # fmt: skip


def stack_size(path: Path) -> int | None:
    """Returns how many frames a file stacks; None for a single depth map or an unreadable file."""
    if path.suffix.lower() not in (".npy", ".npz"):
        return None
    stack = _stack(path)
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
    """The stack in a file; None for anything else, which the reader of single maps reports."""
    try:
        with _opened(path) as file:
            array = _array_in(file)
    except Exception:  # NumPy evaluates the header, which raises many kinds where it is damaged
        return None
    if array.dtype == object:
        return [np.asarray(each) for each in array.ravel()]
    return array if array.ndim == 3 and 1 not in (array.shape[0], array.shape[2]) else None


def _opened(path: Path) -> IO[bytes]:
    """The NPY file, or the one in an NPZ."""
    if path.suffix.lower() == ".npy":
        return path.open("rb")
    with zipfile.ZipFile(path) as archive:
        (name,) = archive.namelist()
        return io.BytesIO(archive.read(name))


def _array_in(file: IO[bytes]) -> NDArray[Any]:
    try:
        return np.asarray(np.load(file, allow_pickle=False))
    except ValueError:  # monodepth2 stores images of different sizes as an object array, a pickle
        file.seek(6)
        long = file.read(2)[0] > 1
        file.seek(int.from_bytes(file.read(4 if long else 2), "little"), io.SEEK_CUR)
        array = _ArrayUnpickler(file).load()
        if not isinstance(array, np.ndarray):
            raise
        return array


class _ArrayUnpickler(pickle.Unpickler):
    """Creates NumPy arrays of numbers; refuses every other class and function."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ARRAY_PARTS:
            raise pickle.UnpicklingError(f"{module}.{name} is not part of an array")
        return super().find_class(module, name)
