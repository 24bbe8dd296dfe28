"""Mean absolute error, the paper's loss."""

from __future__ import annotations

from torch import Tensor


def loss(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean |p − d|."""
    return (predicted - true).abs().mean()
