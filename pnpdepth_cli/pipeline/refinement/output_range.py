"""Codes per metre of an integer depth file, and the depths that such a file can hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pnpdepth_cli.frames.frame import RefinedFrame
from pnpdepth_cli.io.depth import metres
from pnpdepth_cli.io.formats import format_of_suffix
from pnpdepth_cli.io.formats.png import LARGEST_CODE
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.output_files import Outputs

INTEGER_SCALE = 256.0
"""KITTI's codes per metre, for points that have none of their own and fit."""

_COARSER = (100.0, 10.0, 1.0, 0.1)  # codes per metre where 256 cannot hold the points
_FINER = (1000.0, 10_000.0, 100_000.0)  # where 256 would round them
_BEYOND_POINTS = 1.5  # depths up to this multiple of the farthest point fit
_LEAST_CODES = 25.6  # of the nearest point: 2 % of rounding


def output_scale(outputs: Outputs, inputs: Inputs) -> float:
    """Returns the codes per metre of an integer depth file for this frame.

    What the user asks for, else the sparse depth file's own, else 256 unless the points do not fit;
    known before refinement.
    """
    if outputs.scale is not None:
        return outputs.scale
    if inputs.sparse_scale is not None:
        return inputs.sparse_scale
    nearest, farthest = float(inputs.points.depth.min()), float(inputs.points.depth.max())
    scale = INTEGER_SCALE
    for coarser in _COARSER:
        if _BEYOND_POINTS * farthest * scale > LARGEST_CODE:
            scale = coarser
    for finer in _FINER:
        if nearest * scale < _LEAST_CODES and _BEYOND_POINTS * farthest * finer <= LARGEST_CODE:
            scale = finer
    return scale


def within_range(outputs: Outputs, inputs: Inputs, frame: RefinedFrame) -> RefinedFrame:
    """Returns the frame with depths that the file's format can hold, and a note if any is clipped.

    Args:
        outputs: The files that are written.
        inputs: The frame as it was read.
        frame: The refined frame.
    """
    depth_format = format_of_suffix(outputs.depth.suffix)
    if depth_format is None or not depth_format.integer:
        return frame
    scale = output_scale(outputs, inputs)
    nearest, farthest = np.float32(1 / scale), np.float32(LARGEST_CODE / scale)
    known = np.isfinite(frame.after) & (frame.after > 0)
    beyond, below = known & (frame.after > farthest), known & (frame.after < 0.5 / scale)
    notes = [
        f"output: {int(mask.sum()):,} of {mask.size:,} pixels clipped to {metres(float(limit))} m,"
        f" the {extreme} depth of a 16-bit PNG with {scale:g} codes per metre; --format exr holds"
        " every depth"
        for mask, limit, extreme in ((beyond, farthest, "largest"), (below, nearest, "smallest"))
        if mask.any()
    ]
    if not notes:
        return frame
    after = np.where(beyond, farthest, np.where(below, nearest, frame.after))
    return replace(frame, after=after, notes=(*frame.notes, *notes))
