"""Errors by distance to the nearest sparse point, of each frame."""

from __future__ import annotations

import cv2
import numpy as np

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame, MeasureGroup, mean_of

BANDS_PX = ((0, 2), (2, 8), (8, 32), (32, 100_000))


def distance_errors(frame: MeasuredFrame) -> dict[str, float]:
    """Returns the MAE of each band of distance in pixels."""
    assert frame.sparse is not None
    empty = (frame.sparse == 0).astype(np.uint8)
    if empty.all():
        return dict.fromkeys((measure.key for measure in GROUP.measures), float("nan"))
    apart = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[frame.both]
    error = np.abs(frame.depth[frame.both].astype(np.float64) - frame.gt[frame.both])
    return {
        f"mae_from_{low}_px": mean_of(error[(apart >= low) & (apart < high)])
        for low, high in BANDS_PX
    }


GROUP = MeasureGroup(
    measures=tuple(
        Measure(
            key=f"mae_from_{low}_px",
            title=f"MAE {low}–{high} px" if high < BANDS_PX[-1][1] else f"MAE from {low} px",
            unit="m",
        )
        for low, high in BANDS_PX
    ),
    values=distance_errors,
    needs="sparse",
)
