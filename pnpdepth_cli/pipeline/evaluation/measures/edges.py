"""Depth boundaries: accuracy and completeness (depth boundary error of iBims-1, Koch et al. 2018).

Boundaries are Canny edges of the depth normalised to 0…1, with iBims-1's parameters and its code's
formulas. iBims-1 annotates the boundaries of the ground truth; here they come from the ground truth
by the same filter, so it has to be dense.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.pipeline.evaluation.measured_frame import (
    Depth,
    Floats,
    Mask,
    MeasuredFrame,
    MeasureGroup,
)

FAR_PX = 10.0
"""Distances are cut off here."""
_SIGMA_PX = math.sqrt(2)
_LOW, _HIGH = 0.15, 0.3
_LEAST_KNOWN = 0.5
"""Fraction of the pixels whose ground truth has to be known."""
_CODES = 4096
"""Gradients are rounded to 1/4096 of the depth range, as OpenCV takes integers."""


def boundary_errors(frame: MeasuredFrame) -> dict[str, float]:
    """Returns accuracy and completeness in pixels; NaN for sparse or edgeless ground truth."""
    nothing = {"dbe_accuracy": math.nan, "dbe_completeness": math.nan}
    known = frame.gt > 0
    if known.mean() < _LEAST_KNOWN or not (frame.depth > 0).any():
        return nothing
    gt_edges = edges_of(frame.gt) & known
    if not gt_edges.any():
        return nothing
    edges = edges_of(frame.depth) & known & (frame.depth > 0)
    to_gt = _distance(gt_edges)
    near = edges & (to_gt < FAR_PX)
    if not near.any():
        return dict.fromkeys(nothing, FAR_PX)
    both = (
        np.minimum(to_gt[edges], FAR_PX).sum() + _distance(edges)[gt_edges].clip(max=FAR_PX).sum()
    )
    return {
        "dbe_accuracy": float(to_gt[near].mean()),
        "dbe_completeness": float(both / (edges.sum() + gt_edges.sum())),
    }


def edges_of(depth: Depth) -> Mask:
    """Returns (H, W) true on the edges of a depth map; unknown pixels take the nearest known depth.

    Args:
        depth: (H, W) metres, 0 where unknown; some of it known.
    """
    known = depth > 0
    low, high = float(depth[known].min()), float(depth[known].max())
    if high == low:
        return np.zeros(depth.shape, bool)
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(labels.max() + 1, np.float32)
    nearest[labels[known]] = depth[known]
    smooth = cv2.GaussianBlur((nearest[labels] - low) / (high - low), (0, 0), _SIGMA_PX)
    gradients = (
        np.rint(_CODES * cv2.Sobel(smooth, cv2.CV_32F, *axis)).astype(np.int16)
        for axis in ((1, 0), (0, 1))
    )
    return np.asarray(
        cv2.Canny(*gradients, _LOW * _CODES, _HIGH * _CODES, L2gradient=True) > 0  # type: ignore[call-overload]
    )


def _distance(edges: Mask) -> Floats:
    """(H, W) pixels to the nearest edge; far away where there is none."""
    if not edges.any():
        return np.full(edges.shape, np.inf)
    apart = cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(apart, np.float64)


GROUP = MeasureGroup(
    measures=(
        Measure(key="dbe_accuracy", title="DBE accuracy", unit="px", decimals=3),
        Measure(key="dbe_completeness", title="DBE completeness", unit="px", decimals=3),
    ),
    values=boundary_errors,
)
