"""The error measures of depth estimation: of an image, and of many images.

Definitions: Eigen et al. 2014 (RMSE, RMSE of the logarithm, AbsRel = MRE, SqRel, δ < 1.25^k,
SILog), the paper and NYU's tables (log10), the KITTI depth completion benchmark (iRMSE, iMAE).
The paper's KITTI rows use δ thresholds of 1.01^k; the thresholds are an argument here.

Every measure is a function of sums over pixels. So either the sums of several images are added
(all pixels have equal weight), or the measures are averaged (all images have equal weight).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

DELTA_THRESHOLDS = (1.25, 1.25**2, 1.25**3)
"""Thresholds of δ1 to δ3 (Eigen et al. 2014)."""

_CHUNK = 1 << 20
"""Pixels processed at once, so that memory is bounded for any image."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A measure and how it is shown."""

    key: str
    title: str
    unit: str = ""
    higher_is_better: bool = False
    decimals: int = 4
    percent: bool = False
    shown_unit: str = ""  # unit in tables; empty: `unit`, which is that in files
    shown_factor: float = 1.0  # factor from `unit` to the unit in tables


MEASURES = (
    Measure(key="rmse", title="RMSE", unit="m"),
    Measure(key="mae", title="MAE", unit="m"),
    Measure(key="mre", title="MRE"),
    Measure(key="sq_rel", title="SqRel", unit="m"),
    Measure(key="log10", title="log10"),
    Measure(key="rmse_log", title="RMSE log"),
    Measure(key="irmse", title="iRMSE", unit="1/km", decimals=2),
    Measure(key="imae", title="iMAE", unit="1/km", decimals=2),
    Measure(key="silog", title="SILog", unit="100·log m", decimals=2),
    Measure(key="delta1", title="δ1", higher_is_better=True, percent=True, decimals=2),
    Measure(key="delta2", title="δ2", higher_is_better=True, percent=True, decimals=2),
    Measure(key="delta3", title="δ3", higher_is_better=True, percent=True, decimals=2),
)
"""All measures, in the order of `measures_of`."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Errors of a prediction p over the pixels with known ground truth g and valid p."""

    rmse: float
    """√ mean (p − g)², metres."""
    mae: float
    """Mean |p − g|, metres."""
    mre: float
    """Mean |p − g|/g."""
    sq_rel: float
    """Mean (p − g)²/g, metres."""
    log10: float
    """Mean |log10 p − log10 g|."""
    rmse_log: float
    """√ mean (log p − log g)², natural logarithm."""
    irmse: float
    """√ mean (1/p − 1/g)², 1/km."""
    imae: float
    """Mean |1/p − 1/g|, 1/km."""
    silog: float
    """100 · standard deviation of log p − log g."""
    delta1: float
    """Fraction of pixels with max(p/g, g/p) below the first threshold."""
    delta2: float
    """The same for the second threshold."""
    delta3: float
    """The same for the third threshold."""
    pixels: int
    """Number of scored pixels."""
    coverage: float
    """Scored pixels over pixels with known ground truth."""


def score(
    predicted: Tensor,
    ground_truth: Tensor,
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS,
) -> Scores:
    """Returns the scores of a prediction against the ground truth.

    Args:
        predicted: Depth in metres, of any shape; 0, negative or not finite where missing.
        ground_truth: Ground truth depth of the same shape, likewise.
        thresholds: Of δ1 to δ3.
    """
    sums = error_sums(predicted, ground_truth, thresholds)
    values = measures_of(sums).tolist()
    pixels, known = int(sums[SUMS.index("pixels")]), int(sums[SUMS.index("known")])
    return Scores(
        **{measure.key: value for measure, value in zip(MEASURES, values, strict=True)},
        pixels=pixels,
        coverage=pixels / known if known else math.nan,
    )


def error_sums(
    predicted: Tensor,
    ground_truth: Tensor,
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS,
) -> Tensor:
    """Returns the sums over an image, (len(SUMS),) float64; arguments as of `score`."""
    if predicted.shape != ground_truth.shape:
        raise ValueError(
            f"prediction is {tuple(predicted.shape)}, ground truth {tuple(ground_truth.shape)}"
        )
    sums = torch.zeros(len(SUMS), dtype=torch.float64, device=ground_truth.device)
    predicted, ground_truth = predicted.reshape(-1), ground_truth.reshape(-1)
    for start in range(0, ground_truth.numel(), _CHUNK):
        piece = slice(start, start + _CHUNK)
        p, g = predicted[piece].double(), ground_truth[piece].double()
        known = g.isfinite() & (g > 0)
        scored = known & p.isfinite() & (p > 0)
        terms = _terms(p[scored], g[scored], thresholds)
        added = {name: term.sum() for name, term in terms.items()} | {"known": known.sum()}
        sums += torch.stack([added[name].double() for name in SUMS])
    return sums


def _terms(p: Tensor, g: Tensor, thresholds: tuple[float, float, float]) -> dict[str, Tensor]:
    """The summands of each of N scored pixels, (N,) float64 each."""
    error, log_error, inverse_error = p - g, p.log() - g.log(), 1 / p - 1 / g
    ratio = torch.maximum(p / g, g / p)
    return {
        "pixels": torch.ones_like(p),
        "squared": error.square(),
        "absolute": error.abs(),
        "relative": error.abs() / g,
        "squared_relative": error.square() / g,
        "log": log_error,
        "log_absolute": log_error.abs(),
        "log_squared": log_error.square(),
        "inverse": inverse_error.abs(),
        "inverse_squared": inverse_error.square(),
        **{f"delta{k}": (ratio < limit).double() for k, limit in enumerate(thresholds, start=1)},
    }


_SUMMED = tuple(_terms(torch.empty(0), torch.empty(0), DELTA_THRESHOLDS))
SUMS = ("pixels", "known", *_SUMMED[1:])
"""The quantities summed over pixels, in the order of the last axis of sums tensors."""


def measures_of(sums: Tensor) -> Tensor:
    """Returns measures (…, len(MEASURES)) of sums (…, len(SUMS)); NaN where no pixel was scored."""
    of = dict(zip(SUMS, sums.unbind(-1), strict=True))
    mean = {name: total / of["pixels"] for name, total in of.items()}
    measures = {
        "rmse": mean["squared"].sqrt(),
        "mae": mean["absolute"],
        "mre": mean["relative"],
        "sq_rel": mean["squared_relative"],
        "log10": mean["log_absolute"] / math.log(10),
        "rmse_log": mean["log_squared"].sqrt(),
        "irmse": 1000 * mean["inverse_squared"].sqrt(),
        "imae": 1000 * mean["inverse"],
        "silog": 100 * (mean["log_squared"] - mean["log"].square()).clamp_min(0).sqrt(),
        **{f"delta{k}": mean[f"delta{k}"] for k in (1, 2, 3)},
    }
    return torch.stack([measures[measure.key] for measure in MEASURES], dim=-1)
