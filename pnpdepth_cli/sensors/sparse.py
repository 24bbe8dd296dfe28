"""What the sources of sparse depth share: one point per pixel, and counts of dropped points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.points import SparsePoints

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

FARTHEST_M = 1e9
"""Metres; what noise moves farther is no measurement, and would overflow float32 in products."""


Points = SparsePoints[NDArray[np.float32]]
"""Sparse depth in numpy arrays."""


def as_depth_image(points: Points) -> NDArray[np.float32]:
    """Returns (H, W) float32 metres, 0 = unknown: each point on its pixel, the nearest wins."""
    flat = np.full(points.size[0] * points.size[1], np.inf, np.float32)
    np.minimum.at(flat, pixel_index(points.xy, points.size), points.depth)
    return np.where(np.isinf(flat), np.float32(0), flat).reshape(points.size)


def pixel_index(xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.intp]:
    """Returns the (N,) row-major indices of the pixels of points inside the image."""
    column, row = np.floor(np.asarray(xy, np.float64) + 0.5).astype(np.intp).T
    index: NDArray[np.intp] = row * size[1] + column
    return index


def nearest_in_pixel(
    xy: NDArray[np.floating], depth: NDArray[np.floating], size: tuple[int, int]
) -> Mask:
    """Returns (N,) true for the nearest point of each pixel, the first of equal ones."""
    pixel = pixel_index(xy, size)
    order = np.lexsort((depth, pixel))
    first = np.ones(len(order), bool)
    first[1:] = np.diff(pixel[order]) > 0
    mask = np.zeros(len(order), bool)
    mask[order[first]] = True
    return mask


class DropCounter:
    """Rows of an array that are left after each step, and how many each step dropped."""

    def __init__(self, count: int) -> None:
        self.index: NDArray[np.intp] = np.arange(count)
        self.dropped: dict[str, int] = {}

    def keep(self, mask: Mask, otherwise: str) -> Mask:
        """Keeps the rows where `mask` is true and returns it.

        Args:
            mask: Over the rows that were left by the step before.
            otherwise: Why the other rows are dropped.
        """
        self.dropped[otherwise] = int(len(mask) - np.count_nonzero(mask))
        self.index = self.index[mask]
        return mask

    def __str__(self) -> str:
        return ", ".join(f"{count:,} {why}" for why, count in self.dropped.items() if count)
