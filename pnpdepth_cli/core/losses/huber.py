"""Huber's loss: quadratic below 1 m, linear above."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor


def loss(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean of e²/2 for |e| ≤ 1 m and of |e| − 1/2 above, e = p − d."""
    return F.huber_loss(predicted, true)
