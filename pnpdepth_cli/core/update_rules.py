"""U of equation 3: from the gradient at z to the direction of its update.

Each rule is made anew for every refinement and sees the gradients of one frame, in order.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import torch
from torch import Tensor

Update = Callable[[Tensor], Tensor]

_LONGEST = 10.0  # root mean square of a direction of L-BFGS; its first one has 1


def sign() -> Update:
    """The sign of the gradient (the paper's choice, after Kurakin et al. 2017)."""
    return torch.sign


def sgd() -> Update:
    """The gradient itself."""
    return lambda gradient: gradient


def normalised() -> Update:
    """The gradient with a root mean square of 1, all zero where it is all zero.

    Like the sign it makes the step independent of the loss's unit and the number of points, but it
    keeps what the sign throws away: elements that hardly matter hardly move.
    """

    def update(gradient: Tensor) -> Tensor:
        # Of the largest element first: squares of tiny gradients would vanish.
        largest = gradient.abs().max().clamp_min(torch.finfo(gradient.dtype).tiny)
        gradient = gradient / largest
        return gradient / gradient.square().mean().sqrt().clamp_min(torch.finfo().tiny)

    return update


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


def lbfgs(memory: int = 10) -> Update:
    """Limited-memory BFGS, two loops over the last pairs (Nocedal & Wright 2006, algorithm 7.4).

    The first direction is the normalised gradient. From then on z moves by quasi-Newton steps
    whatever α is: the rule takes its last direction for the way that z went, which is wrong by the
    factor α, and so is its inverse Hessian the other way round. Where the loss does not curve
    upwards the pair is skipped, and no direction is longer than `_LONGEST` of the first.
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
        direction = gradient
        back = []
        for step, change in reversed(pairs):
            share = (step * direction).sum() / (step * change).sum()
            back.append(share)
            direction = direction - share * change
        if pairs:
            step, change = pairs[-1]
            direction = direction * ((step * change).sum() / change.square().sum())
            for (step, change), share in zip(pairs, reversed(back), strict=True):
                again = (change * direction).sum() / (step * change).sum()
                direction = direction + (share - again) * step
            length = direction.square().mean().sqrt()
            direction = direction * (_LONGEST / length.clamp_min(_LONGEST))
        else:
            direction = first(gradient)
        last = gradient, direction
        return direction

    return update


UPDATES: dict[str, Callable[[], Update]] = {
    "sign": sign,
    "sgd": sgd,
    "normalised": normalised,
    "momentum": momentum,
    "adam": adam,
    "lbfgs": lbfgs,
}
