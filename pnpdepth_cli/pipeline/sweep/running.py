"""Computes the runs of a sweep: one refinement gives the scores after every number of updates."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from typing import Any, TypeVar

import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.core.refine import Refinement, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DeviceError, DivergedError, PnpDepthError, StorageError
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.opened import SplitCache
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.pipeline.batch.reading import read_frame
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.sweep.plan import Method, Run
from pnpdepth_cli.pipeline.sweep.points import frame_points
from pnpdepth_cli.settings import Settings

T = TypeVar("T")
Result = dict[str, Any] | PnpDepthError
"""What the journal has of a run, or why it failed."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A refinement scored after several numbers of updates."""

    plain: dict[str, Any]
    """Scores of the network alone."""
    scores: dict[int, dict[str, Any]]
    """By the number of updates; after a divergence of the last finite depth."""
    step: float
    """α as a number."""
    times_s: dict[int, float]
    """By the number of updates: seconds until the depth after it."""
    updates: int
    """Number of updates until the end or a divergence."""
    diverged: str | None
    """Why it diverged; None if it did not."""


def results(runs: Sequence[Run], network: Network) -> Iterator[tuple[Run, Result]]:
    """Yields the runs with their results; each frame is read once.

    Args:
        runs: Those of a frame follow each other, and among these those with the same points.
        network: The network of all runs.
    """
    with SplitCache(network) as cuts:
        for _, of_frame in groupby(runs, key=lambda run: run.frame.name):
            inputs: Inputs | PnpDepthError | None = None
            for _, of_points in groupby(of_frame, key=lambda run: (run.sampling, run.seed)):
                same_points = list(of_points)
                if inputs is None:
                    inputs = _result_or_error(read_frame, same_points[0].task)
                drawn = inputs
                if not isinstance(inputs, PnpDepthError):
                    drawn = _result_or_error(_drawn, same_points[0], inputs)
                for run in same_points:
                    if isinstance(drawn, PnpDepthError):
                        yield run, drawn
                    else:
                        yield run, _result_or_error(_result_of, run, drawn, cuts)


def _result_or_error(read: Callable[..., T], *arguments: Any) -> T | PnpDepthError:
    """The result, or the error of a frame that cannot be used."""
    try:
        return read(*arguments)
    except (StorageError, DeviceError):
        raise
    except PnpDepthError as error:
        return error


def _drawn(run: Run, inputs: Inputs) -> Inputs:
    """The frame with the run's points."""
    points = frame_points(run.sampling, run.seed, inputs, run.task.request, run.frame)
    return replace(inputs, points=points)


def _result_of(run: Run, inputs: Inputs, cuts: SplitCache) -> dict[str, Any]:
    """The result of a run as the journal has it, of the frame with the run's points."""
    done = {"state": "done", "points": len(inputs.points)}
    if run.method is None:
        return done | {"scores": {"linear": interpolated(cuts.network, inputs)}}
    torch.manual_seed(run.seed)
    try:
        if run.method.settings.moves_weights:
            cuts.close()
            curve = weights_curve(
                cuts.network, _seeded(run.method, run.seed), inputs, run.iterations
            )
        else:
            split = cuts.at(run.method.layer)
            curve = refined_curve(cuts.network, split, run.method, inputs, run.iterations)
    except BaseException:
        cuts.close()
        raise
    return done | {
        "plain": curve.plain,
        "scores": {
            str(k): scores | {"updates": min(k, curve.updates), "time_s": curve.times_s[k]}
            for k, scores in curve.scores.items()
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
    """Returns a refinement's scores after each wanted number of updates.

    They equal those of a refinement of each number alone if the step is constant.

    Args:
        network: The network.
        split: The network cut at the method's layer, open.
        method: How to refine.
        inputs: The frame with its points.
        wanted: Numbers of updates.
    """
    prepared = prepare(network, inputs.registered())
    if not len(prepared.points):
        raise prepared.no_points_error()
    settings = replace(method.settings, iterations=max(wanted))
    reader = prepared.depth_reader(settings)
    keep = range(settings.iterations + 1) if settings.gives_best else {0, *wanted}
    diverged: DivergedError | None = None
    clock = _Clock()
    with out_of_memory_is_a_device_error(network.device):
        try:
            result = refine(
                split,
                prepared.arguments,
                prepared.points,
                settings,
                depth_of=reader,
                keep_depths=keep,
                on_iteration=clock.on_iteration,
            )
        except DivergedError as error:
            if not isinstance(error.last_good, Refinement):
                raise
            diverged, result = error, error.last_good
        clock.stop()
        updates = len(result.losses) - 1
        kept = {k: _kept(result.losses, min(k, updates), settings) for k in wanted}
        ground_truth = ground_truth_in_view(network, inputs)
        seen = {**result.depths, result.kept: result.after}
        depths = {k: prepared.map.depth_to_image(seen[k]).cpu() for k in {0, *kept.values()}}
        scores = {
            index: asdict(score(_propagated(depths[index], inputs, method.propagate), ground_truth))
            for index in set(kept.values())
        }
    return Curve(
        plain=asdict(score(depths[0], ground_truth)),
        scores={k: scores[index] for k, index in sorted(kept.items())},
        times_s={k: clock.until(min(k, updates)) for k in kept},
        step=result.step,
        updates=updates,
        diverged=str(diverged) if diverged else None,
    )


def _seeded(method: Method, seed: int) -> Method:
    settings = method.settings
    return replace(method, settings=replace(settings, seed=seed))


def weights_curve(network: Network, method: Method, inputs: Inputs, wanted: Sequence[int]) -> Curve:
    """Returns the same where weights move; each number of updates is refined for itself."""
    truth, frame = ground_truth_in_view(network, inputs), inputs.registered()
    refined: dict[int, Refined] = {}
    times: dict[int, float] = {}
    cut = network.cut_at_points() if method.settings.masked else network.cut_at(method.layer)
    with cut as split:
        for k in wanted:
            settings = replace(method.settings, iterations=k)
            began = time.perf_counter()
            refined[k] = refine_frame(network, split, settings, frame, propagation=method.propagate)
            times[k] = time.perf_counter() - began
    last = refined[max(wanted)]
    before = _propagated(torch.from_numpy(last.before), inputs, method.propagate)
    return Curve(
        plain=asdict(score(torch.from_numpy(last.before), truth)),
        scores={
            k: asdict(score(torch.from_numpy(each.after) if k else before, truth))
            for k, each in sorted(refined.items())
        },
        times_s=times,
        step=last.refinement.step,
        updates=len(last.refinement.losses),
        diverged=str(last.diverged) if last.diverged else None,
    )


class _Clock:
    """Times a refinement, and from it the shorter ones that it includes."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._updates: list[float] = []
        self._last_pass = 0.0

    def on_iteration(self, iteration: int, loss: float) -> None:
        """Notes that an update is done."""
        self._updates.append(time.perf_counter() - self._began)

    def stop(self) -> None:
        """Notes that the pass after the last update is done."""
        done = time.perf_counter() - self._began
        self._last_pass = done - (self._updates[-1] if self._updates else 0.0)

    def until(self, updates: int) -> float:
        """Returns seconds until the depth after so many updates; after none, by extrapolation."""
        if not self._updates:
            return self._last_pass
        if updates > 0:
            return self._updates[min(updates, len(self._updates)) - 1] + self._last_pass
        apart = (self._updates[-1] - self._updates[0]) / max(1, len(self._updates) - 1)
        return max(0.0, self._updates[0] - apart) + self._last_pass


def interpolated(network: Network, inputs: Inputs) -> dict[str, Any]:
    """Returns the scores of linear interpolation on the pixels inside the network's crop."""
    return asdict(score(linear(inputs.points), ground_truth_in_view(network, inputs)))


def ground_truth_in_view(network: Network, inputs: Inputs) -> Tensor:
    """Returns (H, W) the ground truth, 0 outside the network's crop."""
    assert inputs.gt is not None
    top, left, height, width = FrameMap.fit(network.definition.size, *inputs.size).crop
    ground_truth = torch.zeros(inputs.size)
    here = (slice(top, top + height), slice(left, left + width))
    ground_truth[here] = torch.from_numpy(inputs.gt)[here]
    return ground_truth


def _kept(losses: Sequence[float], updates: int, settings: Settings) -> int:
    """The index of z that a refinement of so many updates returns: the last, or of least loss."""
    if not settings.gives_best:
        return updates
    return min(range(updates + 1), key=lambda k: (losses[k], -k))


def _propagated(depth: Tensor, inputs: Inputs, kind: str) -> Tensor:
    """(H, W) the depth with the residuals at the points propagated."""
    if kind == "none":
        return depth
    return propagate(depth, inputs.points, inputs.registered().rgb, kind=kind).depth
