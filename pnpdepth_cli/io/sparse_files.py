"""Sparse depth in files: a depth image, or a list of `x y depth` rows, which loses nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, NoPointsError, SizeError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.depth import (
    DEPTH_SUFFIXES,
    depth_from_stored,
    known_metres,
    load_stored,
    write_depth,
)
from pnpdepth_cli.io.file_bytes import read_bytes
from pnpdepth_cli.io.formats import Reading, check_scale, kind_of
from pnpdepth_cli.io.text_files import PIXELS, read_rows
from pnpdepth_cli.points import SparsePoints

SPARSE_SUFFIXES = (*DEPTH_SUFFIXES, ".csv")
"""What `write_sparse` can write; .csv keeps coordinates between pixel centres."""

Points = SparsePoints[NDArray[np.float32]]

_TEXT_SUFFIXES = (".csv", ".txt")
_MOST_COLUMNS = 8  # of a scan; a wider array is a depth map
_MANY_ROWS = 200  # of so few columns, which no depth map has
_BELOW_ZERO = 0.1  # of the rows


def read_sparse(
    path: Path,
    *,
    size: tuple[int, int] | None = None,
    scale: float | None = None,
) -> tuple[Points, Reading]:
    """Returns the points with known depth of a depth image or a point list, and how it was read.

    Points of an image are in row-major order. A list is a float array of shape (N, 3) in NPY or
    NPZ, or text with one `x y depth` per line (.csv, .txt), in metres; its order is kept.

    Args:
        size: (H, W) of the frame that a list belongs to. An image has its own; where they differ,
            integers are millimetres unless a scale is known.
        scale: Codes per metre of an integer image.

    Raises:
        NoPointsError: No depth is known.
        SizeError: The file is a list, and no size was given.
    """
    check_scale(scale)
    if path.suffix.lower() in _TEXT_SUFFIXES:
        data = read_bytes(path)
        if kind_of(data) is None:
            return _from_rows(path, read_rows(path, data)[0], "point list", size)
    stored = load_stored(path)
    shape = stored.values.shape
    if (
        not stored.is_image
        and len(shape) == 2
        and (shape[1] == 3 or (3 < shape[1] <= _MOST_COLUMNS and shape[0] > _MANY_ROWS))
    ):
        return _from_rows(path, stored.values, f"point list, {stored.reading.source}", size)
    image = depth_from_stored(path, stored, scale, size)
    rows, columns = np.nonzero(image.valid)
    if rows.size == 0:
        raise NoPointsError(f"{path} holds no depth above 0; give a file with sparse depth")
    height, width = image.values.shape
    xy = np.stack([columns, rows], axis=1).astype(np.float32)
    points = SparsePoints(xy=xy, depth=image.values[rows, columns], size=(height, width))
    return points, image.reading


def _from_rows(
    path: Path, rows: NDArray[np.floating], source: str, size: tuple[int, int] | None
) -> tuple[Points, Reading]:
    if rows.dtype.kind != "f":
        raise FileFormatError(f"{path} is a list of {rows.dtype}; save x, y, depth as floats")
    if rows.shape[1] != 3:
        raise FileFormatError(
            f"{path}: {rows.shape[1]} numbers a row are not x, y and depth; if they are x y z of a"
            " scan, give --calib"
        )
    depth = known_metres(rows[:, 2])
    known = (depth > 0) & np.isfinite(rows[:, :2]).all(axis=1)
    if not known.any():
        raise NoPointsError(f"{path} holds no depth above 0; give a file with sparse depth")
    if size is None:
        raise SizeError(f"{path} is a list of points, which needs an image to say the frame's size")
    if lost := len(rows) - int(np.count_nonzero(known)):
        source += f", without {lost:,} rows that have no depth above 0 or no pixel"
    xy = rows[known, :2].astype(np.float32)
    return SparsePoints(xy=xy, depth=depth[known], size=size), Reading(source)


def holds_scan(path: Path) -> bool:
    """Returns whether a list holds x y z of a scan, not x y depth of pixels.

    By its header or by more than three numbers a row; else many x or y are far below 0, as no
    pixels are.

    Raises:
        InputError: The file cannot be read.
    """
    data = read_bytes(path)
    if path.suffix.lower() in _TEXT_SUFFIXES and kind_of(data) is None:
        rows, header = read_rows(path, data)
        if header:
            return header[:3] != PIXELS
    else:
        stored = load_stored(path)
        rows = stored.values
        if stored.is_image or rows.ndim != 2 or rows.dtype.kind != "f":
            return False
    if not 3 <= rows.shape[1] <= _MOST_COLUMNS:
        return False
    with np.errstate(invalid="ignore"):
        below = (rows[:, :2] < -0.5).any(axis=1)
    return rows.shape[1] > 3 or bool(np.count_nonzero(below) > _BELOW_ZERO * len(rows))


def write_sparse(
    path: Path, xy: NDArray[np.float32], depth: NDArray[np.float32], image: NDArray[np.float32]
) -> None:
    """Writes N points, of pixels (N, 2) and metres (N,), in the format that the suffix names.

    Every format but .csv holds the image, the same points as (H, W) metres.
    """
    if path.suffix.lower() != ".csv":
        write_depth(path, image)
        return
    rows = [f"{x:.9g},{y:.9g},{z:.9g}" for (x, y), z in zip(xy, depth, strict=True)]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(["x,y,depth", *rows]) + "\n", encoding="utf-8", newline="\n")
