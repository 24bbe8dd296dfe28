"""Refinement of frames in memory, from the image frame and back to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.completion.alignment import Alignment
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.refine import Refinement, RefineSettings, refine_batch
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import BatchError, DivergedError, NoPointsError, PnpDepthError, UsageError
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class RefinedFrame:
    """Depth before and after, (H, W) float32 metres in the image frame, 0 = unknown.

    alignment: of the network's output with the points, None where it is taken as it is.
    sigma: (H, W) float32 metres, standard deviation of `after`, if it was asked for. choice,
    baselines: what --auto chose and by what, and the scores of the simple baselines, for a record.
    """

    before: NDArray[np.float32]
    after: NDArray[np.float32]
    used: SparsePoints
    held_out: SparsePoints
    refinement: Refinement
    diverged: DivergedError | None
    alignment: Alignment | None = None
    notes: tuple[str, ...] = ()
    sigma: NDArray[np.float32] | None = None
    choice: dict[str, Any] | None = None
    baselines: dict[str, dict[str, Any]] | None = None


@dataclass(frozen=True, kw_only=True)
class PointError:
    """Error at sparse points in metres."""

    points: int
    mae: float
    rmse: float


def split_points(
    points: SparsePoints, holdout: float, seed: int
) -> tuple[SparsePoints, SparsePoints]:
    """(used, held out): a random share `holdout` of the points is held out, at least one of each.

    UsageError if the share is not in 0…1 or there are too few points for it.
    """
    if not 0 <= holdout < 1:
        raise UsageError(f"holdout {holdout} is not a share of the points; give 0 ≤ F < 1")
    mask = torch.zeros(len(points), dtype=torch.bool)
    if holdout > 0:
        if len(points) < 2:
            raise UsageError("holdout needs at least two sparse points")
        count = min(max(1, round(holdout * len(points))), len(points) - 1)
        order = np.random.default_rng(seed).permutation(len(points))
        mask[torch.from_numpy(order[:count])] = True
    return points.select(~mask), points.select(mask)


@dataclass(frozen=True, kw_only=True)
class FrameToRefine:
    """A frame, its points that are used, those that are held out, and what follows refinement.

    propagate: how the residual is propagated, one of `completion.propagation.PROPAGATIONS`.
    """

    inputs: Inputs
    used: SparsePoints
    held_out: SparsePoints
    propagate: str = "none"

    @classmethod
    def with_points(cls, inputs: Inputs, used: SparsePoints) -> FrameToRefine:
        """The frame with these points used and none held out."""
        none = used.select(torch.zeros(len(used), dtype=torch.bool))
        return cls(inputs=inputs, used=used, held_out=none)


def refine_frame(
    network: Network,
    split: Split,
    settings: RefineSettings,
    task: FrameToRefine,
    *,
    on_iteration: Callable[[int, float], None] = lambda done, loss: None,
) -> RefinedFrame:
    """Refinement of one frame in memory; a divergence with a last good depth is returned in it.

    split: the network's module, open; for frames of one size it learns the network once.
    """
    (frame,) = refine_frames(network, split, settings, (task,), on_iteration=on_iteration)
    if isinstance(frame, PnpDepthError):
        raise frame
    return frame


def refine_frames(
    network: Network,
    split: Split,
    settings: RefineSettings,
    tasks: Sequence[FrameToRefine],
    *,
    on_iteration: Callable[[int, float], None] = lambda done, loss: None,
) -> list[RefinedFrame | PnpDepthError]:
    """Frames refined in memory, in one pass of the network; where one has no result, its error.

    BatchError if the network does not take them together, or they differ in size.
    """
    with out_of_memory_is_a_device_error(network.device):
        ready = [ready_frame(network, settings, task) for task in tasks]
        going = [frame for frame in ready if isinstance(frame, ReadyFrame)]
        results = iter(_refined(split, settings, going, on_iteration) if going else ())
    return [finished_frame(f, next(results)) if isinstance(f, ReadyFrame) else f for f in ready]


@dataclass(frozen=True, kw_only=True)
class ReadyFrame:
    """A frame as the network takes it; `points` are the used ones, in the network's frame."""

    task: FrameToRefine
    frame: FrameMap
    arguments: tuple[torch.Tensor, ...]
    points: SparsePoints
    depth_of: AlignedDepth


def ready_frame(
    network: Network, settings: RefineSettings, task: FrameToRefine
) -> ReadyFrame | NoPointsError:
    """The frame as the network takes it; an error where no used point lies where it looks."""
    frame = FrameMap.fit(network.definition.size, *task.inputs.size)
    points = frame.points_to_network(task.used)
    if not len(points):
        return NoPointsError(
            f"none of the {len(task.used)} sparse points lies inside the part of the image that"
            f" network {network.definition.name!r} sees (rows and columns {frame.crop})"
        )
    at = points.tensors(network.device)
    return ReadyFrame(
        task=task,
        frame=frame,
        arguments=network.arguments(frame, task.inputs.rgb_tensor(), points),
        points=at,
        depth_of=AlignedDepth(network, at, settings.align, every=settings.align_every),
    )


def _refined(
    split: Split,
    settings: RefineSettings,
    frames: Sequence[ReadyFrame],
    on_iteration: Callable[[int, float], None],
) -> list[Refinement | PnpDepthError]:
    return refine_batch(
        split,
        _stacked([frame.arguments for frame in frames]),
        [frame.points for frame in frames],
        settings,
        depth_of=[frame.depth_of for frame in frames],
        on_iteration=lambda iteration, loss: on_iteration(iteration + 1, loss),
    )


def _stacked(arguments: Sequence[tuple[torch.Tensor, ...]]) -> tuple[torch.Tensor, ...]:
    """The arguments of all frames as those of one call."""
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


def finished_frame(
    ready: ReadyFrame, result: Refinement | PnpDepthError
) -> RefinedFrame | PnpDepthError:
    diverged = result if isinstance(result, DivergedError) else None
    if diverged is not None and diverged.last_good is not None:
        result = diverged.last_good
    if isinstance(result, PnpDepthError):
        return result
    return RefinedFrame(
        before=to_image(ready.frame, result.before),
        after=propagated(ready.task, to_image(ready.frame, result.after)),
        used=ready.task.used,
        held_out=ready.task.held_out,
        refinement=result,
        diverged=diverged,
        alignment=ready.depth_of.alignment,
        notes=ready.depth_of.notes,
    )


def propagated(task: FrameToRefine, depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The depth (H, W) with what is left at the used points spread, if the task says so."""
    if task.propagate == "none":
        return depth
    spread = propagate(
        torch.from_numpy(depth), task.used, task.inputs.picture(), kind=task.propagate
    )
    return spread.depth.numpy()


def to_image(frame: FrameMap, depth: torch.Tensor) -> NDArray[np.float32]:
    """Depth (1, 1, h, w) of the network's frame as (H, W) of the image's, 0 = unknown."""
    image = frame.depth_to_image(depth).cpu().numpy()
    known = np.isfinite(image) & (image > 0)
    return np.where(known, image, 0).astype(np.float32)


def point_error(depth: NDArray[np.float32], points: SparsePoints) -> PointError | None:
    """Error of a dense map (H, W) at points of its frame where it has depth; None without any."""
    predicted = points.sample(torch.from_numpy(depth))
    error = (predicted - points.depth)[predicted > 0].double()
    if not len(error):
        return None
    return PointError(
        points=len(error), mae=float(error.abs().mean()), rmse=float(error.square().mean().sqrt())
    )
