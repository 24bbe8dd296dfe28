"""Losses between predicted and measured depth at the sparse points, one module each.

Every module has a function `loss(predicted, true)`: (N,) and (N,) metres to a scalar, the mean over
the points, differentiable in `predicted`. `pnpdepth_cli.choices.LOSSES` finds them by file name.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

Loss = Callable[[Tensor, Tensor], Tensor]

MIN_DEPTH = 1e-3
"""Metres; losses of inverse and log depth clamp the prediction to at least this."""
