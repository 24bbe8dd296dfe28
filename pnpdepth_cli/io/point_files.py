"""Sparse depth in files: the known pixels of a depth image, or a list of `x y depth` rows.

A list loses nothing: its coordinates may lie between pixel centres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError, NoPointsError
from pnpdepth_cli.io import formats
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.depth import (
    DEPTH_SUFFIXES,
    depth_from_stored,
    known_metres,
    load_stored,
    write_depth,
)
from pnpdepth_cli.io.file_bytes import PIXELS, read_bytes, read_rows
from pnpdepth_cli.io.formats import DepthFile, Reading
from pnpdepth_cli.points import SparsePoints

SPARSE_SUFFIXES = (*DEPTH_SUFFIXES, ".csv")
"""What `write_sparse` can write; .csv keeps coordinates between pixel centres."""

Points = SparsePoints[NDArray[np.float32]]

_TEXT_SUFFIXES = (".csv", ".txt")
_MOST_COLUMNS = 8  # of a scan; a wider array is a depth map
_MANY_ROWS = 200  # of so few columns, which no depth map has
_MOST_OUTSIDE = 0.1  # fraction of the rows of a list of pixels that may lie outside of any image
_LARGEST_IMAGE_PX = 65_535  # side of an image, in PNG, JPEG and TIFF of every program
_LARGEST_RELATIVE = 2.0  # smaller coordinates are relative to an image, and share its first pixels
_LEAST_DISTINCT = 0.5  # fraction of different pixels among those of a list of points of an image


def read_sparse(
    path: Path, *, size: tuple[int, int] | None = None, scale: float | None = None
) -> tuple[Points, Reading]:
    """Returns the points with known depth of a depth image or a point list, and how it was read.

    Args:
        path: A depth file of any format, or a text.
        size: (H, W) of the frame that a list belongs to.
        scale: Codes per metre of an integer image, as `points_from_stored` takes it.

    Raises:
        NoPointsError: No depth is known.
        InputError: The file cannot be read, or is a list, and no size was given.
        UsageError: The scale is not above 0.
    """
    formats.check_scale(scale)
    return points_from_stored(path, load_numbers(path), size=size, scale=scale)


def load_numbers(path: Path) -> DepthFile:
    """Returns the numbers that a file stores: an array of whatever shape, or the rows of a text.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or holds no numbers.
    """
    data = read_bytes(path)
    # The suffix tells a text, unless the content begins as that of another format.
    if path.suffix.lower() not in _TEXT_SUFFIXES or formats.kind_of(data) is not None:
        return load_stored(path)
    rows, header = read_rows(path, data)
    return DepthFile(values=rows, reading=Reading("text"), is_image=False, header=tuple(header))


def points_from_stored(
    path: Path,
    stored: DepthFile,
    *,
    size: tuple[int, int] | None = None,
    scale: float | None = None,
) -> tuple[Points, Reading]:
    """Returns the points with known depth that a file stores, and how they are read.

    Points of an image are in row-major order. A list is a float array of shape (N, 3) in NPY or
    NPZ, or text with one `x y depth` per line (.csv, .txt), in metres; its order is kept.

    Args:
        path: The file, for messages.
        stored: Its numbers, as `load_numbers` returns them.
        size: (H, W) of the frame. A list needs it. An image has its own size; where that differs
            from the frame's, integers are millimetres unless their scale is known.
        scale: Codes per metre of an integer image. None: as the file says, else as is usual.

    Raises:
        NoPointsError: No depth is known.
        InputError: The numbers are neither an image nor a list of points, or are a list, and no
            size was given.
        UsageError: The scale is not above 0.
    """
    formats.check_scale(scale)
    # A text is a list.
    if stored.header is not None:
        return _from_rows(path, stored.values, "point list", size)
    # So is an array of three columns, or of few columns and many rows. Rows of more than three
    # numbers are refused there.
    shape = stored.values.shape
    if not stored.is_image and len(shape) == 2:
        rows, columns = shape
        if columns == 3 or (3 < columns <= _MOST_COLUMNS and rows > _MANY_ROWS):
            return _from_rows(path, stored.values, f"point list, {stored.reading.source}", size)
    # Anything else is an image, whose known pixels are the points.
    image = depth_from_stored(path, stored, scale, size)
    is_known = image.values > 0
    rows_and_columns = np.argwhere(is_known)
    if not len(rows_and_columns):
        raise NoPointsError(f"{path} holds no depth above 0; give a file with sparse depth")
    xy = rows_and_columns[:, ::-1].astype(np.float32)
    height, width = image.values.shape
    points = SparsePoints(xy=xy, depth=image.values[is_known], size=(height, width))
    return points, image.reading


def _from_rows(
    path: Path, rows: NDArray[np.floating], source: str, size: tuple[int, int] | None
) -> tuple[Points, Reading]:
    """The points of a list, without rows that have no depth or no pixel, and how it was read.

    Args:
        path: The file, for messages.
        rows: (N, 3) x, y in pixels and depth in metres.
        source: Name of what was read, to which the number of rows left out is added.
        size: (H, W) of the frame that the points belong to.

    Raises:
        NoPointsError: No row has depth.
        InputError: The rows are not three floats each, or no size was given.
    """
    # What is no list of points.
    if rows.dtype.kind != "f":
        raise InputError(f"{path} is a list of {rows.dtype}; save x, y, depth as floats")
    if rows.shape[1] != 3:
        raise InputError(
            f"{path}: {rows.shape[1]} numbers a row are not x, y and depth; if they are x y z of a"
            " scan, give --calib"
        )
    # The rows that have a depth and a pixel.
    depth = known_metres(rows[:, 2])
    has_both = (depth > 0) & np.isfinite(rows[:, :2]).all(axis=1)
    if not has_both.any():
        raise NoPointsError(f"{path} holds no depth above 0; give a file with sparse depth")
    if size is None:
        raise InputError(f"{path} is a list of points, which needs an image for the frame's size")
    lost_count = len(rows) - int(np.count_nonzero(has_both))
    if lost_count:
        source += f", without {lost_count:,} rows that have no depth above 0 or no pixel"
    xy = rows[has_both, :2].astype(np.float32)
    return SparsePoints(xy=xy, depth=depth[has_both], size=size), Reading(source)


def holds_scan(stored: DepthFile, *, is_stated: bool = False) -> bool:
    """Returns whether a file holds x y z of a LiDAR's scan, not x y depth of pixels.

    The header of a list tells, or more than three numbers a row, or what the user states. Else the
    first two columns do: they are no pixels if many lie outside of any image, or if most points
    share their pixel with others.

    Args:
        stored: Numbers, as `load_numbers` returns them.
        is_stated: Whether the user states what only a scan has, such as its extrinsics.
    """
    rows = stored.values
    # What the file or the user says.
    if stored.header:
        return list(stored.header[:3]) != PIXELS
    if stored.is_image or rows.ndim != 2 or rows.dtype.kind != "f":
        return False
    if not 3 <= rows.shape[1] <= _MOST_COLUMNS:
        return False
    if rows.shape[1] > 3 or is_stated:
        return True
    # Many points outside of any image, whose first pixel begins at -0.5.
    xy = rows[np.isfinite(rows).all(axis=1), :2]
    if not len(xy):
        return False
    is_outside = ((xy < -0.5) | (xy > _LARGEST_IMAGE_PX)).any(axis=1)
    if np.count_nonzero(is_outside) > _MOST_OUTSIDE * len(rows):
        return True
    # Many points in one pixel, as coordinates in metres have. Relative ones, 0 to 1, have too.
    pixel_count = len(np.unique(np.rint(xy), axis=0))
    return bool(xy.max() > _LARGEST_RELATIVE and pixel_count < _LEAST_DISTINCT * len(xy))


def write_sparse(
    path: Path, xy: NDArray[np.float32], depth: NDArray[np.float32], image: NDArray[np.float32]
) -> None:
    """Writes sparse depth in the format that the suffix names: a list as .csv, else an image.

    Args:
        path: The file; it is replaced.
        xy: (N, 2) pixel coordinates of the points.
        depth: (N,) metres.
        image: (H, W) metres, the same points on their pixels, 0 elsewhere.

    Raises:
        OutputError: As `write_depth` has it.
    """
    if path.suffix.lower() != ".csv":
        write_depth(path, image)
        return
    rows = np.column_stack([xy, depth])
    with atomic_path(path) as temporary:
        np.savetxt(temporary, rows, "%.9g", ",", header="x,y,depth", comments="")
