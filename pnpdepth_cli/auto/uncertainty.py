"""The standard deviation of a depth map, calibrated by held-out points (`--uncertainty`)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.auto.auto import AutoRefined
from pnpdepth_cli.frames.frame import DepthMap

MIN_INLIER_WEIGHT = 0.05
"""Held-out points with less weight do not calibrate."""
CALIBRATION_RANGE = (0.01, 1000.0)
"""Bounds of the calibration factor, whatever a few points give."""
_WITHIN_ONE_SIGMA = 0.68


def uncertainty(result: AutoRefined, depth: DepthMap) -> tuple[DepthMap, str]:
    """Returns the standard deviation (H, W) of a depth map in metres, and a note on calibration.

    The Gaussian process gives its shape over the image. The held-out points give the factor: 68 %
    of them are within ± one standard deviation.

    Args:
        result: The refined frame with its folds.
        depth: (H, W) metres.
    """
    relative = result.depths.relative_sigma()
    if not result.folds:
        note = "uncertainty: too few points to calibrate it with"
        return (relative.numpy() * depth).astype(np.float32), note
    per_fold = []
    for fold in result.folds:
        predicted = fold.predicted(result.choice)
        sigma = fold.held_out.sample(fold.depths.relative_sigma())
        good = (fold.inlier_weights > MIN_INLIER_WEIGHT) & (predicted > 0) & (sigma > 0)
        residual = fold.held_out.depth[good].log() - predicted[good].log()
        per_fold.append(torch.stack([residual, sigma[good]]))
    residual, sigma = torch.cat(per_fold, dim=1)
    low, high = CALIBRATION_RANGE
    factor = min(max(calibration(residual, sigma), low), high)
    note = f"uncertainty: calibrated with {len(residual):,} held-out points (factor {factor:.2f})"
    return (factor * relative.numpy() * depth).astype(np.float32), note


def calibration(residual: Tensor, sigma: Tensor) -> float:
    """Returns the factor of sigma with which 68 % of the residuals lie within ± one sigma.

    One more residual lies within as often as that, however few there are (split conformal
    prediction, Lei et al., "Distribution-free predictive inference for regression", 2018).

    Args:
        residual: (M,) true − predicted at points held out of refinement and propagation.
        sigma: (M,) their standard deviations, in the same unit.

    Returns:
        The factor; 1.0 without any finite residual.
    """
    ratio = (residual.double().abs() / sigma.double()).flatten()
    ratio = ratio[ratio.isfinite()]
    if not len(ratio):
        return 1.0
    rank = math.ceil(_WITHIN_ONE_SIGMA * (len(ratio) + 1))
    return float(ratio.sort().values[min(rank, len(ratio)) - 1])
