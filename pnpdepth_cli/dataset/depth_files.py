"""Depth and its standard deviation in a file: codes per metre of integers, and what they hold."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.frames.frame import DepthMap, Refined
from pnpdepth_cli.io.depth import metres, write_depth
from pnpdepth_cli.io.formats import KITTI_SCALE, LARGEST_CODE, format_of_suffix
from pnpdepth_cli.points import SparsePoints

_BEYOND_POINTS = 1.5
"""Depths up to this multiple of the farthest point fit the codes of a file."""
_LEAST_CODES = 25.6
"""Codes of the nearest point, at least: 2 % of rounding."""


def integer_scale(points: SparsePoints, stated: float | None = None) -> float:
    """Returns the codes per metre of an integer file of the depth that points were refined to.

    They are those of the sparse depth file. Without them they are 256, or the largest power of ten
    that fits where the points do not fit 256 or are rounded by it.

    Args:
        points: The points of the frame.
        stated: Codes per metre of the file of the points. None if it holds metres.
    """
    if stated is not None:
        return stated
    nearest = float(points.depth.min())
    farthest = float(points.depth.max())
    finest = LARGEST_CODE / (_BEYOND_POINTS * farthest)
    if finest < KITTI_SCALE:
        return _power_of_ten(finest)
    is_exact = nearest * KITTI_SCALE >= _LEAST_CODES
    return KITTI_SCALE if is_exact else max(_power_of_ten(finest), KITTI_SCALE)


def within_range(frame: Refined, path: Path, scale: float) -> Refined:
    """Returns the frame with depths that the file can hold, with a note if any is clipped.

    Args:
        frame: The refined frame.
        path: The depth file.
        scale: Codes per metre of an integer file.
    """
    if not format_of_suffix(path).integer:
        return frame
    nearest = np.float32(1 / scale)
    farthest = np.float32(LARGEST_CODE / scale)
    known = np.isfinite(frame.depth) & (frame.depth > 0)
    clipped = known & ((frame.depth > farthest) | (frame.depth < 0.5 / scale))
    if not clipped.any():
        return frame
    note = (
        f"warning: {int(clipped.sum()):,} of {clipped.size:,} pixels clipped to"
        f" {metres(float(nearest))}–{metres(float(farthest))} m, what a 16-bit PNG with {scale:g}"
        " codes per metre holds; EXR and NPY hold every depth"
    )
    after = np.where(clipped, np.clip(frame.depth, nearest, farthest), frame.depth)
    return replace(frame, depth=after, notes=(*frame.notes, note))


def write_sigma(path: Path, sigma: DepthMap) -> None:
    """Writes σ; a PNG has the largest power of ten of codes per metre that holds the largest σ."""
    scale = _power_of_ten(LARGEST_CODE / max(float(sigma.max()), 1e-9))
    if format_of_suffix(path).integer:
        sigma = np.where(sigma > 0, np.maximum(sigma, np.float32(1 / scale)), np.float32(0))
    write_depth(path, sigma, scale=scale)


def _power_of_ten(largest: float) -> float:
    """The largest power of ten up to this number."""
    return 10.0 ** math.floor(math.log10(largest))
