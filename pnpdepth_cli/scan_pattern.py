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
"""Spacing along them over that to the nearest point, at most. It is 1.0 to 6.5 of seven scans of
KITTI and the samples, whole and thinned to 5 %, and 11 to 15 of random points in a wide area."""
_SAMPLED = 2000
"""Points of which the nearest is looked for."""
_ALONG = 3.0
"""Spacings along a line to its next point, at most."""
_ACROSS = 0.35
"""Spacings across lines to the next point of the same line, at most."""


def scan_pattern(xy: ArrayLike, size: tuple[int, int]) -> tuple[float, float] | None:
    """Returns the spacing of (N, 2) pixel coordinates in an image (H, W); None without scan lines.

    It is the median distance in pixels to the next point along a row, and along a column. With scan
    lines, points are much denser along rows, and the nearest point is in the same row.
    """
    pixels = np.floor(np.asarray(xy, np.float64) + 0.5).astype(np.intp)
    x, y = np.minimum(pixels, np.array(size)[::-1] - 1).T
    if len(x) < _MIN_POINTS:
        return None
    along = _median_gap(x, y)
    across = _median_gap(y, x)
    if not _ACROSS_OVER_ALONG * along <= across < np.inf:
        return None
    # The nearest point is one of the same line. Of random points in a wide area it is not.
    every = max(1, len(x) // _SAMPLED)
    points = np.column_stack([x, y]).astype(np.float64)
    to_itself_and_next, _ = cKDTree(points).query(points[::every], k=2)
    nearest = max(1.0, float(np.median(to_itself_and_next[:, 1])))
    return (along, across) if along <= _ALONG_OVER_NEAREST * nearest else None


def scan_lines(xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.intp] | None:
    """Returns (N,) the number of each point's scan line, from the top; None without scan lines.

    Each point is linked with the next one to the right in nearly the same row; a line that is
    interrupted, as by the sky, is several.
    """
    if (spacing := scan_pattern(xy, size)) is None:
        return None
    xy = np.asarray(xy, np.float64)
    along_px, across_px = spacing
    reach = np.array([_ALONG * along_px, max(1.0, _ACROSS * across_px)])
    first, second = cKDTree(xy / reach).query_pairs(1.0, p=np.inf, output_type="ndarray").T
    left = np.where(xy[first, 0] <= xy[second, 0], first, second)
    right = first + second - left
    offset = np.abs(xy[right] - xy[left])
    ahead = offset[:, 0] > 0
    left, right, offset = left[ahead], right[ahead], offset[ahead]
    order = np.lexsort((offset @ (1 / reach), left))
    nearest = order[np.diff(left[order], prepend=-1) > 0]
    links = coo_matrix((np.ones(len(nearest)), (left[nearest], right[nearest])), (len(xy),) * 2)
    count, line = connected_components(links, directed=False)
    if count < MIN_LINES:
        return None
    height = np.bincount(line, xy[:, 1]) / np.bincount(line)
    number: NDArray[np.intp] = np.argsort(np.argsort(height, kind="stable"))[line]
    return number


def _median_gap(column: NDArray[np.intp], row: NDArray[np.intp]) -> float:
    """The median distance in pixels from a point to the next in its row or a row beside it."""
    width = int(column.max()) + 1
    pixels = np.sort(row * width + column)
    pixels = pixels[np.diff(pixels, prepend=-1) > 0]  # np.unique takes 100 times as long
    row, column = np.divmod(pixels, width)
    gaps = np.full(len(pixels), np.inf)
    for beside in row - 1, row, row + 1:
        after = np.searchsorted(pixels, beside * width + column, "right")
        next_row, next_column = np.divmod(pixels[after.clip(max=len(pixels) - 1)], width)
        found = (after < len(pixels)) & (next_row == beside)
        gaps = np.where(found, np.minimum(gaps, next_column - column), gaps)
    return float(np.median(gaps))
