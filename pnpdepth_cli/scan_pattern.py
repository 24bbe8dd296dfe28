"""Scan lines in the pattern of sparse points: recognised by spacing, and each point's line.

The points of a rotating LiDAR are close together along a scan line and farther apart across.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

MIN_LINES = 12
"""With fewer scan lines, leaving some out is another task than filling in between them."""

_MIN_POINTS = 500
"""Fewer points show no pattern."""
_ACROSS_OVER_ALONG = 1.5
"""Spacing across scan lines over that along them, at least."""
_ALONG_OVER_NEAREST = 8.0
"""Spacing along scan lines over the distance to the nearest point, at most. It is 1.0 to 6.5 of
seven scans of KITTI and the samples, whole and thinned to 5 %, and 11 to 15 of random points in a
wide area."""
_SAMPLED = 2000
"""Number of points whose nearest other point is looked for."""
_ALONG = 3.0
"""Distance along a scan line from a point to the next one of it, in spacings along, at most."""
_ACROSS = 0.35
"""Distance across scan lines from a point to the next one of its line, in spacings across, at
most."""
_LEAST_ACROSS_PX = 1.0
"""Pixels across lines that are allowed in any case: points lie on whole pixels."""


def scan_pattern(xy: ArrayLike, size: tuple[int, int]) -> tuple[float, float] | None:
    """Returns the spacings of points along and across scan lines, pixels; None without such lines.

    They are the median distances from a point to the next along a row, and along a column. With
    scan lines, points are much denser along rows, and the nearest point is in the same row.

    Args:
        xy: (N, 2) pixel coordinates inside the image.
        size: (H, W) of the image.
    """
    # Columns and rows of the pixels; the image's right and bottom edge are in its last ones.
    pixels = np.floor(np.asarray(xy, np.float64) + 0.5).astype(np.intp)
    x, y = np.minimum(pixels, np.array(size)[::-1] - 1).T
    if len(x) < _MIN_POINTS:
        return None
    # The spacings are infinite where most points have no next one.
    along_px = _median_gap(x, y)
    across_px = _median_gap(y, x)
    if not _ACROSS_OVER_ALONG * along_px <= across_px < np.inf:
        return None  # points are not denser along rows
    # The nearest point is one of the same line. Of random points in a wide area it is not.
    step = max(1, len(x) // _SAMPLED)
    points = np.column_stack([x, y]).astype(np.float64)
    to_itself_and_next, _ = cKDTree(points).query(points[::step], k=2)
    nearest_px = max(1.0, float(np.median(to_itself_and_next[:, 1])))
    if along_px > _ALONG_OVER_NEAREST * nearest_px:
        return None
    return along_px, across_px


def scan_lines(xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.intp] | None:
    """Returns (N,) the number of each point's scan line, from the top; None without scan lines.

    Each point is linked with the next one to the right in nearly the same row; a line that is
    interrupted, as by the sky, is several. With fewer than `MIN_LINES` there are none.

    Args:
        xy: (N, 2) pixel coordinates inside the image.
        size: (H, W) of the image.
    """
    spacing = scan_pattern(xy, size)
    if spacing is None:
        return None
    # All pairs of points that are near enough along and across the lines: in a box of side `reach`.
    xy = np.asarray(xy, np.float64)
    along_px, across_px = spacing
    reach = np.array([_ALONG * along_px, max(_LEAST_ACROSS_PX, _ACROSS * across_px)])
    first, second = cKDTree(xy / reach).query_pairs(1.0, p=np.inf, output_type="ndarray").T
    # The left and the right point of each pair; pairs in one column are no neighbours on a line.
    is_ordered = xy[first, 0] <= xy[second, 0]
    left = np.where(is_ordered, first, second)
    right = np.where(is_ordered, second, first)
    offset = np.abs(xy[right] - xy[left])
    is_beside = offset[:, 0] > 0
    left, right, offset = left[is_beside], right[is_beside], offset[is_beside]
    # Of the pairs of each left point the nearest one, by the sum of the distances along and across
    # in units of the reach. Pairs are sorted by left point, then by that sum; the first pair of a
    # left point is where the number of the left point rises.
    order = np.lexsort((offset @ (1 / reach), left))
    is_first = np.diff(left[order], prepend=-1) > 0
    nearest = order[is_first]
    # Points that are linked, directly or not, are a line.
    links = coo_matrix((np.ones(len(nearest)), (left[nearest], right[nearest])), (len(xy),) * 2)
    count, line = connected_components(links, directed=False)
    if count < MIN_LINES:
        return None
    # Lines are numbered by their mean row: the inner `argsort` gives the lines in that order, the
    # outer one the place of each line in it.
    mean_row = np.bincount(line, xy[:, 1]) / np.bincount(line)
    number: NDArray[np.intp] = np.argsort(np.argsort(mean_row, kind="stable"))[line]
    return number


def _median_gap(column: NDArray[np.intp], row: NDArray[np.intp]) -> float:
    """The median distance in pixels from a point to the next one to its right.

    The next one is in the same row or a row beside it. Infinite where most points have none.

    Args:
        column: (N,) column of each point.
        row: (N,) row of each point. With the two exchanged, the distance is downwards.
    """
    # Row-major indices of the pixels with points, in rising order and each once.
    width = int(column.max()) + 1
    pixels = np.sort(row * width + column)
    pixels = pixels[np.diff(pixels, prepend=-1) > 0]  # np.unique takes 100 times as long
    row, column = np.divmod(pixels, width)
    # In each of three rows the next point to the right: the first pixel in that order after the
    # pixel in this column, if it is still in that row.
    gaps = np.full(len(pixels), np.inf)
    for searched_row in row - 1, row, row + 1:
        after = np.searchsorted(pixels, searched_row * width + column, "right")
        next_row, next_column = np.divmod(pixels[after.clip(max=len(pixels) - 1)], width)
        has_next = (after < len(pixels)) & (next_row == searched_row)
        gaps = np.where(has_next, np.minimum(gaps, next_column - column), gaps)
    return float(np.median(gaps))
