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
MAP = 0.5
"""Fraction of the pixels that are measured, from which on the points are called a depth map."""


def with_measured(refined: Refined) -> Refined:
    """Returns a refined frame that has the points' own depth at their pixels.

    A note counts the pixels, and the points between pixels, which are not kept. Of several points
    at a pixel the nearest counts. Outliers are no points of the result and are not kept.

    Raises:
        UsageError: All points lie between pixels.
    """
    points = refined.used
    whole = _at_whole_pixels(points)
    if not bool(whole.any()):
        raise UsageError(
            f"`keep_measured`: all {len(points):,} points lie between pixels; it takes a depth map"
            " of the image's size, or points at whole pixels"
        )
    measured = points.where(whole).scatter()[0, 0].numpy()
    depth = np.where(measured > 0, measured, refined.depth)
    note = f"measured pixels: {int((measured > 0).sum()):,} have the depth of their points"
    between = len(points) - int(whole.sum())
    if between:
        note += f"; {between:,} of {len(points):,} points lie between pixels, and are not kept"
    return replace(refined, depth=depth, notes=(*refined.notes, note))


def with_note_on_measured(refined: Refined) -> Refined:
    """Returns a refined frame of a depth map with a note on the measured pixels that are changed.

    Other frames, and those without such a pixel, have none.
    """
    points = refined.used
    height, width = points.size
    points = points.where(_at_whole_pixels(points))
    if len(points) < MAP * height * width:
        return refined
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
