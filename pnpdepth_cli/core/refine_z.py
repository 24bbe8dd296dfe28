"""The method: update an intermediate feature map until the prediction fits the sparse points.

Wang et al., "Plug-and-Play: Improve Depth Estimation via Sparse Data Propagation", ICRA 2019,
equations 2 and 3:

    z_0     = f_front(x)
    z_{k+1} = z_k − α·U(∂L(f_rear(z_k), D_s) / ∂z_k)
    depth   = f_rear(z_K)

`refine` is that loop. L and D_s are those of `core.losses` and `points`, U one of
`core.update_rules`, as are α and its schedule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.choices import SCHEDULES, UPDATES
from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.core.update_rules import Update, blur, step_size
from pnpdepth_cli.errors import DivergedError, ModelError, wrap_user_errors
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings

_LOSS_SCALE = 1024.0
"""Factor on the loss where float16 is involved, whose smallest number exceeds many gradients.

The gradient is divided by it afterwards. It is a power of two, so neither rounds."""

DepthOf = Callable[[object], Tensor]
"""Turns the network's output for one frame into depth (1, 1, h, w) in metres, differentiably."""


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """The result of a refinement."""

    before: Tensor  # depth (1, 1, h, w) in metres of z_0
    after: Tensor  # depth (1, 1, h, w) in metres of z_K
    losses: tuple[float, ...]  # L(z_0) … L(z_K)
    step: float  # α as a number


def refine(
    split: Split,
    arguments: Sequence[Tensor],
    points: SparsePoints,
    settings: ClosedSettings,
    *,
    depth_of: DepthOf,
    z0: Tensor | None = None,
) -> Refinement:
    """Returns the network's depth for one frame, before and after `settings.iterations` updates.

    Args:
        split: The network cut at a layer, open.
        arguments: The arguments of the network for the frame.
        points: Sparse depth of the frame; its frame has the predicted depth's field of view, and
            may have another number of pixels.
        settings: Update rule, loss, step size and number of updates.
        depth_of: Turns the network's output into depth (1, 1, h, w) in metres, differentiably.
        z0: f_front of the arguments, where the front has run. None: it has not.

    Raises:
        DivergedError: The loss or its gradient is not finite; `last_good` is the Refinement until
            then, None if that was the first loss.
        ModelError: The first prediction is not finite at any point, or the depth does not depend
            on z; or network, loss or update rule fail.
    """
    # z_0 = f_front(x)
    with torch.no_grad():
        z = split.front(*arguments) if z0 is None else z0
    step = step_size(settings.lr, z)
    loss_of = checked_loss(settings.loss)
    rule: Update = UPDATES[settings.update]()
    scale = _LOSS_SCALE if split.in_half else 1.0  # of the loss, so that no gradient vanishes
    so_far: Refinement | None = None
    updates = 0
    while True:
        # The depth f_rear(z_k) and its loss L at the points; the last pass needs no gradient.
        is_last = updates == settings.iterations
        z = z.detach() if is_last else z.detach().requires_grad_(True)
        with torch.set_grad_enabled(not is_last):
            depth = depth_of(split.rear(z))
            at_points = points.sample(depth)
            if so_far is None:
                # A point has no part in L where f(x) is unknown, such as in the sky.
                is_known = at_points.isfinite()
                if settings.iterations and not bool(is_known.any()):
                    raise ModelError(
                        f"the network's prediction is not finite at any of {len(points):,} sparse"
                        " points, before any update of z; are its weights, its input range"
                        " (`normalise`) and precision right?"
                    )
                points = points.select(is_known)
                at_points = at_points[is_known]
            loss = loss_of(at_points, points.depth)
        if settings.iterations and not bool(loss.isfinite()):
            raise _diverged("loss", updates, step, so_far)
        so_far = _with_pass(so_far, depth.detach(), float(loss.detach()), step)
        if is_last:
            return so_far
        # The gradient of L at z_k.
        with torch.enable_grad():
            gradient = gradient_at(z, loss * scale)
        if gradient is None:
            raise ModelError(
                f"layer {split.layer!r}: no gradient comes back from the prediction to it; either"
                " the prediction does not depend on it or the network's forward runs under"
                " torch.no_grad, inference_mode or detach (take that out, or cut at a later layer)"
            )
        gradient = gradient / scale
        if not bool(gradient.isfinite().all()):
            raise _diverged("gradient", updates, step, so_far)
        # z_{k+1} = z_k − α·U(gradient)
        with torch.no_grad():
            gradient = blur(gradient, points, settings.blur)
            with wrap_user_errors(f"update rule {settings.update!r}"):
                direction = rule(gradient).reshape(gradient.shape)
            alpha = step * SCHEDULES[settings.schedule](updates / settings.iterations)
            z = z - alpha * direction
        updates += 1


def _with_pass(so_far: Refinement | None, depth: Tensor, loss: float, step: float) -> Refinement:
    """The refinement with one more pass of the rear, f_rear(z_k).

    Args:
        so_far: The refinement by the passes before; None if this is the pass of z_0.
        depth: Depth (1, 1, h, w) in metres of this pass.
        loss: Its loss L(z_k).
        step: α as a number.
    """
    if so_far is None:
        return Refinement(before=depth, after=depth, losses=(loss,), step=step)
    return replace(so_far, after=depth, losses=(*so_far.losses, loss))


def _diverged(quantity: str, updates: int, step: float, so_far: Refinement | None) -> DivergedError:
    """The error of a loss or a gradient that is not finite.

    Args:
        quantity: "loss" or "gradient".
        updates: How many updates of z were made.
        step: α as a number.
        so_far: The refinement until then, which is the error's `last_good`.
    """
    if updates == 0:
        return DivergedError(
            f"the {quantity} is not finite before any update of z; are the network, its"
            " precision and the loss right?",
            so_far,
        )
    plural = "" if updates == 1 else "s"
    return DivergedError(
        f"the {quantity} is not finite after {updates} update{plural} of z (step {step:.3g});"
        " try a smaller lr or fewer iterations",
        so_far,
    )
