"""The error measures of depth estimation, per picture.

Definitions: Eigen et al. 2014 (RMSE, AbsRel = MRE, δ < 1.25^k, SILog) and the KITTI depth
completion benchmark (iRMSE). The paper's KITTI rows use δ thresholds of 1.01^k; ours never do.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Errors over the pixels where the truth is known and the prediction valid.

    rmse, mae: metres. mre: mean |p − g|/g. delta1…3: share of pixels with max(p/g, g/p) < 1.25^k.
    irmse: 1/km. silog: 100·std(log p − log g). pixels: how many were scored. coverage: which share
    of the pixels with known truth that is.
    """

    rmse: float
    mae: float
    mre: float
    delta1: float
    delta2: float
    delta3: float
    irmse: float
    silog: float
    pixels: int
    coverage: float


def score(predicted: Tensor, truth: Tensor) -> Scores:
    """Scores of a prediction against the truth, any equal shapes, metres.

    Unknown truth and missing predictions are 0, negative or not finite.
    """
    truth, predicted = truth.double(), predicted.double()
    known = truth.isfinite() & (truth > 0)
    valid = known & predicted.isfinite() & (predicted > 0)
    p, g = predicted[valid], truth[valid]
    error, log_error = p - g, p.log() - g.log()
    ratio = torch.maximum(p / g, g / p)
    return Scores(
        rmse=float(error.square().mean().sqrt()),
        mae=float(error.abs().mean()),
        mre=float((error.abs() / g).mean()),
        delta1=float((ratio < 1.25).double().mean()),
        delta2=float((ratio < 1.25**2).double().mean()),
        delta3=float((ratio < 1.25**3).double().mean()),
        irmse=1000 * float((1 / p - 1 / g).square().mean().sqrt()),
        silog=100
        * float((log_error.square().mean() - log_error.mean().square()).clamp_min(0).sqrt()),
        pixels=int(valid.sum()),
        coverage=float(valid.sum() / known.sum()) if bool(known.any()) else float("nan"),
    )
