"""Frames refined in memory, from the image frame and back to it."""

from __future__ import annotations

import torch

from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.refine import OnIteration, Refinement, refine_from
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError, PnpDepthError
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
    settings = settings.complete()
    with out_of_memory_is_a_device_error(network.device):
        prepared = prepare(network, frame)
        if not len(prepared.points):
            raise prepared.no_points_error()
        reader = prepared.depth_reader(settings.align)
        with torch.no_grad():
            z = split.front(*prepared.arguments)
        (result,) = refine_from(
            split, z, [prepared.points], settings, depth_of=[reader], on_iteration=on_iteration
        )
    refined = to_refined_frame(prepared, reader, result, propagation=propagation)
    if isinstance(refined, PnpDepthError):
        raise refined
    return refined


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
