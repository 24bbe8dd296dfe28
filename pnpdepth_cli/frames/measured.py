"""The measured pixels of a result: kept exactly, or how many of them are changed is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.points import SparsePoints

CHANGED_M = 0.002
"""Metres from which on a measured pixel is called changed: the noise of a depth camera at 1 m."""
LEAST_OF_MAP = 0.5
"""Fraction of the pixels that are measured, from which on the points are called a depth map."""


def with_measured(refined: Refined) -> Refined:
    """Returns a refined frame with the measured depth itself at the pixels of its points.

    A note counts these pixels, and the points between pixel centres, whose depth is not kept. Of
    several points at a pixel the nearest counts. The depth of outliers is not kept: they are not in
    `Refined.used`.

    Raises:
        UsageError: All points lie between pixels.
    """
    points = refined.used
    is_at_pixel = _at_whole_pixels(points)
    if not bool(is_at_pixel.any()):
        raise UsageError(
            f"`keep_measured`: all {len(points):,} points lie between pixels; it takes a depth map"
            " of the image's size, or points at whole pixels"
        )
    measured = points.where(is_at_pixel).scatter()[0, 0].numpy()  # (H, W) metres, 0 = none
    depth = np.where(measured > 0, measured, refined.depth)
    note = f"measured pixels: {int((measured > 0).sum()):,} have the depth of their points"
    between = len(points) - int(is_at_pixel.sum())
    if between:
        note += f"; {between:,} of {len(points):,} points lie between pixels, and are not kept"
    return replace(refined, depth=depth, notes=(*refined.notes, note))


def with_note_on_measured(refined: Refined) -> Refined:
    """Returns a refined frame with a note on its measured pixels whose depth differs, if any does.

    It differs if it changed by more than `CHANGED_M`. Only a frame whose points are a depth map has
    a note.
    """
    points = refined.used
    height, width = points.size
    points = points.where(_at_whole_pixels(points))
    if len(points) < LEAST_OF_MAP * height * width:
        return refined  # its points are no depth map
    change = (points.sample(torch.from_numpy(refined.depth)) - points.depth).abs()
    count = int((change > CHANGED_M).sum())
    if not count:
        return refined
    note = (
        f"measured pixels: {count:,} of {len(points):,} are changed by more than"
        f" {1000 * CHANGED_M:g} mm, by up to {float(change.max()):.3g} m; `keep_measured` keeps"
        " them as they are"
    )
    return replace(refined, notes=(*refined.notes, note))


def _at_whole_pixels(points: SparsePoints) -> Tensor:
    """(N,) bool: which points lie on the centre of a pixel."""
    return (points.xy == points.xy.round()).all(dim=1)
