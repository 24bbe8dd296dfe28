"""Mean absolute error of log depth."""

from __future__ import annotations

from torch import Tensor

from pnpdepth_cli.core.losses import MIN_DEPTH


def loss(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean |log p − log d|."""
    return (predicted.clamp_min(MIN_DEPTH).log() - true.log()).abs().mean()
