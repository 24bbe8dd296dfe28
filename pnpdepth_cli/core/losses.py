"""Losses between predicted and true depth at the sparse points, each a mean over the points."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

Loss = Callable[[Tensor, Tensor], Tensor]

NEAREST_DEPTH = 1e-3
"""Metres; `inverse` and `log` read a prediction below this as this."""


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


LOSSES: dict[str, Loss] = {
    "l1": l1,
    "l2": l2,
    "huber": huber,
    "berhu": berhu,
    "inverse": inverse,
    "log": log,
}
