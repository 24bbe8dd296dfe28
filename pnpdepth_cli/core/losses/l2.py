"""Mean squared error."""

from __future__ import annotations

from torch import Tensor


def loss(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean (p − d)²."""
    return (predicted - true).square().mean()
