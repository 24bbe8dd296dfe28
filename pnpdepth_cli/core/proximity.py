"""The proximity loss, an optional term of L that keeps depth near the network's prediction."""

from __future__ import annotations

from torch import Tensor

from pnpdepth_cli.core.losses import MIN_DEPTH


def proximity_loss(depth: Tensor, prediction: Tensor) -> Tensor:
    """Mean (log d − log d_0)² over the image.

    Args:
        depth: (1, 1, h, w) metres, of the current z; differentiable.
        prediction: (1, 1, h, w) metres, of z_0.
    """
    change = depth.clamp_min(MIN_DEPTH).log() - prediction.clamp_min(MIN_DEPTH).log()
    return change.square().mean()
