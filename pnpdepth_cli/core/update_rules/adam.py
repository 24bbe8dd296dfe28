"""Adam with bias correction (Kingma & Ba 2014)."""

from __future__ import annotations

from torch import Tensor

from pnpdepth_cli.core.update_rules import Update


def update_rule(beta1: float = 0.9, beta2: float = 0.999, eps: float = 1e-12) -> Update:
    """Returns Adam's rule; elements whose gradient is always zero do not move.

    Args:
        beta1: Decay of the mean of the gradients.
        beta2: Decay of the mean of their squares.
        eps: Added to the denominator. Smaller than the common 1e-8, because the gradient of a mean
            over many points is tiny at most elements of z and 1e-8 would suppress them.
    """
    first: Tensor | None = None
    second: Tensor | None = None
    step = 0

    def update(gradient: Tensor) -> Tensor:
        nonlocal first, second, step
        step += 1
        first = (1 - beta1) * gradient + (0 if first is None else beta1 * first)
        second = (1 - beta2) * gradient.square() + (0 if second is None else beta2 * second)
        return (first / (1 - beta1**step)) / ((second / (1 - beta2**step)).sqrt() + eps)

    return update
