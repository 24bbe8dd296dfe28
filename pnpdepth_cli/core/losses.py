"""L of equation 3: losses between predicted and measured depth at the sparse points.

A loss takes (N,) and (N,) metres to a scalar, the mean over the points, differentiable in
`predicted`. `pnpdepth_cli.choices.LOSSES` lists the names.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.choices import LOSSES
from pnpdepth_cli.errors import ModelError, wrap_user_errors

Loss = Callable[[Tensor, Tensor], Tensor]

MIN_DEPTH = 1e-3
"""Metres; a prediction is at least this before its logarithm is taken."""

MAD_TO_STD = 1.4826
"""Standard deviation over the median of |e|, for normally distributed e."""

MIN_CAUCHY_SCALE = 0.1
"""Least c of Cauchy's loss, in log depth. On rendered rooms 0.02 and 0.05 gave larger errors; 0.2
gave equal ones, but larger ones where a fifth of the points were outliers."""


def checked_loss(name: str) -> Loss:
    """Returns a loss that raises ModelError where the one in `LOSSES` fails or gives no scalar.

    Args:
        name: Name of a loss in `LOSSES`, or path of a user's Python file with one.
    """
    loss: Loss = LOSSES[name]

    def checked(predicted: Tensor, true: Tensor) -> Tensor:
        """The loss of depths (N,) and (N,) in metres, of one element."""
        with wrap_user_errors(f"loss {name!r}"):
            value = loss(predicted, true)
            if value.numel() != 1:
                shape = tuple(value.shape)
                raise ModelError(f"loss {name!r} gives {shape}, not a scalar; add .mean()")
        return value

    return checked


def l1(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean |p − d| of predicted depth p and true depth d, (N,) metres: the paper's loss."""
    return (predicted - true).abs().mean()


def l2(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean (p − d)² of predicted depth p and true depth d, (N,) metres."""
    return (predicted - true).square().mean()


def huber(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean of e²/2 for |e| ≤ 1 m and of |e| − 1/2 above (Huber).

    e = p − d, of predicted depth p and true depth d, (N,) metres.
    """
    return F.huber_loss(predicted, true)


def berhu(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean of |e| up to c and of (e² + c²)/2c above, c = max|e|/5.

    e = p − d, of predicted depth p and true depth d, (N,) metres. The reverse Huber loss of Laina
    et al. 2016, equation 2.
    """
    error = (predicted - true).abs()
    # Above 0 also where all errors are 0, because it is divided by.
    c = (0.2 * error.detach().max()).clamp_min(torch.finfo(error.dtype).tiny)
    return torch.where(error <= c, error, (error.square() + c.square()) / (2 * c)).mean()


def cauchy(predicted: Tensor, true: Tensor) -> Tensor:
    """Mean c·log(1 + (e/c)²): robust to outliers.

    e = log p − log d, of predicted depth p and true depth d, (N,) metres. c is the standard
    deviation of e, estimated robustly from the median of |e|, and at least MIN_CAUCHY_SCALE,
    because smaller errors are not outliers. Errors far beyond c have little influence.
    """
    error = predicted.clamp_min(MIN_DEPTH).log() - true.log()
    c = (MAD_TO_STD * error.detach().abs().median()).clamp_min(MIN_CAUCHY_SCALE)
    return (c * (error / c).square().log1p()).mean()
