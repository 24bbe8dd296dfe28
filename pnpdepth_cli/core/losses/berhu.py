"""Reverse Huber loss (Laina et al. 2016, equation 2)."""

from __future__ import annotations

import torch
from torch import Tensor


def loss(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean of |e| up to c and of (e² + c²)/2c above, e = p − d, c = max|e|/5."""
    error = (predicted - true).abs()
    c = (0.2 * error.detach().max()).clamp_min(torch.finfo(error.dtype).tiny)
    return torch.where(error <= c, error, (error.square() + c.square()) / (2 * c)).mean()
