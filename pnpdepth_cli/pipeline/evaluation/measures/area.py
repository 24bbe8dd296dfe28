"""Errors weighted by the surface that a pixel covers, and by bands of range.

A pixel at depth g covers a surface proportional to g² if it faces the camera. Means over pixels are
of the image, weighted ones of the scene.
"""

from __future__ import annotations

import numpy as np

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame, MeasureGroup, mean_of

BANDS_M = ((0, 5), (5, 10), (10, 20), (20, 40), (40, 80))


def area_errors(frame: MeasuredFrame) -> dict[str, float]:
    """Returns MAE and MRE by area, and the MAE of each band of range."""
    g = frame.gt[frame.both].astype(np.float64)
    error = np.abs(frame.depth[frame.both] - g)
    bands = {f"mae_{low}_{high}": mean_of(error[(g >= low) & (g < high)]) for low, high in BANDS_M}
    by_area = {"area_mae": mean_of(error, g**2), "area_mre": mean_of(error / g, g**2)}
    return by_area | bands


GROUP = MeasureGroup(
    measures=(
        Measure(key="area_mae", title="MAE by area", unit="m"),
        Measure(key="area_mre", title="MRE by area"),
        *(
            Measure(key=f"mae_{low}_{high}", title=f"MAE {low}–{high} m", unit="m")
            for low, high in BANDS_M
        ),
    ),
    values=area_errors,
)
