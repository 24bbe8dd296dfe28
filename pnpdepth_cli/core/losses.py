"""Losses between predicted and true depth at the sparse points, each a mean over the points."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

Loss = Callable[[Tensor, Tensor], Tensor]

NEAREST_DEPTH = 1e-3
"""Metres; `inverse` and `log` read a prediction below this as this."""

NORMAL_MEDIAN = 1.4826
"""Standard deviation over the median of |e|, for normal e."""

LEAST_GROSS = 0.1
"""Error of log depth. 0.02 and 0.05 gave larger errors on rendered rooms, 0.2 as small ones, but
larger ones where a fifth of the points is wrong."""


def l1(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean |p − d|, the paper's choice. (N,), (N,) → ()."""
    return (predicted - true).abs().mean()


def l2(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean (p − d)²."""
    return (predicted - true).square().mean()


def huber(predicted: Tensor, true: Tensor) -> Tensor:
    """Huber's loss, quadratic below 1 m and linear above."""
    return F.huber_loss(predicted, true)


def berhu(predicted: Tensor, true: Tensor) -> Tensor:
    """Reverse Huber: |e| up to c, (e² + c²)/2c above, c = max|e|/5 (Laina et al. 2016, eq. 2)."""
    error = (predicted - true).abs()
    c = (0.2 * error.detach().max()).clamp_min(torch.finfo(error.dtype).tiny)
    return torch.where(error <= c, error, (error.square() + c.square()) / (2 * c)).mean()


def inverse(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean |1/p − 1/d| (Jaritz et al. 2018)."""
    return (predicted.clamp_min(NEAREST_DEPTH).reciprocal() - true.reciprocal()).abs().mean()


def log(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean |log p − log d|."""
    return (predicted.clamp_min(NEAREST_DEPTH).log() - true.log()).abs().mean()


def cauchy(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean c·log(1 + (e/c)²) of e = log p − log d (Cauchy's loss), for points that may be wrong.

    c is the standard deviation of e that its median tells: what lies far beyond hardly pulls. It is
    no less than LEAST_GROSS, for depth that is off by so little is not wrong.
    """
    error = predicted.clamp_min(NEAREST_DEPTH).log() - true.log()
    c = (NORMAL_MEDIAN * error.detach().abs().median()).clamp_min(LEAST_GROSS)
    return (c * (error / c).square().log1p()).mean()


def departure(depth: Tensor, first: Tensor) -> Tensor:
    """Mean (log d − log d_0)² over the picture: how far depth has gone from the network's."""
    change = depth.clamp_min(NEAREST_DEPTH).log() - first.clamp_min(NEAREST_DEPTH).log()
    return change.square().mean()


LOSSES: dict[str, Loss] = {
    "l1": l1,
    "l2": l2,
    "huber": huber,
    "berhu": berhu,
    "inverse": inverse,
    "log": log,
    "cauchy": cauchy,
}
