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

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.measures import Measure

Floats = NDArray[np.float32]
_MISSING = np.float32(-1)


def fill_background(depth: Floats) -> Floats:
    """Returns (H, W) metres in which unknown depths are filled in from their row, or other rows.

    In a row, a gap between two known depths takes the nearer of both, and what is outside the
    outermost known depth takes that one. Empty rows above and below all filled rows take the
    nearest of these; an empty row between filled ones becomes −1, which the kit scores as a depth.

    Args:
        depth: (H, W) metres, 0 where unknown.
    """
    known = depth > 0
    column = np.arange(depth.shape[1])
    left = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    right = np.where(known, column, len(column))[:, ::-1]
    right = np.minimum.accumulate(right, axis=1)[:, ::-1]
    far = np.float32(np.inf)
    padded = np.pad(depth, ((0, 0), (1, 1)), constant_values=far)
    filled = np.minimum(
        np.take_along_axis(padded, left + 1, axis=1), np.take_along_axis(padded, right + 1, axis=1)
    )
    filled = np.where(np.isinf(filled), _MISSING, filled)
    rows = np.flatnonzero(known.any(axis=1))
    if len(rows):
        filled[: rows[0]] = filled[rows[0]]
        filled[rows[-1] + 1 :] = filled[rows[-1]]
    return filled


class _Pixels(NamedTuple):
    """The scored pixels of a frame, (N,) each, in the order in which the kit adds them up."""

    error: Floats
    """|g − p|"""
    log_error: Floats
    """log g − log p"""
    inverse_error: Floats
    """|1/g − 1/p|"""
    gt: Floats

    def mean(self, values: Floats) -> np.float32:
        return _sum(values) / np.float32(len(values))


def _row(
    title: str, formula: Callable[[_Pixels], np.float32 | np.float64], unit: str = ""
) -> Measure:
    key = title.lower().replace(" ", "_")
    return Measure(
        key=key,
        title=title,
        unit=unit,
        decimals=6,
        main=key in ("mae", "rmse", "inverse_mae", "inverse_rmse"),
        formula=lambda pixels: float(formula(pixels)),
    )


def _scale_invariant(pixels: _Pixels) -> np.float32:
    count, total = np.float32(len(pixels.gt)), _sum(pixels.log_error)
    return np.float32(np.sqrt(pixels.mean(pixels.log_error**2) - total * total / (count * count)))


DEVKIT_MEASURES = (
    _row("MAE", lambda p: p.mean(p.error), "m"),
    _row("RMSE", lambda p: np.sqrt(p.mean(p.error * p.error)), "m"),
    _row("inverse MAE", lambda p: p.mean(p.inverse_error), "1/m"),
    _row("inverse RMSE", lambda p: np.sqrt(p.mean(p.inverse_error**2)), "1/m"),
    _row("log MAE", lambda p: p.mean(np.abs(p.log_error))),
    _row("log RMSE", lambda p: np.sqrt(p.mean(p.log_error**2))),
    _row("scale invariant log", _scale_invariant),
    _row("abs relative", lambda p: p.mean(p.error / p.gt)),
    _row("squared relative", lambda p: p.mean(p.error * p.error / (p.gt * p.gt))),
)
"""Measures in the kit's order, with its six decimals. Its squared relative is (p − g)²/g²."""


def devkit_errors(predicted: Floats, gt: Floats) -> dict[str, float]:
    """Returns the measures of one frame; the logarithmic ones are NaN where the fill left −1.

    Args:
        predicted: (H, W) metres, 0 where unknown.
        gt: (H, W) metres, 0 where unknown; some of it known.
    """
    filled = fill_background(predicted)
    known = gt.T > 0  # the kit walks down each column
    p, g = filled.T[known], gt.T[known]
    with np.errstate(invalid="ignore"):
        inverse_error = np.abs(1.0 / g.astype(np.float64) - 1.0 / p.astype(np.float64))
        pixels = _Pixels(
            error=np.abs(g - p),
            log_error=_log(g) - _log(p),
            inverse_error=inverse_error.astype(np.float32),
            gt=g,
        )
        return {measure.key: measure.value(pixels) for measure in DEVKIT_MEASURES}


def devkit_mean(values: NDArray[Any]) -> NDArray[np.float64]:
    """Returns (M,) the mean of (N, M) values of N frames, summed in order in single precision."""
    total = np.cumsum(values, axis=0, dtype=np.float32)[-1] / np.float32(len(values))
    return np.asarray(total, np.float64)


def _sum(values: Floats) -> np.float32:
    # cumsum adds one after the other; sum would add in pairs
    return np.float32(np.cumsum(values, dtype=np.float32)[-1])


def _log(values: Floats) -> Floats:
    """The natural logarithm rounded once to single precision, as C's logf nearly always does."""
    return np.log(values, dtype=np.float64).astype(np.float32)
