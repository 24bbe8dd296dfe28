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
from pnpdepth_cli.points import SparsePoints, in_frame
from pnpdepth_cli.sensors.projection import Mask

_FEW = 10
"""Numbers; fewer decide nothing."""
_MANY = 50
"""Numbers; as many tell something of all."""
_SWAPPED = 0.05
"""Of the points; more outside the image, but inside it turned, have x and y swapped."""
_RELATIVE = 1.05
"""Largest coordinate that is relative to the image's size."""
_RELATIVE_FEW = 5
"""Points; fewer may all lie in the first pixel."""
_NEARLY_ALL = 0.9
"""Of the points that have relative coordinates."""
_LARGER = 1.25
"""Times the image, within which the points are, if it is another size."""
_ALIKE = 1.08
"""Ratio of the two directions' such numbers."""
_SQUARE = 0.97
"""Of the other side, up to which the points of a square reach."""
_CORNER = 0.75
"""Of the image's sides that many points keep within, if they are of another size."""
_DOWN = 0.6
"""Rank correlation of depth and row, from which near things are above; see `check_rows`."""
_PART_OF_ROWS = 0.3
"""Of the image's height, that points cover at least for that."""
_BELOW_ZERO = 0.1
"""Of the points; more left of or above the image are x y z of a scan."""


def check_rows(points: SparsePoints[NDArray[np.float32]]) -> list[str]:
    """Returns a warning if depth grows towards the bottom of the image, where floors are nearest.

    Its rank correlation with the row is −0.94 to 0.24 in 121 frames of seven sets, indoors and
    outdoors. Of disparity and 1/depth it is the opposite, and of rows from the bottom up.
    """
    y = points.xy[:, 1].astype(np.float64)
    if len(y) < _MANY or np.ptp(y) < _PART_OF_ROWS * points.size[0]:
        return []
    found = compare_depths(points.depth, y + 1)
    if found.rank < _DOWN:
        return []
    return [
        "warning: sparse: larger values are at the bottom of the image (rank correlation"
        f" {found.rank:.2f}), where floors are nearest: disparity or 1/depth, which --sparse-kind"
        " reads, or rows from the bottom up?"
    ]


def check_pixels(
    path: Path, xy: NDArray[np.floating], size: tuple[int, int]
) -> tuple[Mask, list[str]]:
    """Returns which points (N, 2) of a list lie in an image (H, W), and lines for a person.

    Raises:
        InputError: The coordinates are no pixels, or those of an image that was turned.
        NoPointsError: None lies in the image.
    """
    inside = np.asarray(in_frame(xy, size))
    outside = len(xy) - int(np.count_nonzero(inside))
    _check_relative(path, xy, size)
    _check_size_of_pixels(path, xy, size, outside)
    # Coordinates of a scan.
    below = int((xy < -0.5).any(axis=1).sum())
    if len(xy) >= _FEW and below > _BELOW_ZERO * len(xy):
        raise InputError(
            f"{path}: {below:,} of {len(xy):,} points have coordinates below 0, down to"
            f" {xy.min():.3g}, which are no pixels; if these are x y z of a scan, give --calib"
        )
    if not inside.any():
        raise NoPointsError(
            f"{path}: none of its {len(xy)} points lies in the image; give pixels of this image"
        )
    notes = [f"sparse: {outside:,} points outside the image"] if outside else []
    # Points that all keep within a corner are pixels of a smaller image.
    if _are_in_corner(xy, size):
        height, width = size
        notes.append(
            f"warning: all {len(xy):,} points of {path} are in the upper left corner, up to"
            f" {xy[:, 0].max():.0f}, {xy[:, 1].max():.0f} of {width}×{height} pixels; if these are"
            " pixels of a smaller image, scale them to this one"
        )
    return inside, notes


def _check_relative(path: Path, xy: NDArray[np.floating], size: tuple[int, int]) -> None:
    """Raises InputError for coordinates that are relative to the image (H, W)."""
    height, width = size
    relative = (np.abs(xy) <= _RELATIVE).all(axis=1)
    if len(xy) < _RELATIVE_FEW or relative.mean() < _NEARLY_ALL or min(size) <= 2 * _FEW:
        return
    count = np.count_nonzero(relative)
    if (xy[relative] < 1 - _RELATIVE).any():
        raise InputError(
            f"{path}: the coordinates of {count:,} of {len(xy):,} points are within −1…1, so they"
            f" are relative to the image; add 1 and multiply them by {width / 2:g} and"
            f" {height / 2:g} to make them pixels"
        )
    raise InputError(
        f"{path}: the coordinates of {count:,} of {len(xy):,} points are within 0…1, so they are"
        f" relative to the image; multiply them by {width} and {height} to make them pixels"
    )


def _check_size_of_pixels(
    path: Path, xy: NDArray[np.floating], size: tuple[int, int], outside: int
) -> None:
    """Raises InputError for pixels of an image that was turned, or of a larger one.

    Args:
        path: The file of the points.
        xy: (N, 2).
        size: (H, W) of the image.
        outside: Number of points outside the image.
    """
    height, width = size
    if outside <= _SWAPPED * len(xy):
        return
    if bool(in_frame(xy, (width, height)).all()):
        raise InputError(
            f"{path}: {outside:,} of {len(xy):,} points are outside the {width}×{height} image,"
            f" but all are inside {height}×{width}: swap x and y, or turn the image by 90°"
        )
    # How many times as large the image would be that they are of, in both directions.
    reach = (np.quantile(xy, 0.99, axis=0) / 0.99 + 1) / (width, height)
    larger = float(reach.min())
    is_larger = larger > _LARGER and reach.max() < _ALIKE * larger
    if is_larger and len(xy) >= _FEW and bool((xy >= -0.5).all()):
        raise InputError(
            f"{path}: {outside:,} of {len(xy):,} points are outside the {width}×{height} image; all"
            f" are within one that is {larger:.3g} times as large; divide them by that"
        )


def _are_in_corner(xy: NDArray[np.floating], size: tuple[int, int]) -> bool:
    """Whether many points (N, 2) cover a corner of an image (H, W), as of a smaller one."""
    height, width = size
    last = xy.max(axis=0)
    if len(xy) < _MANY or not (xy.min(axis=0) < 0.1 * last).all():
        return False
    # A smaller image of the same ratio of sides.
    right, down = (last + 1) / (width, height)
    if max(right, down) < _CORNER and min(right, down) > 0.9 * max(right, down):
        return True
    # A square, such as 0…255 or per cent.
    is_square = last.max() < _CORNER * min(size) and last.min() > _SQUARE * last.max()
    return bool(is_square) and width != height
