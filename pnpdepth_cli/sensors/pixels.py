"""What the sources of sparse depth share: one point per pixel, and counts of dropped points."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.points import SparsePoints, in_frame

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

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


class DropCounter:
    """How many rows of an array each step dropped."""

    def __init__(self) -> None:
        self.dropped: dict[str, int] = {}

    def keep(self, mask: Mask, otherwise: str) -> Mask:
        """Counts the rows where `mask` is false as dropped, with the reason; returns the mask."""
        self.dropped[otherwise] = int(len(mask) - np.count_nonzero(mask))
        return mask

    def keep_seen(self, xyz: Floats, xy: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
        """Keeps the points in an image (H, W) that are the nearest of their pixel; returns them.

        `xyz` are in the camera's coordinates. `xy` are pixels, NaN where the lens does not show
        them.
        """
        inside = self.keep(in_frame(xy, size), "outside the image")
        xyz, xy = xyz[inside], xy[inside]
        pixel = pixel_index(xy, size)
        order = np.lexsort((xyz[:, 2], pixel))
        nearest = np.zeros(len(xy), bool)
        nearest[order[np.diff(pixel[order], prepend=-1) > 0]] = True  # the first of equal ones
        self.keep(nearest, "behind another in their pixel")
        return xyz[nearest], xy[nearest]

    def points(self, xyz: Floats, xy: Floats, size: tuple[int, int]) -> Points:
        """Returns what is left, `xyz` in the camera's coordinates, as points of an image (H, W)."""
        pixels, depth = xy.astype(np.float32), xyz[:, 2].astype(np.float32)
        return Points(xy=pixels, depth=depth, size=size, dropped=self.dropped)

    def __str__(self) -> str:
        return describe_dropped(self.dropped)


def describe_dropped(dropped: Mapping[str, int]) -> str:
    """Returns the counts above 0 with their reasons, for a person."""
    return ", ".join(f"{count:,} {why}" for why, count in dropped.items() if count)
