"""Frames refined in memory, from the image frame and back to it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.refine import OnIteration, Refinement, refine_from
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import BatchError, DivergedError, PnpDepthError
from pnpdepth_cli.frames.frame import DepthMap, Frame, Refined, no_points
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.settings import Settings


def refine_frame(
    network: Network,
    split: Split,
    settings: Settings,
    frame: Frame,
    *,
    propagation: str = "none",
    on_iteration: OnIteration = lambda done, loss: None,
) -> Refined:
    """Returns one refined frame. A divergence with a last good depth is returned in it.

    Args:
        split: The network cut at a layer, open. For frames of one size it is recorded once.
        settings: How z is updated.
        propagation: How the residual at the points is propagated: "none" or a name in
            `choices.PROPAGATIONS`.
        on_iteration: Called after each update of z.

    Raises:
        PnpDepthError: The frame cannot be refined.
    """
    (refined,) = refine_frames(
        network, split, settings, (frame,), propagation=propagation, on_iteration=on_iteration
    )
    if isinstance(refined, PnpDepthError):
        raise refined
    return refined


def refine_frames(
    network: Network,
    split: Split,
    settings: Settings,
    frames: Sequence[Frame],
    *,
    propagation: str = "none",
    on_iteration: OnIteration = lambda done, loss: None,
) -> list[Refined | PnpDepthError]:
    """Returns frames refined in one pass of the network; an error in place of a failed frame.

    Arguments as of `refine_frame`; `on_iteration` gets the mean loss.

    Raises:
        BatchError: The network does not take these frames together, or they differ in size.
    """
    settings = settings.complete()
    with out_of_memory_is_a_device_error(network.device):
        prepared = [prepare(network, frame) for frame in frames]
        seen = [frame for frame in prepared if len(frame.points)]
        readers = [frame.depth_reader(settings.align) for frame in seen]
        results: list[Refinement | PnpDepthError] = []
        if seen:
            with torch.no_grad():
                z = split.front(*_stacked([frame.arguments for frame in seen]))
            points = [frame.points for frame in seen]
            results = refine_from(
                split, z, points, settings, depth_of=readers, on_iteration=on_iteration
            )
    refined = iter(
        to_refined_frame(*each, propagation=propagation)
        for each in zip(seen, readers, results, strict=True)
    )
    return [next(refined) if len(each.points) else each.no_points_error() for each in prepared]


def to_refined_frame(
    prepared: PreparedFrame,
    reader: AlignedDepth,
    result: Refinement | PnpDepthError,
    *,
    propagation: str = "none",
) -> Refined | PnpDepthError:
    """Returns the result in the image frame, its residual propagated; an error if there is none.

    Args:
        reader: What the refinement read depth with.
        result: What `core.refine` returned for the frame.
        propagation: As of `refine_frame`.
    """
    diverged = result if isinstance(result, DivergedError) else None
    if diverged is not None and diverged.last_good is not None:
        result = diverged.last_good
    if isinstance(result, PnpDepthError):
        return result
    used = prepared.frame.points
    return Refined(
        before=prepared.to_image(result.before),
        after=with_propagation(prepared.frame, prepared.to_image(result.after), propagation),
        used=used,
        held_out=no_points(used),
        refinement=result,
        diverged=diverged,
        alignment=reader.alignment,
        notes=reader.notes,
    )


def with_propagation(frame: Frame, depth: DepthMap, kind: str) -> DepthMap:
    """Returns depth (H, W) with its residual at the frame's points propagated; "none" keeps it."""
    if kind == "none":
        return depth
    return propagate(torch.from_numpy(depth), frame.points, frame.rgb, kind=kind).depth.numpy()


def _stacked(arguments: Sequence[tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    """Returns the arguments of all frames as those of one call."""
    if len(arguments) == 1:
        return arguments[0]
    for each in zip(*arguments, strict=True):
        shapes = {tuple(argument.shape) for argument in each}
        if len(shapes) > 1 or shapes.pop()[:1] != (1,):
            raise BatchError(
                f"the network's arguments of shapes {[tuple(a.shape) for a in each]} cannot be"
                " stacked; refine the frames one at a time"
            )
    return tuple(torch.cat(each) for each in zip(*arguments, strict=True))
