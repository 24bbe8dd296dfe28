"""The method: update an intermediate feature map until the prediction fits the sparse points.

Wang et al., "Plug-and-Play: Improve Depth Estimation via Sparse Data Propagation", ICRA 2019,
equations 2 and 3:

    z_0     = f_front(x)
    z_{k+1} = z_k − α·U(∂L(f_rear(z_k), D_s) / ∂z_k)
    depth   = f_rear(z_K)

`refine_from` is that loop. L and D_s are those of `core.losses` and `points`, U one of
`core.update_rules`, α and its schedule those of `core.step_sizes`.

A network that is given the points as an input fits them before the first update, so that L says
little. `refine_weights` hides some points m_k ⊂ D_s from the input and takes L at these, a new
random m_k at every step, and moves the weights θ instead of z:

    θ_{k+1} = θ_k − α·U(∂L(f_θ(x, D_s ∖ m_k), m_k) / ∂θ_k)
    depth   = f_θ*(x, D_s)

θ* is the last θ_k, unless another is better beyond chance at points never shown; k = 0 is among
them. With target "given" nothing is hidden, and L is taken at all points, as in equation 3.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.core.batch import frame_parts
from pnpdepth_cli.core.refinement import DepthOf, FrameRefinement, Refinement, RefineSettings
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.core.split.user_code import wrap_user_errors
from pnpdepth_cli.core.weights import MovingWeights
from pnpdepth_cli.core.weights_refinement import FrameOfPoints, WeightsRefinement
from pnpdepth_cli.errors import LayerError, PnpDepthError
from pnpdepth_cli.points import SparsePoints

__all__ = [
    "DepthOf",
    "RefineSettings",
    "Refinement",
    "refine",
    "refine_batch",
    "refine_from",
    "refine_weights",
]

_LOSS_SCALE = 1024.0
"""Factor on the loss where float16 is involved, whose smallest number exceeds many gradients."""


def refine(
    split: Split,
    arguments: Sequence[Tensor],
    points: SparsePoints,
    settings: RefineSettings,
    *,
    depth_of: DepthOf,
    keep_depths: Collection[int] = (),
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> Refinement:
    """Returns the network's depth for one frame, refined to agree with the points.

    Args:
        split: The network, cut and open.
        arguments: Of the network, for this frame.
        points: Sparse depth on the grid of the predicted depth's field of view.
        settings: How z is updated.
        depth_of: Turns the network's output into depth (1, 1, h, w) in metres, differentiably.
        keep_depths: Numbers of updates after which depth is kept in `Refinement.depths`.
        on_iteration: Called after each update k with k and L(z_k).

    Raises:
        DivergedError: The loss or its gradient is not finite; `last_good` is the Refinement until
            then.
        ModelError: The first prediction is not finite at the points.
        LayerError: The depth does not depend on z.
    """
    (result,) = refine_batch(
        split,
        arguments,
        (points,),
        settings,
        depth_of=(depth_of,),
        keep_depths=keep_depths,
        on_iteration=on_iteration,
    )
    if isinstance(result, PnpDepthError):
        raise result
    return result


def refine_batch(
    split: Split,
    arguments: Sequence[Tensor],
    points: Sequence[SparsePoints],
    settings: RefineSettings,
    *,
    depth_of: Sequence[DepthOf],
    keep_depths: Collection[int] = (),
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> list[Refinement | PnpDepthError]:
    """Returns for each of B frames its refinement, or the error that ended it.

    The frames share the passes of the network; each has its own α, loss and end, as if alone.

    Args:
        split: The network, cut and open.
        arguments: Of the network, for all frames, stacked along axis 0.
        points: Of each frame.
        settings: Of all frames.
        depth_of: Of each frame; called with the frame's part of the network's output.
        keep_depths: As in `refine`.
        on_iteration: Called after each update k with k and the mean of L(z_k).

    Raises:
        BatchError: z or the output does not have one part per frame; refine them one at a time.
    """
    with torch.no_grad():
        z0 = split.front(*arguments)
    return refine_from(
        split,
        z0,
        points,
        settings,
        depth_of=depth_of,
        keep_depths=keep_depths,
        on_iteration=on_iteration,
    )


def refine_from(
    split: Split,
    z: Tensor,
    points: Sequence[SparsePoints],
    settings: RefineSettings,
    *,
    depth_of: Sequence[DepthOf],
    keep_depths: Collection[int] = (),
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> list[Refinement | PnpDepthError]:
    """Returns the same from z_0 on, so that the front runs once for several sets of points."""
    frames = [
        FrameRefinement(settings, z0, at, read, keep_depths)
        for z0, at, read in zip(frame_parts(z, len(points)), points, depth_of, strict=True)
    ]
    for iteration in range(settings.iterations):
        z = z.detach().requires_grad_(True)
        with torch.enable_grad():
            losses = _losses(frames, split.rear(z))
            if not losses:
                break
            gradient = _gradient(torch.stack(losses).sum(), z, split)
        with torch.no_grad():
            z = _updated(frames, z.detach(), gradient)
        if running := [frame.losses[-1] for frame in frames if frame.error is None]:
            on_iteration(iteration, sum(running) / len(running))
    else:
        with torch.no_grad():
            _losses(frames, split.rear(z))
    return [frame.result() if frame.error is None else frame.error for frame in frames]


def refine_weights(
    frame: FrameOfPoints,
    weights: MovingWeights,
    settings: RefineSettings,
    *,
    carried: MovingWeights | None = None,
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> Refinement:
    """Returns the depth of one frame after moving weights, which are back in place afterwards.

    Args:
        frame: The frame, and how the network predicts it.
        weights: The weights that move, θ_0.
        settings: What is updated and how.
        carried: θ* of the frame before, which moves instead where its L is lower than that of θ_0
            at the points set aside.
        on_iteration: Called after each step k with k and L(θ_k).

    Raises:
        DivergedError: As of `refine`.
        ModelError: As of `refine`.
        LayerError: The depth depends on no weight behind the cut.
    """
    state = WeightsRefinement(frame, weights, settings)
    state.begin()
    if carried is not None and state.takes(carried):
        weights = carried
    for iteration in range(state.iterations):
        shown, hidden = state.mask()
        with torch.enable_grad(), weights.in_place(requires_grad=True) as theta:
            loss = state.loss(frame.predict_in_steps(shown), hidden)
            gradients = _gradients(loss, theta)
        state.update(loss, gradients)
        if state.error is not None:
            break
        on_iteration(iteration, state.losses[-1])
        if state.finished():
            break
    if state.error is not None:
        state.error.last_good = state.result()
        raise state.error
    return state.result()


def _gradients(loss: Tensor, theta: Sequence[Tensor]) -> list[Tensor | None]:
    """∂L/∂θ_k; None for what L does not depend on."""
    if loss.requires_grad:
        with wrap_user_errors("the gradient of the network"):
            loss.backward()  # type: ignore[no-untyped-call]
    return [value.grad for value in theta]


def _losses(frames: Sequence[FrameRefinement], output: Any) -> list[Tensor]:
    """L(f_rear(z_k), D_s) of every frame that has not ended."""
    parts = zip(frames, frame_parts(output, len(frames)), strict=True)
    losses = [frame.loss(part) for frame, part in parts if frame.error is None]
    return [loss for loss in losses if loss is not None]


def _gradient(loss: Tensor, z: Tensor, split: Split) -> Tensor:
    """∂L/∂z_k."""
    gradient = gradient_at(z, loss * _LOSS_SCALE if split.in_half else loss)
    if gradient is None:
        raise LayerError(
            f"layer {split.layer!r}: no gradient comes back from the prediction to it; either the"
            " prediction does not depend on it or the network's forward runs under"
            " torch.no_grad, inference_mode or detach (take that out, or cut at a later layer)"
        )
    return gradient / _LOSS_SCALE if split.in_half else gradient


def _updated(frames: Sequence[FrameRefinement], z: Tensor, gradient: Tensor) -> Tensor:
    """z_{k+1} = z_k − α·U(∂L/∂z_k), frame by frame."""
    if len(frames) == 1:
        return frames[0].updated(z, gradient)
    count = len(frames)
    parts = zip(frames, z.tensor_split(count), gradient.tensor_split(count), strict=True)
    return torch.cat([frame.updated(*part) for frame, *part in parts])
