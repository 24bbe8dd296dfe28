"""What every source of sparse depth gives: points in a picture, at most one per pixel."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

FARTHEST_M = 1e9
"""Metres; what noise moves farther is no measurement, and would overflow float32 in products."""


@dataclass(frozen=True, kw_only=True)
class SparseDepth:
    """N depths at pixel coordinates.

    xy: (N, 2) float32, x right and y down, pixel centres at whole numbers, not rounded.
    depth: (N,) float32 metres, all above 0. size: (H, W) of the picture.
    dropped: how many points went on the way, and why, in the order of the steps.
    """

    xy: NDArray[np.float32]
    depth: NDArray[np.float32]
    size: tuple[int, int]
    dropped: dict[str, int] = field(default_factory=dict)


def as_picture(points: SparseDepth) -> NDArray[np.float32]:
    """(H, W) float32 metres, 0 = unknown: each point on its pixel, the nearest wins."""
    flat = np.full(points.size[0] * points.size[1], np.inf, np.float32)
    np.minimum.at(flat, pixel_index(points.xy, points.size), points.depth)
    return np.where(np.isinf(flat), np.float32(0), flat).reshape(points.size)


def in_picture(xy: NDArray[np.floating], size: tuple[int, int]) -> Mask:
    """(N,) true where the nearest pixel exists in a picture of `size` (H, W); false for NaN."""
    x, y = xy[:, 0], xy[:, 1]
    return (x >= -0.5) & (x < size[1] - 0.5) & (y >= -0.5) & (y < size[0] - 0.5)


def pixel_index(xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.intp]:
    """(N,) the row-major index of the pixel around each point inside the picture."""
    column, row = np.floor(np.asarray(xy, np.float64) + 0.5).astype(np.intp).T
    index: NDArray[np.intp] = row * size[1] + column
    return index


def nearest_in_pixel(
    xy: NDArray[np.floating], depth: NDArray[np.floating], size: tuple[int, int]
) -> Mask:
    """(N,) true for the one point of each pixel that is nearest; the first of equals."""
    pixel = pixel_index(xy, size)
    order = np.lexsort((depth, pixel))
    first = np.ones(len(order), bool)
    first[1:] = np.diff(pixel[order]) > 0
    mask = np.zeros(len(order), bool)
    mask[order[first]] = True
    return mask


class Steps:
    """Which rows of an array are left after each step, and how many each step dropped."""

    def __init__(self, count: int) -> None:
        self.index: NDArray[np.intp] = np.arange(count)
        self.dropped: dict[str, int] = {}

    def keep(self, mask: Mask, otherwise: str) -> Mask:
        """Only the rows where mask is true are left; `otherwise` says why the others went."""
        self.dropped[otherwise] = int(len(mask) - np.count_nonzero(mask))
        self.index = self.index[mask]
        return mask

    def __str__(self) -> str:
        return ", ".join(f"{count:,} {why}" for why, count in self.dropped.items() if count)
