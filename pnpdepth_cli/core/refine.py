"""The method: update an intermediate feature map until the prediction fits the sparse points.

Wang et al., "Plug-and-Play: Improve Depth Estimation via Sparse Data Propagation", ICRA 2019,
equations 2 and 3:

    z_0     = f_front(x)
    z_{k+1} = z_k − α·U(∂L(f_rear(z_k), D_s) / ∂z_k)
    depth   = f_rear(z_K)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pnpdepth_cli.core.losses import LOSSES
from pnpdepth_cli.core.points import SparsePoints
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.core.updates import UPDATES
from pnpdepth_cli.errors import DivergedError, LayerError, UsageError


@dataclass(frozen=True, kw_only=True)
class RefineSettings:
    """How z is updated; the values are the paper's.

    iterations: the number of updates of z, 0 for the plain prediction.
    lr: α as a number, or a text like "3%": that share of the standard deviation of z_0.
    align, align_every: how `depth_of` was asked to fit the network's numbers to metres, and
        whether again for every z; see `pnpdepth_cli.core.alignment`.
    """

    iterations: int = 5
    lr: float | str = 0.01
    loss: str = "l1"
    update: str = "sign"
    align: str = "none"
    align_every: bool = False


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """What refinement gives.

    before, after: depth (1, 1, h, w) in metres of z_0 and of z_K.
    losses: L(z_0) … L(z_K).
    step: α as a number.
    """

    before: Tensor
    after: Tensor
    losses: tuple[float, ...]
    step: float


def refine(
    split: Split,
    arguments: Sequence[Tensor],
    points: SparsePoints,
    settings: RefineSettings,
    *,
    depth_of: Callable[[object], Tensor],
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> Refinement:
    """The network's depth for `arguments`, brought to agree with the points.

    depth_of: turns what the network returns into depth (1, 1, h, w) in metres, differentiably.
    Raises DivergedError at a non-finite loss or gradient (its `last_good` is the Refinement up to
    there, None if the first prediction is already bad), LayerError if z does not reach the depth.
    """
    loss_of, update = LOSSES[settings.loss], UPDATES[settings.update]()
    with torch.no_grad():
        z = split.front(*arguments)
    alpha = step_size(settings.lr, z)
    depths: list[Tensor] = []
    losses: list[float] = []

    for iteration in range(settings.iterations):
        z.requires_grad_(True)
        with torch.enable_grad():
            depth = depth_of(split.rear(z))
            loss = loss_of(points.sample(depth), points.depth)
        gradient = _gradient(loss, z, split)
        finite = bool(loss.isfinite())
        if finite:
            depths = [*depths[:1], depth.detach()]
            losses.append(float(loss.detach()))
        if not finite or not bool(gradient.isfinite().all()):
            raise _diverged("gradient" if finite else "loss", iteration, depths, losses, alpha)
        on_iteration(iteration, losses[-1])
        with torch.no_grad():
            z = z.detach() - alpha * update(gradient)

    with torch.no_grad():
        after = depth_of(split.rear(z))
        last = float(loss_of(points.sample(after), points.depth))
    if settings.iterations and not torch.isfinite(torch.tensor(last)):
        raise _diverged("loss", settings.iterations, depths, losses, alpha)
    before = depths[0] if depths else after
    return Refinement(before=before, after=after, losses=(*losses, last), step=alpha)


def step_size(lr: float | str, z0: Tensor) -> float:
    """α: `lr` itself, or its per cent of the standard deviation of z_0. UsageError if no step."""
    text = str(lr).strip()
    try:
        value = float(text.removesuffix("%"))
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise UsageError(f"lr {lr!r} is not a step size; give a positive number, or one like 3%")
    return value / 100 * float(z0.float().std(correction=0)) if text.endswith("%") else value


def _gradient(loss: Tensor, z: Tensor, split: Split) -> Tensor:
    gradient = gradient_at(z, loss)
    if gradient is None:
        raise LayerError(
            f"layer {split.layer!r}: no gradient comes back from the prediction to it; either the"
            " prediction does not depend on it or the network's forward runs under"
            " torch.no_grad, inference_mode or detach (take that out, or cut at a later layer)"
        )
    return gradient


def _diverged(
    what: str, iteration: int, depths: list[Tensor], losses: list[float], step: float
) -> DivergedError:
    last_good = None
    if depths:
        last_good = Refinement(before=depths[0], after=depths[-1], losses=tuple(losses), step=step)
    return DivergedError(
        f"the {what} is not finite after {iteration} update{'s' if iteration != 1 else ''} of z"
        f" (step {step:.3g}); try a smaller --lr or fewer --iterations",
        last_good,
    )
