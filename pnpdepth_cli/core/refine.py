"""The method: update an intermediate feature map until the prediction fits the sparse points.

Wang et al., "Plug-and-Play: Improve Depth Estimation via Sparse Data Propagation", ICRA 2019,
equations 2 and 3:

    z_0     = f_front(x)
    z_{k+1} = z_k − α·U(∂L(f_rear(z_k), D_s) / ∂z_k)
    depth   = f_rear(z_K)

`refine_from` is that loop. L and D_s are those of `core.losses` and `points`, U one of
`core.update_rules`, α and its schedule those of `core.step_sizes`. `core.weights_refinement` is the
same for weights of the network.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.core.refinement import DepthOf, FrameRefinement, Refinement
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.core.split.tensors import map_tensors, tensors_in
from pnpdepth_cli.errors import BatchError, LayerError, PnpDepthError
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

__all__ = ["DepthOf", "Refinement", "frame_parts", "refine", "refine_from"]

_LOSS_SCALE = 1024.0
"""Factor on the loss where float16 is involved, whose smallest number exceeds many gradients."""


def refine(
    split: Split,
    arguments: Sequence[Tensor],
    points: SparsePoints,
    settings: Settings,
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
    with torch.no_grad():
        z0 = split.front(*arguments)
    (result,) = refine_from(
        split,
        z0,
        (points,),
        settings,
        depth_of=(depth_of,),
        keep_depths=keep_depths,
        on_iteration=on_iteration,
    )
    if isinstance(result, PnpDepthError):
        raise result
    return result


def refine_from(
    split: Split,
    z: Tensor,
    points: Sequence[SparsePoints],
    settings: Settings,
    *,
    depth_of: Sequence[DepthOf],
    keep_depths: Collection[int] = (),
    on_iteration: Callable[[int, float], None] = lambda iteration, loss: None,
) -> list[Refinement | PnpDepthError]:
    """Returns for each of B frames its refinement, or the error that ended it.

    The frames share the passes of the network; each has its own α, loss and end, as if alone.

    Args:
        split: The network, cut and open.
        z: z_0 of all frames, stacked along axis 0; the front has run.
        points: Of each frame.
        settings: Of all frames.
        depth_of: Of each frame; called with the frame's part of the network's output.
        keep_depths: As in `refine`.
        on_iteration: Called after each update k with k and the mean of L(z_k).

    Raises:
        BatchError: z or the output does not have one part per frame; refine them one at a time.
    """
    settings = settings.complete()
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


def frame_parts(structure: Any, frames: int) -> list[Any]:
    """Returns the part of each frame, with a batch axis of 1; for one frame the whole structure.

    Args:
        structure: A tensor, or tensors in nested containers, with the frames along axis 0.
        frames: The number of frames.

    Raises:
        BatchError: A tensor does not have one element per frame along axis 0.
    """
    if frames == 1:
        return [structure]
    for path, tensor in tensors_in(structure):
        if tensor.shape[:1] != (frames,):
            name = ".".join(path) or "the tensor"
            raise BatchError(
                f"{name} of shape {tuple(tensor.shape)}, at the cut or in the output, has not one"
                f" part for each of {frames} frames; refine them one at a time"
            )
    parts = {path: tensor.tensor_split(frames) for path, tensor in tensors_in(structure)}

    def of_frame(index: int) -> Any:
        return map_tensors(structure, lambda path, _: parts[path][index])

    return [of_frame(index) for index in range(frames)]


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
