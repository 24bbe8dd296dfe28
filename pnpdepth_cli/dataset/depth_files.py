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
"""Codes of the nearest point, at least: rounding changes it by 2 % at most then."""


def integer_scale(points: SparsePoints, stated: float | None = None) -> float:
    """Returns the codes per metre of an integer file of the depth that points were refined to.

    They are those of the file of the sparse depth. If it states none they are 256, or the largest
    power of ten that fits where the points do not fit 256 or are rounded by it.

    Args:
        points: The points of the frame.
        stated: Codes per metre of the file of the points. None if it holds metres.
    """
    if stated is not None:
        return stated
    nearest_m = float(points.depth.min())
    farthest_m = float(points.depth.max())
    finest = LARGEST_CODE / (_BEYOND_POINTS * farthest_m)
    if finest < KITTI_SCALE:
        return _power_of_ten(finest)
    if nearest_m * KITTI_SCALE >= _LEAST_CODES:
        return KITTI_SCALE
    return max(_power_of_ten(finest), KITTI_SCALE)


def within_range(frame: Refined, path: Path, scale: float) -> Refined:
    """Returns the frame with depths that the file can hold, with a note if any is clipped.

    Args:
        frame: The refined frame.
        path: The depth file. One of floats holds every depth.
        scale: Codes per metre of an integer file.
    """
    if not format_of_suffix(path).integer:
        return frame
    nearest_m = np.float32(1 / scale)
    farthest_m = np.float32(LARGEST_CODE / scale)
    is_known = np.isfinite(frame.depth) & (frame.depth > 0)
    # Less than half a code would be rounded to 0, unknown.
    is_clipped = is_known & ((frame.depth > farthest_m) | (frame.depth < 0.5 / scale))
    if not is_clipped.any():
        return frame
    note = (
        f"warning: {int(is_clipped.sum()):,} of {is_clipped.size:,} pixels clipped to"
        f" {metres(float(nearest_m))}–{metres(float(farthest_m))} m, what a 16-bit PNG with"
        f" {scale:g} codes per metre holds; EXR and NPY hold every depth"
    )
    depth = np.where(is_clipped, np.clip(frame.depth, nearest_m, farthest_m), frame.depth)
    return replace(frame, depth=depth, notes=(*frame.notes, note))


def write_sigma(path: Path, sigma: DepthMap) -> None:
    """Writes σ, the standard deviation of depth, (H, W) metres, 0 where unknown.

    A PNG has the largest power of ten of codes per metre that holds the largest σ. A σ that would
    be rounded to 0 gets the smallest code.
    """
    largest_m = max(float(sigma.max()), 1e-9)  # above 0, where all are unknown
    scale = _power_of_ten(LARGEST_CODE / largest_m)
    if format_of_suffix(path).integer:
        sigma = np.where(sigma > 0, np.maximum(sigma, np.float32(1 / scale)), np.float32(0))
    write_depth(path, sigma, scale=scale)


def _power_of_ten(largest: float) -> float:
    """The largest power of ten up to this number."""
    return 10.0 ** math.floor(math.log10(largest))
