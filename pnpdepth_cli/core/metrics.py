"""The error measures of depth estimation: of a picture, of many together, of parts of one.

Definitions: Eigen et al. 2014 (RMSE, RMSE of the logarithm, AbsRel = MRE, SqRel, δ < 1.25^k,
SILog), the paper and NYU's tables (log10), the KITTI depth completion benchmark (iRMSE, iMAE).
The paper's KITTI rows use δ thresholds of 1.01^k; here that is a choice of the thresholds.

Every measure is a function of sums over pixels. So the sums of several pictures can be added
before (all pixels count alike) or the measures averaged after (all pictures count alike).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

DELTA_THRESHOLDS = (1.25, 1.25**2, 1.25**3)
"""Eigen et al. 2014."""

SUMS = (
    "pixels",
    "known",
    "squared",
    "absolute",
    "relative",
    "squared_relative",
    "log",
    "log_absolute",
    "log_squared",
    "inverse",
    "inverse_squared",
    "delta1",
    "delta2",
    "delta3",
)
"""What is added up over the pixels, in the order of the tensors that hold it."""

_CHUNK = 1 << 20
"""Pixels worked on at once, so that memory stays bounded for any picture."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """One measure for a person: its key in files, title and the unit its values are stored in.

    A table shows value × shown_factor in shown_unit (the unit itself where that is empty), with so
    many decimals; `percent` shows a share as per cent.
    """

    key: str
    title: str
    unit: str = ""
    higher_is_better: bool = False
    decimals: int = 4
    percent: bool = False
    shown_unit: str = ""
    shown_factor: float = 1.0


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
"""All of them, in the order of `measures_of`."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Errors over the pixels where the truth is known and the prediction valid.

    SI units but for two that nobody writes so: irmse and imae are in 1/km (SI × 1000), silog is
    100·std(log p − log g). rmse, mae, sq_rel (mean (p − g)²/g): metres. mre: mean |p − g|/g.
    log10: mean |log10 p − log10 g|. rmse_log: of the natural logarithm. delta1…3: share of pixels
    with max(p/g, g/p) below the thresholds. pixels: how many were scored. coverage: which share
    of the pixels with known truth that is.
    """

    rmse: float
    mae: float
    mre: float
    sq_rel: float
    log10: float
    rmse_log: float
    irmse: float
    imae: float
    silog: float
    delta1: float
    delta2: float
    delta3: float
    pixels: int
    coverage: float


def score(
    predicted: Tensor,
    truth: Tensor,
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS,
) -> Scores:
    """Scores of a prediction against the truth, any equal shapes, metres.

    Unknown truth and missing predictions are 0, negative or not finite.
    """
    (sums,) = error_sums(predicted, truth, thresholds)
    values = measures_of(sums).tolist()
    pixels, known = int(sums[SUMS.index("pixels")]), int(sums[SUMS.index("known")])
    return Scores(
        **{measure.key: value for measure, value in zip(MEASURES, values, strict=True)},
        pixels=pixels,
        coverage=pixels / known if known else math.nan,
    )


def error_sums(
    predicted: Tensor,
    truth: Tensor,
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS,
    part: Tensor | None = None,
    parts: int = 1,
) -> Tensor:
    """(parts, len(SUMS)) float64: the sums over each part of a picture.

    part: of the picture's shape, the number from 0 to parts − 1 of the part that a pixel belongs
    to; without it there is one. Depths as for `score`.
    """
    if predicted.shape != truth.shape:
        raise ValueError(f"a prediction of {tuple(predicted.shape)}, truth of {tuple(truth.shape)}")
    sums = torch.zeros(parts, len(SUMS), dtype=torch.float64, device=truth.device)
    predicted, truth = predicted.reshape(-1), truth.reshape(-1)
    places = None if part is None else part.reshape(-1)
    for start in range(0, truth.numel(), _CHUNK):
        piece = slice(start, start + _CHUNK)
        p, g = predicted[piece].double(), truth[piece].double()
        known = g.isfinite() & (g > 0)
        scored = known & p.isfinite() & (p > 0)
        terms = _terms(p[scored], g[scored], thresholds)
        if places is None:
            added = {name: term.sum()[None] for name, term in terms.items()}
            added["known"] = known.sum()[None]
        else:
            place = places[piece]
            added = {name: place[scored].bincount(term, parts) for name, term in terms.items()}
            added["known"] = place[known].bincount(minlength=parts)
        sums += torch.stack([added[name].double() for name in SUMS], dim=-1)
    return sums


def _terms(p: Tensor, g: Tensor, thresholds: tuple[float, float, float]) -> dict[str, Tensor]:
    """What each of N scored pixels adds to the sums, (N,) float64 each."""
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


def measures_of(sums: Tensor) -> Tensor:
    """(…, len(MEASURES)) of sums (…, len(SUMS)); not a number where no pixel was scored."""
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
