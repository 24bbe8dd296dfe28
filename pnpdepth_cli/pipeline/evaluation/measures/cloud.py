"""The cloud of points: chamfer distance and F-score (Örnek et al. 2022; Spencer et al. 2022).

Both clouds are of the pixels where prediction and ground truth are known.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame, MeasureGroup

THRESHOLD_M = 0.1
"""A point is right if the other cloud has one within this distance (Spencer et al. 2022)."""
_MOST_POINTS = 30_000
"""Of each cloud that look for their nearest neighbour, evenly picked; it looks in all points."""


def cloud_errors(frame: MeasuredFrame) -> dict[str, float]:
    """Returns the chamfer distance in metres, and the F-score."""
    both = frame.both
    if not both.any():
        return {"chamfer": math.nan, "f_score": math.nan}
    predicted, true = (frame.points(depth)[both] for depth in (frame.depth, frame.gt))
    every = math.ceil(len(true) / _MOST_POINTS)
    accuracy = cKDTree(true).query(predicted[::every])[0]
    completeness = cKDTree(predicted).query(true[::every])[0]
    precision, recall = (float(np.mean(d < THRESHOLD_M)) for d in (accuracy, completeness))
    total = precision + recall
    return {
        "chamfer": float(accuracy.mean() + completeness.mean()) / 2,
        "f_score": 2 * precision * recall / total if total else 0.0,
    }


GROUP = MeasureGroup(
    measures=(
        Measure(key="chamfer", title="chamfer", unit="m"),
        Measure(
            key="f_score", title="F-score 0.1 m", percent=True, decimals=1, higher_is_better=True
        ),
    ),
    values=cloud_errors,
    needs="intrinsics",
)
