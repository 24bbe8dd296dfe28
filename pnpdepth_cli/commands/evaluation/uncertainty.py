"""Measures whether a predicted standard deviation is right: calibration and sparsification.

Calibration: the fraction of errors within k standard deviations, against that of a normal
distribution. Sparsification: the mean absolute error of the pixels that remain when the most
uncertain ones are removed, against removing those with the largest error (Ilg et al., ECCV 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

Depth = NDArray[np.float32]
Floats = NDArray[np.float64]

ONE_SIGMA, TWO_SIGMA = (float(2 * norm.cdf(k) - 1) for k in (1, 2))
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, ONE_SIGMA, 0.8, 0.9, TWO_SIGMA, 0.99)
REMOVED = tuple(n / 20 for n in range(20))
"""Fractions of the pixels."""


class FrameUncertainty(NamedTuple):
    """What one frame contributes."""

    pixels: int
    """With prediction, ground truth and standard deviation."""
    within: Floats
    """(LEVELS,) how many errors lie within the interval of each probability."""
    sparsification: Floats
    """(REMOVED,) mean absolute error, metres, without the most uncertain pixels."""
    oracle: Floats
    """(REMOVED,) the same without the pixels of largest error."""


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """Calibration over the pixels of all frames, and the mean sparsification of the frames."""

    frames: int
    pixels: int
    within_1_sigma: float
    """Fraction of errors within one standard deviation; 0.683 if calibrated."""
    within_2_sigma: float
    """Within two; 0.954 if calibrated."""
    ause: float
    """Area between sparsification and oracle, in units of the error of all pixels; 0 is best."""
    expected: tuple[float, ...]
    """LEVELS, the calibration curve's."""
    observed: tuple[float, ...]
    """Fraction of errors within the interval of each."""
    removed: tuple[float, ...]
    """REMOVED, the sparsification curve's."""
    sparsification: tuple[float, ...]
    oracle: tuple[float, ...]


def frame_uncertainty(depth: Depth, gt: Depth, sigma: Depth) -> FrameUncertainty | None:
    """Returns what a frame contributes; None if no pixel has all three.

    Args:
        depth: (H, W) predictions in metres, 0 where unknown.
        gt: (H, W) ground truth in metres, 0 where not scored.
        sigma: (H, W) standard deviations in metres, 0 where unknown.
    """
    known = (gt > 0) & (depth > 0) & (sigma > 0)
    if not known.any():
        return None
    error = np.abs(depth[known].astype(np.float64) - gt[known])
    deviation = sigma[known].astype(np.float64)
    ratio = np.sort(error / deviation)
    limits = norm.ppf((1 + np.array(LEVELS)) / 2)
    return FrameUncertainty(
        pixels=len(error),
        within=np.searchsorted(ratio, limits, side="right").astype(np.float64),
        sparsification=_curve(error[np.argsort(deviation, kind="stable")]),
        oracle=_curve(np.sort(error)),
    )


def summarise_uncertainty(frames: Sequence[FrameUncertainty]) -> Uncertainty | None:
    """Returns the calibration and sparsification of all frames; None without any."""
    if not frames:
        return None
    pixels, within, by_sigma, by_error = zip(*frames, strict=True)
    observed = np.sum(within, axis=0) / sum(pixels)
    sparsification, oracle = np.mean(by_sigma, axis=0), np.mean(by_error, axis=0)
    area = float(np.trapezoid(sparsification - oracle, REMOVED))
    by_level = dict(zip(LEVELS, observed.tolist(), strict=True))
    return Uncertainty(
        frames=len(frames),
        pixels=sum(pixels),
        within_1_sigma=by_level[ONE_SIGMA],
        within_2_sigma=by_level[TWO_SIGMA],
        ause=area / float(sparsification[0]) if sparsification[0] else 0.0,
        expected=LEVELS,
        observed=tuple(observed.tolist()),
        removed=REMOVED,
        sparsification=tuple(sparsification.tolist()),
        oracle=tuple(oracle.tolist()),
    )


def _curve(errors: Floats) -> Floats:
    """(REMOVED,) means of the errors, in order, without so large a fraction at the end."""
    kept = np.maximum(1, np.round((1 - np.array(REMOVED)) * len(errors))).astype(int)
    return np.asarray(np.cumsum(errors)[kept - 1] / kept)
