"""Surface normals and planarity, of the points that depth and intrinsics give.

Normals: the angle to the ground truth's (Fouhey et al. 2013; Eigen and Fergus 2015), both from
differences of neighbouring points. Planarity: the spread of the prediction about its own plane, and
the angle of that plane (iBims-1, Koch et al. 2018), on tiles that are planes in the
ground truth rather than on annotated ones.
"""

from __future__ import annotations

import math

import numpy as np

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.pipeline.evaluation.measured_frame import (
    Floats,
    Mask,
    MeasuredFrame,
    MeasureGroup,
    mean_of,
)

TILE_PX = 24
_LEAST_KNOWN = 0.5
"""Fraction of a tile whose depths have to be known."""
_FLAT = 0.005
"""Of the mean distance: the spread up to which a tile of the ground truth is a plane."""


def surface_errors(frame: MeasuredFrame) -> dict[str, float]:
    """Returns angles of normals and planes in degrees, and planarity in metres."""
    predicted, true = frame.points(frame.depth), frame.points(frame.gt)
    normals, known = normals_of(predicted, frame.both)
    gt_normals, _ = normals_of(true, frame.both)
    angles = _angles_deg(normals[known], gt_normals[known])
    planes = [
        (spread, _angles_deg(normal[None], gt_normal[None])[0])
        for tile in _tiles(frame.both.shape)
        if (fitted := _planes(predicted[tile], true[tile], frame.both[tile])) is not None
        for spread, normal, gt_normal in (fitted,)
    ]
    spreads, tilts = np.array(planes).reshape(-1, 2).T
    return {
        "normal_angle": mean_of(angles),
        "normal_11": mean_of(angles < 11.25),
        "normal_30": mean_of(angles < 30),
        "planarity": mean_of(spreads),
        "plane_angle": mean_of(tilts),
    }


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


def _planes(points: Floats, true: Floats, known: Mask) -> tuple[float, Floats, Floats] | None:
    """(spread of the prediction about its plane, its normal, the true normal) of a planar tile."""
    if known.mean() < _LEAST_KNOWN:
        return None
    gt_spread, gt_normal = _plane(true[known])
    if gt_spread > _FLAT * np.linalg.norm(true[known].mean(axis=0)):
        return None
    spread, normal = _plane(points[known])
    return spread, normal, gt_normal


def _plane(points: Floats) -> tuple[float, Floats]:
    """The standard deviation of (N, 3) points from their plane of least squares, and its normal."""
    centred = points - points.mean(axis=0)
    variances, axes = np.linalg.eigh(centred.T @ centred / len(points))
    return math.sqrt(max(0.0, float(variances[0]))), axes[:, 0]


def _tiles(size: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """All whole tiles of an image (H, W); the rest at its right and lower border is left out."""
    height, width = size
    return [
        (slice(y, y + TILE_PX), slice(x, x + TILE_PX))
        for y in range(0, height - TILE_PX + 1, TILE_PX)
        for x in range(0, width - TILE_PX + 1, TILE_PX)
    ]


def _angles_deg(a: Floats, b: Floats) -> Floats:
    """(N,) degrees between (N, 3) unit vectors, whichever way they point."""
    cosines = np.abs((a * b).sum(axis=-1)).clip(max=1.0)
    return np.asarray(np.degrees(np.arccos(cosines)))


GROUP = MeasureGroup(
    measures=(
        Measure(key="normal_angle", title="normals", unit="°", decimals=2),
        Measure(
            key="normal_11", title="normals < 11.25°", percent=True, decimals=1,
            higher_is_better=True,
        ),
        Measure(
            key="normal_30", title="normals < 30°", percent=True, decimals=1, higher_is_better=True
        ),
        Measure(key="planarity", title="planarity", unit="m"),
        Measure(key="plane_angle", title="plane angle", unit="°", decimals=2),
    ),
    values=surface_errors,
    needs="intrinsics",
)  # fmt: skip
