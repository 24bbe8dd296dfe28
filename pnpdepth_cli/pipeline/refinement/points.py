"""Sparse points of a frame: which are held out, and the error of a depth map at points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import DepthMap
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class PointError:
    """Error of a depth map at sparse points."""

    points: int
    """Number of points where there is depth."""
    mae: float
    """Mean absolute error, metres."""
    rmse: float
    """Root mean square error, metres."""


def split_points(
    points: SparsePoints, holdout: float, seed: int
) -> tuple[SparsePoints, SparsePoints]:
    """Returns (points to use, points held out).

    Args:
        points: All points.
        holdout: Fraction of the points to hold out at random; at least one unless it is 0.
        seed: Of the choice.

    Raises:
        UsageError: The fraction is not in 0…1, or there are too few points for it.
    """
    if not 0 <= holdout < 1:
        raise UsageError(f"holdout {holdout} is not a fraction of the points; give 0 ≤ F < 1")
    mask = torch.zeros(len(points), dtype=torch.bool)
    if holdout > 0:
        if len(points) < 2:
            raise UsageError("holdout needs at least two sparse points")
        count = min(max(1, round(holdout * len(points))), len(points) - 1)
        order = np.random.default_rng(seed).permutation(len(points))
        mask[torch.from_numpy(order[:count])] = True
    return points.select(~mask), points.select(mask)


def point_error(depth: DepthMap, points: SparsePoints) -> PointError | None:
    """Returns the error of depth (H, W) at points of its frame; None where it is unknown at all."""
    predicted = points.sample(torch.from_numpy(depth))
    error = (predicted - points.depth)[predicted > 0].double()
    if not len(error):
        return None
    return PointError(
        points=len(error), mae=float(error.abs().mean()), rmse=float(error.square().mean().sqrt())
    )
