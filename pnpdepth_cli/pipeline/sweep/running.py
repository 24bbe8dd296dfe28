"""The runs of a sweep: one refinement gives the scores of every number of updates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.auto.candidates import SplitCache
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.core.refine import Refinement, RefineSettings, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.sweep.plan import Method, Run


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A refinement scored after several numbers of updates.

    plain: of the network alone. scores: by the number of updates. step: α as a number. diverged:
    why there were no more updates than `made`, None if there were; what was asked of more is
    scored with the last good depth.
    """

    plain: dict[str, Any]
    scores: dict[int, dict[str, Any]]
    step: float
    made: int
    diverged: str | None


def result_of(run: Run, inputs: Inputs, cache: SplitCache) -> dict[str, Any]:
    """The result of a run of this frame with these points, as the journal has it."""
    done = {"state": "done", "points": len(inputs.points)}
    if run.method is None:
        return done | {"scores": {"linear": interpolated(cache.network, inputs)}}
    torch.manual_seed(run.seed)
    try:
        split = cache.at(run.method.layer)
        curve = refined_curve(cache.network, split, run.method, inputs, run.iterations)
    except BaseException:
        cache.close()
        raise
    return done | {
        "plain": curve.plain,
        "scores": {
            str(k): scores | {"updates": min(k, curve.made)} for k, scores in curve.scores.items()
        },
        "step": curve.step,
        "diverged": curve.diverged,
    }


def refined_curve(
    network: Network,
    split: Split,
    method: Method,
    inputs: Inputs,
    wanted: Sequence[int],
) -> Curve:
    """One refinement of as many updates as the most that are wanted, scored after each wanted.

    It is the same as a refinement of each number alone, unless the step falls with their share.
    split: the network at the method's layer, open.
    """
    prepared = prepare(network, inputs.frame())
    if not len(prepared.points):
        raise prepared.no_points_error()
    settings = replace(method.settings, iterations=max(wanted))
    reader = prepared.depth_reader(settings)
    keep = range(settings.iterations + 1) if settings.gives_best else {0, *wanted}
    diverged: DivergedError | None = None
    with out_of_memory_is_a_device_error(network.device):
        try:
            result = refine(
                split,
                prepared.arguments,
                prepared.points,
                settings,
                depth_of=reader,
                keep_depths=keep,
            )
        except DivergedError as error:
            if not isinstance(error.last_good, Refinement):
                raise
            diverged, result = error, error.last_good
        made = len(result.losses) - 1
        kept = {k: _kept(result.losses, min(k, made), settings) for k in wanted}
        truth = seen_truth(network, inputs)
        seen = {**result.depths, result.kept: result.after}
        depths = {k: prepared.map.depth_to_image(seen[k]).cpu() for k in {0, *kept.values()}}
        found = {
            place: asdict(score(_spread(depths[place], inputs, method.propagate), truth))
            for place in set(kept.values())
        }
    return Curve(
        plain=asdict(score(depths[0], truth)),
        scores={k: found[place] for k, place in sorted(kept.items())},
        step=result.step,
        made=made,
        diverged=str(diverged) if diverged else None,
    )


def interpolated(network: Network, inputs: Inputs) -> dict[str, Any]:
    """The scores of linear interpolation of the points, on the pixels that the network sees."""
    return asdict(score(linear(inputs.points), seen_truth(network, inputs)))


def seen_truth(network: Network, inputs: Inputs) -> Tensor:
    """(H, W) the true depth, unknown where the network does not look."""
    assert inputs.gt is not None
    top, left, height, width = FrameMap.fit(network.definition.size, *inputs.size).crop
    truth = torch.zeros(inputs.size)
    here = (slice(top, top + height), slice(left, left + width))
    truth[here] = torch.from_numpy(inputs.gt)[here]
    return truth


def _kept(losses: Sequence[float], updates: int, settings: RefineSettings) -> int:
    """Which z's depth a refinement of so many updates gives: the last, or that of least loss."""
    if not settings.gives_best:
        return updates
    return min(range(updates + 1), key=lambda k: (losses[k], -k))


def _spread(depth: Tensor, inputs: Inputs, kind: str) -> Tensor:
    """The depth (H, W) with what is left at the points spread over it."""
    if kind == "none":
        return depth
    return propagate(depth, inputs.points, inputs.frame().rgb, kind=kind).depth
