"""Limited-memory BFGS, the two-loop recursion (Nocedal & Wright 2006, algorithm 7.4).

Not torch.optim.LBFGS: its strong-Wolfe search evaluates loss and gradient several times per step,
whereas here each of the K updates has exactly one rear pass and one gradient.
"""

from __future__ import annotations

from collections import deque

from torch import Tensor

from pnpdepth_cli.core.update_rules import Update
from pnpdepth_cli.core.update_rules.normalised import update_rule as normalised

MAX_RMS = 10.0
"""Largest root mean square of a direction; that of the first direction is 1."""


def update_rule(memory: int = 10) -> Update:
    """Returns the L-BFGS rule; its first direction is the normalised gradient.

    After the first update, the displacement of z does not depend on α: the rule takes its last
    direction for the displacement of z, which is too large by 1/α, so its inverse Hessian is too
    large by 1/α and the step α cancels it. Pairs of negative curvature are skipped, and directions
    are shortened to MAX_RMS.

    Args:
        memory: How many of the last pairs of displacement and gradient change are used.
    """
    pairs: deque[tuple[Tensor, Tensor]] = deque(maxlen=memory)  # of −direction and the change of g
    last: tuple[Tensor, Tensor] | None = None  # gradient and direction
    first = normalised()

    def update(gradient: Tensor) -> Tensor:
        nonlocal last
        if last is not None:
            step, change = -last[1], gradient - last[0]
            if (step * change).sum() > 0:
                pairs.append((step, change))
        direction = _two_loops(gradient, pairs) if pairs else first(gradient)
        last = gradient, direction
        return direction

    return update


def _two_loops(gradient: Tensor, pairs: deque[tuple[Tensor, Tensor]]) -> Tensor:
    """The product of the approximate inverse Hessian and the gradient, at most MAX_RMS long."""
    direction, alphas = gradient, []
    for step, change in reversed(pairs):
        alpha = (step * direction).sum() / (step * change).sum()
        alphas.append(alpha)
        direction = direction - alpha * change
    step, change = pairs[-1]
    direction = direction * ((step * change).sum() / change.square().sum())
    for (step, change), alpha in zip(pairs, reversed(alphas), strict=True):
        beta = (change * direction).sum() / (step * change).sum()
        direction = direction + (alpha - beta) * step
    rms = direction.square().mean().sqrt()
    return direction * (MAX_RMS / rms.clamp_min(MAX_RMS))
