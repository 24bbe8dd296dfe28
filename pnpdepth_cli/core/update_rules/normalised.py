"""The gradient divided by its root mean square.

Like the sign, it makes the step independent of the loss's unit and of the number of points. Unlike
the sign, it keeps the relative sizes of the elements: those with little influence move little.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pnpdepth_cli.core.update_rules import Update


def update_rule() -> Update:
    """Returns the rule g → g / rms(g); an all-zero gradient stays zero."""

    def update(gradient: Tensor) -> Tensor:
        # Divided by the largest element first: squares of tiny gradients would underflow.
        largest = gradient.abs().max().clamp_min(torch.finfo(gradient.dtype).tiny)
        gradient = gradient / largest
        return gradient / gradient.square().mean().sqrt().clamp_min(torch.finfo().tiny)

    return update
