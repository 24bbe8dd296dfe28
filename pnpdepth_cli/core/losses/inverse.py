"""Mean absolute error of inverse depth (Jaritz et al. 2018)."""

from __future__ import annotations

from torch import Tensor

from pnpdepth_cli.core.losses import MIN_DEPTH


def loss(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean |1/p − 1/d|."""
    return (predicted.clamp_min(MIN_DEPTH).reciprocal() - true.reciprocal()).abs().mean()
