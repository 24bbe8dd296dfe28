"""Frames of a window, refined in order: each may begin where the frame before ended.

The start is taken where its loss is lower than that of the frame's own: at the points for a change
of z, at the points set aside for weights. Across a cut it is not, so that every frame begins at its
own plain prediction unless the frame before says more.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.refine import Refinement, refine_from
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.core.weights import MovingWeights
from pnpdepth_cli.core.weights_refinement import refine_weights
from pnpdepth_cli.errors import DivergedError, PnpDepthError
from pnpdepth_cli.frames.frame import Frame, Refined, WarmStart
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.refine import opened_frame, to_refined_frame
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.settings import Settings


def refine_next(
    network: Network,
    split: Split,
    settings: Settings,
    frame: Frame,
    carried: WarmStart,
    *,
    propagation: str = "none",
) -> Refined:
    """Returns one refined frame of a window, with what the next one may take over.

    Args:
        split: The network cut at a layer, or at its sparse depth; open.
        settings: What is updated and how.
        carried: Of the frame before; `WarmStart()` for the first of a window.
        propagation: As of `refine_frame`.

    Raises:
        PnpDepthError: The frame cannot be refined.
    """
    settings = settings.complete()
    with out_of_memory_is_a_device_error(network.device):
        prepared = prepare(network, frame)
        if not len(prepared.points):
            raise prepared.no_points_error()
        if settings.moves_weights:
            result, reader, after = _with_weights(split, settings, prepared, carried)
        else:
            result, reader, after = _with_z(split, settings, prepared, carried)
    refined = to_refined_frame(prepared, reader, result, propagation=propagation)
    if isinstance(refined, PnpDepthError):
        raise refined
    return replace(refined, in_window=True, carried=after)


def _with_z(
    split: Split, settings: Settings, frame: PreparedFrame, carried: WarmStart
) -> tuple[Refinement | PnpDepthError, AlignedDepth, WarmStart]:
    """The refinement by updates of z, what read its depth, and what the next frame may take."""
    reader = frame.depth_reader(settings)
    with torch.no_grad():
        z0 = split.front(*frame.arguments)
        before = reader(split.rear(z0)).detach()
    start, warm = z0, False
    if carried.change is not None and carried.change.shape == z0.shape:
        with torch.no_grad():
            moved = z0 + carried.change
            other = frame.depth_reader(settings, carried.alignment)
            warm = _loss(frame, settings, other(split.rear(moved))) < _loss(frame, settings, before)
        if warm:
            start, reader = moved, other
    (result,) = refine_from(split, start, [frame.points], settings, depth_of=[reader])
    last = result.last_good if isinstance(result, DivergedError) else result
    if not isinstance(last, Refinement):
        return result, reader, WarmStart()
    last = replace(last, before=before, warm=warm)
    if isinstance(result, DivergedError):
        result.last_good = last
        return result, reader, WarmStart()
    assert last.z is not None
    return last, reader, WarmStart(change=last.z - z0, alignment=reader.alignment)


def _loss(frame: PreparedFrame, settings: Settings, depth: Tensor) -> float:
    return float(checked_loss(settings.loss)(frame.points.sample(depth), frame.points.depth))


def _with_weights(
    split: Split, settings: Settings, frame: PreparedFrame, carried: WarmStart
) -> tuple[Refinement | PnpDepthError, AlignedDepth, WarmStart]:
    """The same by updates of weights."""
    reader = frame.depth_reader(settings)
    weights = MovingWeights(frame.network.module, settings.parameters, settings.seed)
    try:
        with opened_frame(split, frame, reader, settings.mask_scale) as seen:
            result = refine_weights(seen, weights, settings, carried=carried.weights)
    except PnpDepthError as error:
        return error, reader, WarmStart()
    used = carried.weights if result.warm else weights
    return result, reader, WarmStart(weights=used)
