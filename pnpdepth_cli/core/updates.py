"""U of equation 3: from the gradient at z to the direction of its update."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Update = Callable[[Tensor], Tensor]


def sign() -> Update:
    """The sign of the gradient (the paper's choice, after Kurakin et al. 2017)."""
    return torch.sign


def sgd() -> Update:
    """The gradient itself."""
    return lambda gradient: gradient


def momentum(decay: float = 0.9) -> Update:
    """Heavy ball: v ← decay·v + g (Polyak 1964; without damping, as in torch.optim.SGD)."""
    velocity: Tensor | None = None

    def update(gradient: Tensor) -> Tensor:
        nonlocal velocity
        velocity = gradient if velocity is None else decay * velocity + gradient
        return velocity

    return update


def adam(beta1: float = 0.9, beta2: float = 0.999, eps: float = 1e-12) -> Update:
    """Adam with bias correction (Kingma & Ba 2014).

    A gradient of a mean over many points is tiny at most elements of z; the usual eps of 1e-8
    would mute them, so it is smaller here. Elements that no point reaches stay exactly still.
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


UPDATES: dict[str, Callable[[], Update]] = {
    "sign": sign,
    "sgd": sgd,
    "momentum": momentum,
    "adam": adam,
}
