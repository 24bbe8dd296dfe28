"""Flicker of a sequence: changes of the prediction that the ground truth does not have.

The change from frame to frame is compared with the ground truth's at the same pixel, as in TCC of
Zhang et al. 2019, with the absolute difference instead of a structural similarity; and the factor
between prediction and ground truth with that of the frame before.
"""

from __future__ import annotations

import math

import numpy as np

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.pipeline.evaluation.measured_frame import (
    Floats,
    MeasuredFrame,
    MeasureGroup,
    mean_of,
)


def flicker(frame: MeasuredFrame) -> dict[str, float]:
    """Returns the change of the error in metres and of the scale; NaN for a sequence's first."""
    before = frame.previous
    if before is None or before.gt.shape != frame.gt.shape:
        return {"flicker": math.nan, "scale_flicker": math.nan}
    both = frame.both & before.both
    change = _error(frame)[both] - _error(before)[both]
    scales = [_log_scale(each) for each in (before, frame)]
    return {"flicker": mean_of(np.abs(change)), "scale_flicker": abs(scales[1] - scales[0])}


def _error(frame: MeasuredFrame) -> Floats:
    return frame.depth.astype(np.float64) - frame.gt


def _log_scale(frame: MeasuredFrame) -> float:
    """The median of log(prediction / ground truth)."""
    both = frame.both
    if not both.any():
        return math.nan
    ratio = frame.depth[both].astype(np.float64) / frame.gt[both]
    return float(np.log(np.median(ratio)))


GROUP = MeasureGroup(
    measures=(
        Measure(key="flicker", title="flicker", unit="m"),
        Measure(key="scale_flicker", title="scale flicker"),
    ),
    values=flicker,
    in_sequences=True,
)
