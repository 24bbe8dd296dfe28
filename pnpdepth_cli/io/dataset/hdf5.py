"""Arrays of HDF5 and MATLAB 7.3 files."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.dataset.frame import Hdf5Array
from pnpdepth_cli.io.depth_reading import known_metres
from pnpdepth_cli.io.file_bytes import check_value_count, one_line, size_of_regular_file


def shape_of(path: Path, name: str) -> tuple[int, ...]:
    """Returns the shape of an array of the file. Raises InputError if it has none."""
    return tuple(_with_array(path, name, lambda array: array.shape))


def rgb_of(source: Hdf5Array) -> NDArray[np.float32]:
    """Returns (H, W, 3) float32 in 0..1 of an array of bytes. Raises InputError for another."""
    pixels = _read(source)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise FileFormatError(f"{source} is {pixels.dtype} of shape {pixels.shape}, not an image")
    return pixels.astype(np.float32) / np.float32(255)


def depth_of(source: Hdf5Array) -> NDArray[np.float32]:
    """Returns (H, W) float32 metres, 0 where unknown, of floats. Raises InputError for others."""
    metres = _read(source)
    if metres.dtype.kind != "f" or metres.ndim != 2:
        raise FileFormatError(f"{source} is {metres.dtype} of shape {metres.shape}, not depth")
    if source.focal_px is None:
        return known_metres(metres)
    height, width = metres.shape
    y = np.arange(height)[:, None] - (height - 1) / 2
    x = np.arange(width)[None, :] - (width - 1) / 2
    along_axis = source.focal_px / np.sqrt(x * x + y * y + source.focal_px**2)
    return known_metres(metres.astype(np.float64) * along_axis)


def _read(source: Hdf5Array) -> NDArray[Any]:
    def pick(array: Any) -> NDArray[Any]:
        if array.dtype.kind not in "fiu":
            raise FileFormatError(f"{source} holds {array.dtype} values, not numbers")
        one = array.shape if source.index is None else array.shape[1:]
        check_value_count(source.path, math.prod(one), size_of_regular_file(source.path))
        if source.index is not None and source.index >= array.shape[0]:
            raise FileFormatError(f"{source}: there are only {array.shape[0]}")
        return np.asarray(array[()] if source.index is None else array[source.index])

    values: NDArray[Any] = _with_array(source.path, source.name, pick)
    if values.ndim != len(source.axes):
        raise FileFormatError(f"{source} has {values.ndim} axes instead of {len(source.axes)}")
    return values.transpose(source.axes)


def _with_array(path: Path, name: str, use: Callable[[Any], Any]) -> Any:
    try:
        import h5py
    except ImportError:
        raise UsageError(f"reading {path} needs h5py: pip install 'pnpdepth[nyu]'") from None
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path")
    try:
        with h5py.File(path, "r") as file:
            link = file.get(name, getlink=True)
            if link is None:
                raise FileFormatError(f"{path} has no array {name}; it is of another kind")
            array = file[name] if isinstance(link, h5py.HardLink) else None
            if array is None or array.external or array.is_virtual:
                raise FileFormatError(
                    f"{path}: {name} is stored outside the file; copy its values into this one"
                )
            return use(array)
    except PnpDepthError:
        raise
    except Exception as error:  # h5py raises many kinds for a damaged file
        raise FileFormatError(f"{path} cannot be read as HDF5 ({one_line(error)})") from error
