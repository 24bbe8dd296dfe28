"""Computes the figures that KITTI's depth development kit prints, digit for digit.

Definitions: the kit's readme and its `evaluate_depth` (Uhrig et al., Sparsity Invariant CNNs, 3DV
2017; devkit of cvlibs.net/datasets/kitti/eval_depth.php). A missing prediction is filled from its
row, then from its column; all ground truth is scored. The kit computes in single precision and adds
up pixel by pixel, column by column, which shows in the fifth digit; this does the same.

Units are the kit's own: metres, 1/m, and no factor on the logarithmic and relative errors. KITTI's
web pages multiply: RMSE and MAE by 1000 (mm), the inverse errors by 1000 (1/km), SILog and the
relative errors by 100.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.measures import DEVKIT_MEASURES

Floats = NDArray[np.float32]


def fill_background(depth: Floats) -> Floats:
    """Returns (H, W) metres in which unknown depths are filled in from their row, or other rows.

    This is how KITTI's development kit fills in a prediction. In a row, a gap between two known
    depths takes the smaller of both, and what is outside the outermost known depth takes that one.
    Rows without a known depth that lie above or below all filled rows take the nearest of these.
    Such a row between filled ones becomes −1, which the kit scores as a depth.

    Args:
        depth: (H, W) metres, 0 where unknown.
    """
    filled = np.full_like(depth, -1)
    column = np.arange(depth.shape[1])
    rows = np.flatnonzero((depth > 0).any(axis=1))
    for row in rows:
        # The columns with a known depth that are next to each column, at its left and its right.
        # Both are the column itself if it is known. Beyond the outermost, both are the outermost.
        known = np.flatnonzero(depth[row] > 0)
        left = np.searchsorted(known, column, side="right") - 1
        right = np.searchsorted(known, column)
        ends = known[np.clip([left, right], 0, len(known) - 1)]  # (2, columns)
        filled[row] = depth[row, ends].min(axis=0)
    # Rows above the first filled one, and below the last.
    if len(rows):
        filled[: rows[0]] = filled[rows[0]]
        filled[rows[-1] + 1 :] = filled[rows[-1]]
    return filled


def devkit_errors(predicted: Floats, gt: Floats) -> dict[str, float]:
    """Returns the measures of one frame; the logarithmic ones are NaN where the fill left −1.

    Args:
        predicted: (H, W) metres, 0 where unknown.
        gt: (H, W) metres, 0 where unknown; some of it known.

    Returns:
        Values by the keys of `measures.DEVKIT_MEASURES`.
    """
    # The scored pixels (N,). The kit adds up down each column, an order that transposing gives.
    is_scored = gt.T > 0
    depth = fill_background(predicted).T[is_scored]
    truth = gt.T[is_scored]
    error = np.abs(truth - depth)
    with np.errstate(invalid="ignore"):
        # logarithms rounded once to single precision, as C's logf nearly always does
        log_truth = np.log(truth, dtype=np.float64).astype(np.float32)
        log_depth = np.log(depth, dtype=np.float64).astype(np.float32)
        log_error = log_truth - log_depth
        inverse = 1.0 / truth.astype(np.float64) - 1.0 / depth.astype(np.float64)
        inverse_error = np.abs(inverse).astype(np.float32)
        # The errors in the order of DEVKIT_MEASURES, which is the kit's.
        count = np.float32(len(truth))
        log_squares = _sum(log_error**2) / count
        log_total = _sum(log_error)
        values = (
            _sum(error) / count,  # MAE
            np.sqrt(_sum(error * error) / count),  # RMSE
            _sum(inverse_error) / count,  # inverse MAE
            np.sqrt(_sum(inverse_error**2) / count),  # inverse RMSE
            _sum(np.abs(log_error)) / count,  # log MAE
            np.sqrt(log_squares),  # log RMSE
            np.sqrt(log_squares - log_total * log_total / (count * count)),  # scale invariant log
            _sum(error / truth) / count,  # abs relative
            _sum(error * error / (truth * truth)) / count,  # squared relative
        )
    return {
        measure.key: float(value) for measure, value in zip(DEVKIT_MEASURES, values, strict=True)
    }


def devkit_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns (M,) the mean of (N, M) values of N frames, summed in order in single precision."""
    return np.asarray(_sum(values) / np.float32(len(values)), float)


def _sum(values: NDArray[np.floating]) -> Floats:
    """The sum over the first axis in single precision, one number after the other.

    So adds KITTI's development kit, whose rounding this repeats.
    """
    # NumPy's sum would add in pairs, which rounds otherwise.
    return np.asarray(np.cumsum(values, axis=0, dtype=np.float32)[-1])
