"""Computes the runs of a sweep: one refinement gives the scores after every number of updates."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import groupby
from typing import Any, TypeVar

import torch
from torch import Tensor

from pnpdepth_cli.commands.batch.running import read_frame
from pnpdepth_cli.commands.refinement.inputs import Inputs
from pnpdepth_cli.commands.sweep.plan import Method, Run
from pnpdepth_cli.commands.sweep.points import frame_points
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.core.refine import Refinement, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DeviceError, DivergedError, PnpDepthError, StorageError
from pnpdepth_cli.frames.opened import SplitCache
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.settings import Settings

T = TypeVar("T")
Scores = dict[str, Any]
Result = dict[str, Any] | PnpDepthError
"""What the journal has of a run: `points`, `scores` by the number of updates (or "linear") and, of
a refinement, the scores of the `plain` network and why it `diverged`. Or why the run failed."""


def results(runs: Sequence[Run], network: Network) -> Iterator[tuple[Run, Result]]:
    """Yields the runs of a network with their results; each frame is read once.

    The runs of a frame follow each other, and among these those with the same points.
    """
    with SplitCache(network) as cuts:
        for _, of_frame in groupby(runs, key=lambda run: run.frame.name):
            same_frame = list(of_frame)
            inputs = _tried(read_frame, same_frame[0].task)
            for _, of_points in groupby(same_frame, key=lambda run: (run.sampling, run.seed)):
                same_points = list(of_points)
                drawn = _tried(_drawn, same_points[0], inputs)
                for run in same_points:
                    yield run, _tried(_result_of, run, drawn, cuts)


def _tried(step: Callable[..., T], *arguments: Any) -> T | PnpDepthError:
    """The result, or the error of a frame that cannot be used: of this step, or of one before."""
    for each in arguments:
        if isinstance(each, PnpDepthError):
            return each
    try:
        return step(*arguments)
    except (StorageError, DeviceError):
        raise
    except PnpDepthError as error:
        return error


def _drawn(run: Run, inputs: Inputs) -> Inputs:
    """The frame with the run's points."""
    points = frame_points(run.sampling, run.seed, inputs, run.task.request, run.frame)
    return replace(inputs, points=points)


def _result_of(run: Run, inputs: Inputs, cuts: SplitCache) -> dict[str, Any]:
    """The result of a run, of the frame with its points."""
    points, network = len(inputs.points), cuts.network
    if run.method is None:
        scores = _score(linear(inputs.points), network, inputs)
        return {"points": points, "scores": {"linear": scores}}
    torch.manual_seed(run.seed)
    try:
        if run.method.settings.moves_weights:
            cuts.close()
            return {"points": points} | _weights_result(network, run, run.method, inputs)
        split = cuts.at(run.method.layer)
        return {"points": points} | refined(network, split, run.method, inputs, run.iterations)
    except BaseException:
        cuts.close()
        raise


def refined(
    network: Network, split: Split, method: Method, inputs: Inputs, wanted: Collection[int]
) -> dict[str, Any]:
    """Returns a refinement's scores after each wanted number of updates.

    They equal those of a refinement of each number alone if the step is constant. After a
    divergence they are those of the last finite depth. The network is cut at the method's layer.
    """
    prepared = prepare(network, inputs.registered())
    if not len(prepared.points):
        raise prepared.no_points_error()
    settings = replace(method.settings, iterations=max(wanted))
    keep = range(settings.iterations + 1) if settings.gives_best else {0, *wanted}
    diverged: DivergedError | None = None
    moments = [time.perf_counter()]
    with out_of_memory_is_a_device_error(network.device):
        try:
            result = refine(
                split,
                prepared.arguments,
                prepared.points,
                settings,
                depth_of=prepared.depth_reader(settings),
                keep_depths=keep,
                on_iteration=lambda *_: moments.append(time.perf_counter()),
            )
        except DivergedError as error:
            if not isinstance(error.last_good, Refinement):
                raise
            diverged, result = error, error.last_good
        moments.append(time.perf_counter())
        updates = len(result.losses) - 1
        seen = {**result.depths, result.kept: result.after}

        def after(k: int, propagation: str) -> Scores:
            depth = prepared.map.depth_to_image(seen[k]).cpu()
            if propagation != "none":
                frame = inputs.registered()
                depth = propagate(depth, inputs.points, frame.rgb, kind=propagation).depth
            return _score(depth, network, inputs)

        scored = {k: _kept(result.losses, min(k, updates), settings) for k in wanted}
        by_index = {index: after(index, method.propagate) for index in set(scored.values())}
        return {
            "plain": after(0, "none"),
            "scores": {
                str(k): by_index[index]
                | {"updates": min(k, updates), "time_s": _until(moments, min(k, updates))}
                for k, index in sorted(scored.items())
            },
            "diverged": str(diverged) if diverged else None,
        }


def _until(moments: Sequence[float], updates: int) -> float:
    """Seconds until the depth after so many updates, of the moments of all and of the end."""
    began, *done, end = moments
    last_pass = end - (done[-1] if done else began)
    return last_pass + (done[min(updates, len(done)) - 1] - began if updates and done else 0.0)


def _kept(losses: Sequence[float], updates: int, settings: Settings) -> int:
    """The index of z that a refinement of so many updates returns: the last, or of least loss."""
    if not settings.gives_best:
        return updates
    return min(range(updates + 1), key=lambda k: (losses[k], -k))


def _weights_result(network: Network, run: Run, method: Method, inputs: Inputs) -> dict[str, Any]:
    """The same where weights move; each number of updates is refined for itself."""
    frame, scores, plain, diverged = inputs.registered(), {}, Scores(), None
    cut = network.cut_at_points() if method.settings.masked else network.cut_at(method.layer)
    with cut as split:
        for k in run.iterations:
            settings = replace(method.settings, iterations=k, seed=run.seed)
            began = time.perf_counter()
            one = refine_frame(network, split, settings, frame, propagation=method.propagate)
            updates = min(k, len(one.refinement.losses))
            time_s = time.perf_counter() - began
            plain = _score(torch.from_numpy(one.before), network, inputs)
            scores[str(k)] = _score(torch.from_numpy(one.after), network, inputs)
            scores[str(k)] |= {"updates": updates, "time_s": time_s}
            diverged = str(one.diverged) if one.diverged else None
    return {"plain": plain, "scores": scores, "diverged": diverged}


def _score(depth: Tensor, network: Network, inputs: Inputs) -> Scores:
    """The scores of (H, W) depth on the ground truth inside the network's crop."""
    assert inputs.gt is not None
    top, left, height, width = FrameMap.fit(network.definition.size, *inputs.size).crop
    ground_truth = torch.zeros(inputs.size)
    here = (slice(top, top + height), slice(left, left + width))
    ground_truth[here] = torch.from_numpy(inputs.gt)[here]
    return asdict(score(depth, ground_truth))
