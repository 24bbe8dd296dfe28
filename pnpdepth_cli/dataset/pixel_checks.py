"""Whether the coordinates of points are pixels of this image, and its rows are in their order.

| rule | evidence | then |
|---|---|---|
| a list holds pixels | all within 0…1 or −1…1; many below 0 | stops |
| x is across and y is down | many outside the image, and all inside it turned | stops |
| pixels are of this image | all within a larger one, in both directions alike | stops |
| pixels are of this image | all in the upper left corner | warns |
| floors are nearest below | depth grows towards the bottom | warns |
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.completion.two_depths import compare_depths
from pnpdepth_cli.errors import InputError, NoPointsError
from pnpdepth_cli.points import Size, SparsePoints, in_frame
from pnpdepth_cli.sensors.projection import Mask

_FEW = 10
"""Points; what fewer are outside of the image tells nothing."""
_MANY = 50
"""Points; as many show how the points of their file are distributed."""

# Coordinates that are fractions of the image's sides.
_LARGEST_RELATIVE = 1.05
"""Largest coordinate that is relative to the image's size, 0…1 but for rounding."""
_FEWEST_RELATIVE = 5
"""Points with such coordinates; fewer may all lie in the first pixel."""
_NEARLY_ALL = 0.9
"""Fraction of the points that have such coordinates, from which the list has."""
_SMALL_IMAGE_PX = 20
"""Side of an image whose points may well lie in the first pixel."""

# Coordinates of an image of another size.
_FEW_OUTSIDE = 0.05
"""Fraction of the points; if no more are outside the image, they are of its size."""
_NEARLY_LAST = 0.99
"""Quantile of the coordinates that tells the last column and row, without a few wrong ones."""
_LARGER = 1.25
"""Times the image's size, from which an image that has all points is another one."""
_ALIKE = 1.08
"""Ratio of the times across and the times down, up to which one resize explains both."""
_BELOW_ZERO = 0.1
"""Fraction of the points; more left of or above the image are x y z of a scan."""

# Coordinates that fill the upper left corner.
_STARTS_WITHIN = 0.1
"""Fraction of the largest coordinate, below which the smallest is if the points fill a corner."""
_CORNER = 0.75
"""Fraction of the image's sides that the points keep within, if they are of a smaller image."""
_SAME_RATIO = 0.9
"""Ratio of the fractions across and down, from which a smaller image has this image's shape."""
_SQUARE = 0.97
"""Ratio of the largest x and y, from which points fill a square, such as 0…255 or per cent."""

# Depth that grows downwards; see `check_rows`.
_DOWN = 0.6
"""Rank correlation of depth and row, from which near things are above."""
_LEAST_ROWS = 0.3
"""Fraction of the image's height that points cover, at least, for that."""


def check_rows(points: SparsePoints[NDArray[np.float32]]) -> list[str]:
    """Returns a warning if depth grows towards the bottom of the image, where floors are nearest.

    The rank correlation of depth with the row is −0.94 to 0.24 in 121 frames of seven sets, indoors
    and outdoors. Of disparity and 1/depth it has the opposite sign, and of rows that were stored
    from the bottom up. Few points, or points of few rows, give no warning.
    """
    row = points.xy[:, 1].astype(np.float64)
    if len(row) < _MANY or np.ptp(row) < _LEAST_ROWS * points.size[0]:
        return []
    agreement = compare_depths(points.depth, row + 1)  # above 0, as 0 would be unknown
    if agreement.rank < _DOWN:
        return []
    return [
        "warning: sparse: larger values are at the bottom of the image (rank correlation"
        f" {agreement.rank:.2f}), where floors are nearest: disparity or 1/depth, which"
        " --sparse-kind reads, or rows from the bottom up?"
    ]


def check_pixels(path: Path, xy: NDArray[np.floating], size: Size) -> tuple[Mask, list[str]]:
    """Returns which points of a file lie in the image, (N,) bool, and lines for a person.

    Args:
        path: The file, for messages.
        xy: (N, 2) pixel coordinates, x right and y down.
        size: (H, W) of the image.

    Raises:
        InputError: The coordinates are no pixels, or those of an image that was turned.
        NoPointsError: None lies in the image.
    """
    is_inside = np.asarray(in_frame(xy, size))
    outside = len(xy) - int(np.count_nonzero(is_inside))
    _check_relative(path, xy, size)
    _check_size_of_pixels(path, xy, size, outside)
    # Coordinates of a scan.
    below_zero = int((xy < -0.5).any(axis=1).sum())
    if len(xy) >= _FEW and below_zero > _BELOW_ZERO * len(xy):
        raise InputError(
            f"{path}: {below_zero:,} of {len(xy):,} points have coordinates below 0, down to"
            f" {xy.min():.3g}, which are no pixels; if these are x y z of a scan, give --calib"
        )
    if not is_inside.any():
        raise NoPointsError(
            f"{path}: none of its {len(xy)} points lies in the image; give pixels of this image"
        )
    notes = list[str]()
    if outside:
        notes.append(f"sparse: {outside:,} points outside the image")
    # Points that all keep within a corner are pixels of a smaller image.
    if _are_in_corner(xy, size):
        height, width = size
        notes.append(
            f"warning: all {len(xy):,} points of {path} are in the upper left corner, up to"
            f" {xy[:, 0].max():.0f}, {xy[:, 1].max():.0f} of {width}×{height} pixels; if these are"
            " pixels of a smaller image, scale them to this one"
        )
    return is_inside, notes


def _check_relative(path: Path, xy: NDArray[np.floating], size: Size) -> None:
    """Raises InputError for coordinates that are fractions of the image's sides.

    In a small image, and of few points, they may be pixels.

    Args:
        path: The file of the points, for messages.
        xy: (N, 2) pixel coordinates, as they should be.
        size: (H, W) of the image.
    """
    height, width = size
    is_relative = (np.abs(xy) <= _LARGEST_RELATIVE).all(axis=1)
    if len(xy) < _FEWEST_RELATIVE or min(size) <= _SMALL_IMAGE_PX:
        return
    if is_relative.mean() < _NEARLY_ALL:
        return
    count = np.count_nonzero(is_relative)
    # A coordinate clearly below 0 tells that they are from −1, as of OpenGL.
    if (xy[is_relative] < 1 - _LARGEST_RELATIVE).any():
        raise InputError(
            f"{path}: the coordinates of {count:,} of {len(xy):,} points are within −1…1, so they"
            f" are relative to the image; add 1 and multiply them by {width / 2:g} and"
            f" {height / 2:g} to make them pixels"
        )
    raise InputError(
        f"{path}: the coordinates of {count:,} of {len(xy):,} points are within 0…1, so they are"
        f" relative to the image; multiply them by {width} and {height} to make them pixels"
    )


def _check_size_of_pixels(path: Path, xy: NDArray[np.floating], size: Size, outside: int) -> None:
    """Raises InputError for pixels of this image turned by 90°, or of a larger one.

    Args:
        path: The file of the points, for messages.
        xy: (N, 2) pixel coordinates of this image, as they should be.
        size: (H, W) of the image.
        outside: Number of the points that are outside the image.
    """
    height, width = size
    if outside <= _FEW_OUTSIDE * len(xy):
        return
    turned = (width, height)  # (H, W) of the image turned by 90°
    if bool(in_frame(xy, turned).all()):
        raise InputError(
            f"{path}: {outside:,} of {len(xy):,} points are outside the {width}×{height} image,"
            f" but all are inside {height}×{width}: swap x and y, or turn the image by 90°"
        )
    # How many times as large the image would be that they are of, across and down.
    last = np.quantile(xy, _NEARLY_LAST, axis=0) / _NEARLY_LAST
    times = (last + 1) / (width, height)
    larger = float(times.min())
    is_larger = larger > _LARGER and times.max() < _ALIKE * larger
    if is_larger and len(xy) >= _FEW and bool((xy >= -0.5).all()):
        raise InputError(
            f"{path}: {outside:,} of {len(xy):,} points are outside the {width}×{height} image; all"
            f" are within one that is {larger:.3g} times as large; divide them by that"
        )


def _are_in_corner(xy: NDArray[np.floating], size: Size) -> bool:
    """Whether points (N, 2) fill the upper left corner of an image (H, W), as of a smaller one.

    Few points tell nothing. The corner has the image's shape, or it is a square.
    """
    height, width = size
    last = xy.max(axis=0)
    if len(xy) < _MANY or not (xy.min(axis=0) < _STARTS_WITHIN * last).all():
        return False
    # A smaller image of the same ratio of sides.
    across, down = (last + 1) / (width, height)
    larger = max(across, down)
    if larger < _CORNER and min(across, down) > _SAME_RATIO * larger:
        return True
    # A square, such as 0…255 or per cent; in a square image it would be the case above.
    is_square = last.max() < _CORNER * min(size) and last.min() > _SQUARE * last.max()
    return bool(is_square) and width != height
