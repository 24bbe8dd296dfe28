"""Measures beyond the standard ones: `pnpdepth eval --measures`.

One decorated function adds a group of measures: it takes a frame and returns their values in the
order of the decorator, NaN where the frame has none. `choices.MEASURE_GROUPS` lists the names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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
    intrinsics: Floats | None = None
    """(3, 3)"""
    sparse: Depth | None = None
    previous: MeasuredFrame | None = None
    """The frame before in the same sequence; None for the first."""

    @property
    def both(self) -> Mask:
        """(H, W) true where prediction and ground truth are known."""
        return (self.depth > 0) & (self.gt > 0)

    def points(self, depth: Depth) -> Floats:
        """Returns (H, W, 3) metres in the camera's frame of each pixel of a depth map."""
        assert self.intrinsics is not None
        y, x = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float64)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(self.intrinsics).T
        return np.asarray(rays * depth[..., None].astype(np.float64))


Values = Callable[[MeasuredFrame], tuple[float, ...]]


@dataclass(frozen=True, kw_only=True)
class MeasureGroup:
    """Measures that are computed together."""

    measures: tuple[Measure, ...]
    values: Values
    needs: Literal["nothing", "intrinsics", "sparse"] = "nothing"
    in_sequences: bool = False


TABLE: dict[str, MeasureGroup] = {}


def measures(
    name: str,
    *listed: Measure,
    needs: Literal["nothing", "intrinsics", "sparse"] = "nothing",
    in_sequences: bool = False,
) -> Callable[[Values], Values]:
    """Enters the decorated function in the table, as the group `name` of the listed measures."""

    def enter(function: Values) -> Values:
        TABLE[name] = MeasureGroup(
            measures=listed, values=function, needs=needs, in_sequences=in_sequences
        )
        return function

    return enter


def mean_of(values: NDArray[np.generic], weights: Floats | None = None) -> float:
    """Returns the mean, weighted or not; NaN of nothing."""
    if not values.size:
        return math.nan
    return float(np.average(values.astype(np.float64), weights=weights))


def distance_px(seeds: Mask) -> Depth:
    """Returns (H, W) pixels to the nearest true pixel; infinite where there is none."""
    if not seeds.any():
        return np.full(seeds.shape, np.inf, np.float32)
    apart = cv2.distanceTransform((~seeds).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(apart, np.float32)


BANDS_M = ((0, 5), (5, 10), (10, 20), (20, 40), (40, 80))
BANDS_PX = ((0, 2), (2, 8), (8, 32), (32, 100_000))


@measures(
    "area",
    Measure(key="area_mae", title="MAE by area", unit="m"),
    Measure(key="area_mre", title="MRE by area"),
    *(Measure(key=f"mae_{a}_{b}", title=f"MAE {a}–{b} m", unit="m") for a, b in BANDS_M),
)
def area_errors(frame: MeasuredFrame) -> tuple[float, ...]:
    """MAE and MRE by the surface that a pixel covers, proportional to g²; MAE by bands of range."""
    g = frame.gt[frame.both].astype(np.float64)
    error = np.abs(frame.depth[frame.both] - g)
    bands = (mean_of(error[(g >= low) & (g < high)]) for low, high in BANDS_M)
    return mean_of(error, g**2), mean_of(error / g, g**2), *bands


@measures(
    "distance",
    *(
        Measure(key=f"mae_from_{a}_px", title=f"MAE {a}–{b} px" if b < 1000 else f"MAE from {a} px",
                unit="m")
        for a, b in BANDS_PX
    ),
    needs="sparse",
)  # fmt: skip
def distance_errors(frame: MeasuredFrame) -> tuple[float, ...]:
    """MAE by bands of distance to the nearest sparse point."""
    assert frame.sparse is not None
    apart = distance_px(frame.sparse > 0)[frame.both]
    error = np.abs(frame.depth[frame.both].astype(np.float64) - frame.gt[frame.both])
    return tuple(mean_of(error[(apart >= low) & (apart < high)]) for low, high in BANDS_PX)


@measures(
    "flicker",
    Measure(key="flicker", title="flicker", unit="m"),
    Measure(key="scale_flicker", title="scale flicker"),
    in_sequences=True,
)
def flicker(frame: MeasuredFrame) -> tuple[float, ...]:
    """Change of the error, and of log(prediction / ground truth), since the frame before.

    As TCC of Zhang et al. 2019, with the absolute difference instead of a structural similarity.
    """
    before = frame.previous
    if before is None or before.gt.shape != frame.gt.shape:
        return math.nan, math.nan
    both = frame.both & before.both
    errors = [f.depth[both].astype(np.float64) - f.gt[both] for f in (before, frame)]
    scales = [
        float(np.log(np.median(f.depth[f.both].astype(np.float64) / f.gt[f.both])))
        if f.both.any()
        else math.nan
        for f in (before, frame)
    ]
    return mean_of(np.abs(errors[1] - errors[0])), abs(scales[1] - scales[0])


CLOUD_THRESHOLD_M = 0.1
"""A point is right if the other cloud has one within this distance (Spencer et al. 2022)."""
_MOST_POINTS = 30_000
"""Of each cloud that look for their nearest neighbour, evenly picked; it looks in all points."""


@measures(
    "cloud",
    Measure(key="chamfer", title="chamfer", unit="m"),
    Measure(key="f_score", title="F-score 0.1 m", percent=True, decimals=1, higher_is_better=True),
    needs="intrinsics",
)
def cloud_errors(frame: MeasuredFrame) -> tuple[float, ...]:
    """Chamfer distance and F-score of the points (Örnek et al. 2022; Spencer et al. 2022)."""
    both = frame.both
    if not both.any():
        return math.nan, math.nan
    predicted, true = (frame.points(depth)[both] for depth in (frame.depth, frame.gt))
    every = math.ceil(len(true) / _MOST_POINTS)
    accuracy = cKDTree(true).query(predicted[::every])[0]
    completeness = cKDTree(predicted).query(true[::every])[0]
    precision, recall = (float(np.mean(d < CLOUD_THRESHOLD_M)) for d in (accuracy, completeness))
    total = precision + recall
    return (
        float(accuracy.mean() + completeness.mean()) / 2,
        2 * precision * recall / total if total else 0.0,
    )


BOUNDARY_FAR_PX = 10.0
_BOUNDARY_SIGMA_PX = math.sqrt(2)
_CANNY_LOW, _CANNY_HIGH = 0.15, 0.3
_LEAST_KNOWN = 0.5
"""Fraction of the pixels of a frame, or of a tile, whose depth has to be known."""
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


TILE_PX = 24
_FLAT = 0.005
"""Of the mean distance: the spread up to which a tile of the ground truth is a plane."""


@measures(
    "normals",
    Measure(key="normal_angle", title="normals", unit="°", decimals=2),
    *(
        Measure(key=f"normal_{limit:.0f}", title=f"normals < {limit:g}°", percent=True, decimals=1,
                higher_is_better=True)
        for limit in (11.25, 30)
    ),
    Measure(key="planarity", title="planarity", unit="m"),
    Measure(key="plane_angle", title="plane angle", unit="°", decimals=2),
    needs="intrinsics",
)  # fmt: skip
def surface_errors(frame: MeasuredFrame) -> tuple[float, ...]:
    """Angles of normals to the ground truth's, and planarity of tiles.

    Normals: Fouhey et al. 2013, Eigen and Fergus 2015. Planarity: the spread of the prediction
    about its own plane, and the angle of that plane (iBims-1, Koch et al. 2018), on tiles that are
    planes in the ground truth rather than on annotated ones.
    """
    both = frame.both
    predicted, true = frame.points(frame.depth), frame.points(frame.gt)
    normals, known = normals_of(predicted, both)
    angles = _angles_deg(normals[known], normals_of(true, both)[0][known])
    spreads, tilts = [], []
    for y in range(0, both.shape[0] - TILE_PX + 1, TILE_PX):
        for x in range(0, both.shape[1] - TILE_PX + 1, TILE_PX):
            tile = slice(y, y + TILE_PX), slice(x, x + TILE_PX)
            inside = both[tile]
            if inside.mean() < _LEAST_KNOWN:
                continue
            gt_points = true[tile][inside]
            gt_spread, gt_normal = _plane(gt_points)
            if gt_spread <= _FLAT * np.linalg.norm(gt_points.mean(axis=0)):
                spread, normal = _plane(predicted[tile][inside])
                spreads.append(spread)
                tilts.append(_angles_deg(normal[None], gt_normal[None])[0])
    fractions = (mean_of(angles < limit) for limit in (11.25, 30))
    return mean_of(angles), *fractions, mean_of(np.array(spreads)), mean_of(np.array(tilts))


def normals_of(points: Floats, known: Mask) -> tuple[Floats, Mask]:
    """Returns (H, W, 3) unit normals and (H, W) where they are known.

    Args:
        points: (H, W, 3) metres.
        known: (H, W) true where points are known; a normal needs all four neighbours.
    """
    normals, has_one = np.zeros_like(points), np.zeros_like(known)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    crossed = np.cross(across, down)
    length = np.linalg.norm(crossed, axis=-1)
    around = known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1]
    has_one[1:-1, 1:-1] = known[1:-1, 1:-1] & around & (length > 0)
    normals[1:-1, 1:-1] = crossed / np.where(length > 0, length, 1)[..., None]
    return normals, has_one


def _plane(points: Floats) -> tuple[float, Floats]:
    """The standard deviation of (N, 3) points from their plane of least squares, and its normal."""
    centred = points - points.mean(axis=0)
    variances, axes = np.linalg.eigh(centred.T @ centred / len(points))
    return math.sqrt(max(0.0, float(variances[0]))), axes[:, 0]


def _angles_deg(a: Floats, b: Floats) -> Floats:
    """(N,) degrees between (N, 3) unit vectors, whichever way they point."""
    cosines = np.abs((a * b).sum(axis=-1)).clip(max=1.0)
    return np.asarray(np.degrees(np.arccos(cosines)))
