"""Scales the prediction of one image to its ground truth, by the published conventions.

Relative networks give depth or disparity up to a factor, or a factor and a shift. Papers fit these
to the ground truth of each image before they score:

- median: Zhou et al. 2017, monodepth2.
- affine: least squares in depth, Marigold (Ke et al. 2024).
- affine-disparity: least squares in 1/m, MiDaS (Ranftl et al. 2020).
- log: the mean of the logarithm, Eigen et al. 2014.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError

Depth = NDArray[np.float32]


class Fit(NamedTuple):
    """depth = factor · predicted + shift, or the same in disparity (1/m)."""

    factor: float
    shift: float = 0.0


def scaled(values: Depth, gt: Depth, kind: str, scale_by: str) -> tuple[Depth, Fit | None]:
    """Returns the prediction in metres, fitted to the ground truth of its image, and the fit.

    A fitted depth or disparity that is not above 0 becomes unknown (0).

    Args:
        values: (H, W) predictions of the kind, 0 where unknown.
        gt: (H, W) ground truth in metres, 0 where it is not scored.
        kind: One of choices.PREDICTION_KINDS.
        scale_by: One of choices.SCALINGS.

    Raises:
        InputError: If fewer than two pixels have both, or the prediction is constant.
    """
    depth = _inverse(values) if kind == "disparity" else values
    if scale_by == "none":
        return depth, None
    both = (gt > 0) & (depth > 0)
    if np.count_nonzero(both) < 2:
        raise InputError(f"--scale-by {scale_by} needs 2 pixels with ground truth and prediction")
    g = gt[both].astype(np.float64)
    if scale_by == "median":
        fit = Fit(factor=float(np.median(g) / np.median(depth[both].astype(np.float64))))
    elif scale_by == "log":
        log_ratio = np.log(g) - np.log(depth[both].astype(np.float64))
        fit = Fit(factor=float(np.exp(log_ratio.mean())))
    elif scale_by == "affine":
        fit = _least_squares(depth[both], g)
    else:
        disparity = values if kind == "disparity" else _inverse(depth)
        fit = _least_squares(disparity[both], 1 / g)
        return _inverse(_applied(disparity, fit)), fit
    return _applied(depth, fit), fit


def _applied(values: Depth, fit: Fit) -> Depth:
    fitted = values * np.float64(fit.factor) + fit.shift
    return np.where((values > 0) & (fitted > 0), fitted, 0).astype(np.float32)


def _least_squares(predicted: Depth, target: NDArray[np.float64]) -> Fit:
    """The factor and shift of least squared error, from the normal equations."""
    p = predicted.astype(np.float64)
    variance = float(p.var())
    if variance == 0:
        raise InputError("the prediction is constant, so that no scale and shift can be fitted")
    factor = float(((p - p.mean()) * (target - target.mean())).mean()) / variance
    return Fit(factor=factor, shift=float(target.mean() - factor * p.mean()))


def _inverse(values: Depth) -> Depth:
    known = values > 0
    return np.where(known, 1 / np.where(known, values, 1).astype(np.float64), 0).astype(np.float32)
