"""Frames refined in memory, from the image frame and back to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.completion.outliers import outliers
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.refine import OnIteration, Refinement, refine_from
from pnpdepth_cli.core.split import InputSplit, Split
from pnpdepth_cli.core.weights import MovingWeights
from pnpdepth_cli.core.weights_refinement import FrameOfPoints, Predict, refine_weights
from pnpdepth_cli.errors import BatchError, DivergedError, PnpDepthError
from pnpdepth_cli.frames.frame import DepthMap, Frame, Refined, no_points
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

MIN_POINTS_FOR_OUTLIERS = 50
"""Of fewer points, one inconsistent with the others may be all that is seen of an object."""


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
        readers = [frame.depth_reader(settings) for frame in seen]
        results: list[Refinement | PnpDepthError] = []
        if seen and settings.moves_weights:
            if len(seen) > 1:
                raise BatchError("weights are updated for one frame alone; refine one at a time")
            results = [refine_frame_weights(split, settings, seen[0], readers[0], on_iteration)]
        elif seen:
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


def refine_frame_weights(
    split: Split,
    settings: Settings,
    frame: PreparedFrame,
    reader: AlignedDepth,
    on_iteration: OnIteration = lambda done, loss: None,
) -> Refinement | PnpDepthError:
    """Returns the refinement of one frame by updates of weights, or its error.

    The split is at the network's sparse depth, or at a layer. The frame has at least one point.
    """
    weights = MovingWeights(frame.network.module, settings.parameters, settings.seed)
    try:
        with opened_frame(split, frame, reader, settings.mask_scale) as seen:
            return refine_weights(seen, weights, settings, on_iteration=on_iteration)
    except PnpDepthError as error:
        return error


@contextmanager
def opened_frame(
    split: Split, frame: PreparedFrame, reader: AlignedDepth, scale: float
) -> Iterator[FrameOfPoints]:
    """Yields the frame as the network predicts it from any of its points, after one plain pass.

    A split at a layer stays at z_0. One at the points predicts the steps from a reduced image.
    """
    predict: Predict
    in_steps: Predict
    with ExitStack() as stack:
        if isinstance(split, InputSplit):
            output = split.first(*frame.arguments, varying=frame.varying)
            predict = in_steps = lambda points: split.again(*frame.arguments_for(points))
            reduced = frame.reduced(scale)
            if reduced is not None:
                small = stack.enter_context(frame.network.cut_at_points())
                small.first(*reduced.arguments, varying=reduced.varying)

                def reduced_steps(points: SparsePoints, frame: PreparedFrame = reduced) -> Any:
                    return small.again(*frame.arguments_for(points.resized(*frame.points.size)))

                in_steps = reduced_steps
        else:
            with torch.no_grad():
                z0 = split.front(*frame.arguments)
                output = split.rear(z0)
            predict = in_steps = lambda points: split.rear(z0)
        yield FrameOfPoints(
            points=frame.points,
            inliers=_inliers(frame.points),
            output=output,
            predict=predict,
            predict_in_steps=in_steps,
            depth_of=reader,
        )


def _inliers(points: SparsePoints) -> SparsePoints:
    """The points without those inconsistent with the others; of a few, none is."""
    if len(points) < MIN_POINTS_FOR_OUTLIERS:
        return points
    on_cpu = points.tensors()
    return points.select(~outliers(torch.ones(points.size), on_cpu, None).to(points.xy.device))


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
