"""Heavy-ball momentum (Polyak 1964; without damping, as in torch.optim.SGD)."""

from __future__ import annotations

from torch import Tensor

from pnpdepth_cli.core.update_rules import Update


def update_rule(decay: float = 0.9) -> Update:
    """Returns the rule v ← decay·v + g, whose direction is v."""
    velocity: Tensor | None = None

    def update(gradient: Tensor) -> Tensor:
        nonlocal velocity
        velocity = gradient if velocity is None else decay * velocity + gradient
        return velocity

    return update
