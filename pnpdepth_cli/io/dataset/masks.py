"""Masks of ground truth, and ground truth of another size than its image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, SizeError
from pnpdepth_cli.io.dataset.frame import IMAGE_SUFFIXES
from pnpdepth_cli.io.depth_reading import load_stored
from pnpdepth_cli.io.rgb import read_rgb

_ASPECT_TOLERANCE = 0.02
"""Relative difference of aspect ratios of images of one view."""


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Returns (H, W), true where an image has any channel above 0, or an array a number above 0.

    Raises:
        InputError: The file holds no mask.
    """
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return np.asarray(read_rgb(path).values.max(axis=2) > 0)
    values = load_stored(path, None).values
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    if values.ndim != 2:
        raise FileFormatError(f"{path}: a mask is (H, W), not of shape {values.shape}")
    return np.asarray(values > 0)


def masked(depth: NDArray[np.float32], masks: tuple[Path, ...]) -> NDArray[np.float32]:
    """Returns the depth (H, W) with 0 where any of the masks is 0.

    Raises:
        SizeError: A mask has another size.
    """
    for path in masks:
        mask = read_mask(path)
        if mask.shape != depth.shape:
            raise SizeError(
                f"mask {path} is {mask.shape[1]}×{mask.shape[0]} but the ground truth is"
                f" {depth.shape[1]}×{depth.shape[0]}"
            )
        depth = np.where(mask, depth, np.float32(0))
    return depth


def moved_to(path: Path, depth: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Returns the known depths at the pixels of an image of the same view; the nearest wins.

    No depth is interpolated: in a larger image most pixels stay unknown.

    Args:
        path: Of the depth, for messages.
        depth: (H, W), 0 where unknown.
        size: (H, W) of the image.

    Raises:
        SizeError: The two have different aspect ratios.
    """
    ratio = depth.shape[1] * size[0] / (depth.shape[0] * size[1])
    if abs(ratio - 1) > _ASPECT_TOLERANCE:
        raise SizeError(
            f"{path} is {depth.shape[1]}×{depth.shape[0]} and the image {size[1]}×{size[0]}: they"
            " do not show the same view"
        )
    rows, columns = np.nonzero(depth)
    row = ((rows + 0.5) * size[0] / depth.shape[0]).astype(np.intp)
    column = ((columns + 0.5) * size[1] / depth.shape[1]).astype(np.intp)
    moved = np.full(size, np.inf, np.float32)
    np.minimum.at(moved, (row, column), depth[rows, columns])
    return np.where(np.isinf(moved), np.float32(0), moved)
