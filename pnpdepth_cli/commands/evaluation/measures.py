"""Measures beyond the standard ones: `pnpdepth eval --measures`.

One decorated function adds a group of measures: it takes a frame and returns their values in the
order of the decorator, NaN where the frame has none. `choices.MEASURE_GROUPS` lists the names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.core.metrics import Measure

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MeasuredFrame:
    """A frame as its protocol scores it; depths are (H, W) metres, 0 where unknown."""

    depth: Depth
    gt: Depth
    """0 also where the protocol does not score."""

    @property
    def both(self) -> Mask:
        """(H, W) true where prediction and ground truth are known."""
        return (self.depth > 0) & (self.gt > 0)


Values = Callable[[MeasuredFrame], tuple[float, ...]]


@dataclass(frozen=True, kw_only=True)
class MeasureGroup:
    """Measures that are computed together."""

    measures: tuple[Measure, ...]
    values: Values


TABLE: dict[str, MeasureGroup] = {}


def measures(name: str, *listed: Measure) -> Callable[[Values], Values]:
    """Enters the decorated function in the table, as the group `name` of the listed measures."""

    def enter(function: Values) -> Values:
        TABLE[name] = MeasureGroup(measures=listed, values=function)
        return function

    return enter


def distance_px(seeds: Mask) -> Depth:
    """Returns (H, W) pixels to the nearest true pixel; infinite where there is none."""
    if not seeds.any():
        return np.full(seeds.shape, np.inf, np.float32)
    apart = cv2.distanceTransform((~seeds).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(apart, np.float32)


BOUNDARY_FAR_PX = 10.0
_BOUNDARY_SIGMA_PX = math.sqrt(2)
_CANNY_LOW, _CANNY_HIGH = 0.15, 0.3
_LEAST_KNOWN = 0.5
"""Fraction of the pixels of a frame whose depth has to be known."""
_CODES = 4096
"""Gradients are rounded to 1/4096 of the depth range, as OpenCV takes integers."""


@measures(
    "edges",
    Measure(key="dbe_accuracy", title="DBE accuracy", unit="px", decimals=3),
    Measure(key="dbe_completeness", title="DBE completeness", unit="px", decimals=3),
)
def boundary_errors(frame: MeasuredFrame) -> tuple[float, ...]:
    """Depth boundary error of iBims-1 (Koch et al. 2018), accuracy and completeness in pixels.

    iBims-1 annotates the boundaries of the ground truth; here they are found in it by the same
    filter as in the prediction, so it has to be dense.
    """
    known = frame.gt > 0
    if known.mean() < _LEAST_KNOWN or not (frame.depth > 0).any():
        return math.nan, math.nan
    gt_edges = edges_of(frame.gt) & known
    if not gt_edges.any():
        return math.nan, math.nan
    edges = edges_of(frame.depth) & known & (frame.depth > 0)
    to_gt, to_edges = (distance_px(each).astype(np.float64) for each in (gt_edges, edges))
    near = edges & (to_gt < BOUNDARY_FAR_PX)
    if not near.any():
        return BOUNDARY_FAR_PX, BOUNDARY_FAR_PX
    apart = np.concatenate([to_gt[edges], to_edges[gt_edges]]).clip(max=BOUNDARY_FAR_PX)
    return float(to_gt[near].mean()), float(apart.mean())


def edges_of(depth: Depth) -> Mask:
    """Returns (H, W) true on the Canny edges of the depth normalised to 0…1, as iBims-1 has them.

    Args:
        depth: (H, W) metres, some known; unknown pixels (0) take the nearest known depth.
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
    smooth = cv2.GaussianBlur((nearest[labels] - low) / (high - low), (0, 0), _BOUNDARY_SIGMA_PX)
    across, down = (
        np.rint(_CODES * cv2.Sobel(smooth, cv2.CV_32F, *axis)).astype(np.int16)
        for axis in ((1, 0), (0, 1))
    )
    thresholds = _CANNY_LOW * _CODES, _CANNY_HIGH * _CODES
    return np.asarray(cv2.Canny(across, down, *thresholds, L2gradient=True) > 0)
