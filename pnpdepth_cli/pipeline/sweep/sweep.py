"""`pnpdepth sweep`: errors against ground truth over one or two varied parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import (
    InputError,
    PnpDepthError,
    UsageError,
)
from pnpdepth_cli.frames.opened import SplitCache
from pnpdepth_cli.io.atomic import make_folder, remove_leftovers
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.lock import locked_folder
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.pipeline.batch.batch import Listener
from pnpdepth_cli.pipeline.batch.frames import Task, find_frames, task_of
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.cluster.options import Spread, spread_of
from pnpdepth_cli.pipeline.cluster.pool import WorkerPool, worker_pool
from pnpdepth_cli.pipeline.sweep.computing import (
    Result,
    by_frame,
    results_of_frame,
    spread_results,
)
from pnpdepth_cli.pipeline.sweep.networks import (
    Model,
    SweptNetwork,
    model_of,
    models_of,
    swept_network,
)
from pnpdepth_cli.pipeline.sweep.plan import Run, RunId, Setup, sampling_of
from pnpdepth_cli.pipeline.sweep.plots import draw_study, need_matplotlib
from pnpdepth_cli.pipeline.sweep.points import OWN, Sampling
from pnpdepth_cli.pipeline.sweep.request import SweepRequest
from pnpdepth_cli.pipeline.sweep.seeds import over_seeds
from pnpdepth_cli.pipeline.sweep.state import SweepState
from pnpdepth_cli.pipeline.sweep.summary import FrameFigures, summarise, write_frames, write_sweep
from pnpdepth_cli.sensors import SamplePattern

Lines = Mapping[RunId, "dict[str, Any] | None"]
_GROUND_TRUTH_ONLY = SamplePattern(count=1)


def run_sweep(request: SweepRequest, listener: Listener) -> dict[str, Any]:
    """Writes tables and plots of the studies; returns the contents of sweep.json.

    Runs that are done with these settings and files are not computed again. Frames that fail are
    reported and counted.

    Raises:
        PnpDepthError: For what concerns all frames.
    """
    if isinstance(request.output, RemotePath):
        raise UsageError(f"{request.output}: sweep writes to a local folder; name one with -o")
    if request.plots:
        need_matplotlib()
    spread = spread_of(request.refine.network.device, request.cluster)
    if spread is not None:
        request = replace(
            request,
            refine=request.refine.with_fields(device=spread.device),
            cluster=replace(request.cluster, ray=spread.address),
        )
    sampling, tasks = _frames(request, listener)
    make_folder(request.output)
    with locked_folder(request.output, None, lambda: _clean(request.output)):
        state = SweepState(request.output)
        for note in state.notes():
            listener.say(note)
        networks = {
            model: swept_network(model, request, sampling, tasks, listener)
            for model in models_of(request)
        }
        runs = [(each, run) for each in networks.values() for run in each.runs]
        to_do = [(each, run) for each, run in runs if not state.is_done(run)]
        listener.say(
            f"{len(tasks):,} frames, {len(runs):,} runs: {len(runs) - len(to_do):,} done already,"
            f" {len(to_do):,} to do"
        )
        listener.begin(len(to_do))
        with _workers(spread if to_do else None, request, listener) as pool:
            for each in networks.values():
                own = [run for owner, run in to_do if owner is each]
                for row in _rows(each, own, state, pool):
                    listener.frame(row)
        return _write(request, sampling, networks, [task.name for task, _ in tasks], state)


@contextmanager
def _workers(
    spread: Spread | None, request: SweepRequest, listener: Listener
) -> Iterator[WorkerPool | None]:
    """The workers that are asked for; None for this process alone."""
    if spread is None:
        yield None
        return
    with worker_pool(spread, listener.say, inputs=[request.source]) as pool:
        yield pool


def _clean(output: Path) -> None:
    remove_leftovers(output)


def _frames(request: SweepRequest, listener: Listener) -> tuple[Sampling, list[tuple[Task, Frame]]]:
    """Where points come from unless that is varied, and the frames with ground truth.

    InputError if there are none, UsageError if no points can be drawn.
    """
    batch = BatchRequest(
        source=request.source,
        output=request.output,
        refine=request.refine.with_fields(sample=_GROUND_TRUTH_ONLY),
        layout=request.layout,
        protocol=request.protocol,
        limit=request.limit,
    )
    listed = find_frames(batch)
    frames = [frame for frame in listed.chosen if frame.gt is not None]
    without = len(listed.chosen) - len(frames)
    listener.say(f"layout: {listed.layout}: {len(frames):,} frames with ground truth")
    if not frames:
        raise InputError(
            f"{request.source}: none of its {without:,} frames has ground truth, without which"
            " nothing can be scored; add it as gt"
        )
    if without:
        listener.say(f"warning: {without:,} frames have no ground truth and are left out")
    sampling = request.sampling
    if sampling is None:
        own = any(frame.sparse is not None for frame in frames)
        sampling = Sampling(sensor=OWN if own else "uniform")
        origin = (
            "the frames' own" if own else "uniform of the ground truth, as frames have no others"
        )
        listener.say(f"points: {origin}; --sample to change")
    samplings = [sampling_of(cell, sampling) for study in request.studies for cell in study.cells()]
    scan = request.refine.files.scan
    if any(
        each.lidar for each in samplings
    ):  # then the calibration is of the camera, not of a scan
        frames = [
            replace(f, calib=scan.calib or f.calib, camera=_given(scan.camera, f.camera))
            for f in frames
        ]
        scan = replace(scan, calib=None, camera=None)
    own_wanted = any(each.sensor == OWN for each in samplings)
    reading_own = replace(batch, refine=request.refine.with_fields(scan=scan, sample=None))
    return sampling, [
        (task_of(reading_own if own_wanted and frame.sparse else batch, frame), frame)
        for frame in frames
    ]


def _given(first: int | None, otherwise: int | None) -> int | None:
    return otherwise if first is None else first


def _rows(
    each: SweptNetwork, runs: Sequence[Run], state: SweepState, pool: WorkerPool | None
) -> Iterator[dict[str, Any]]:
    """Computes and records each run; yields a row for each."""
    if pool is not None:
        for run, result in spread_results(runs, each.first, pool):
            yield _recorded(run, result, state)
        return
    with SplitCache(each.refiner.network) as cache:
        for frame_runs in by_frame(runs):
            for run, result in results_of_frame(frame_runs, cache):
                yield _recorded(run, result, state)


def _recorded(run: Run, result: Result, state: SweepState) -> dict[str, Any]:
    """Records the run; returns its row for a listener."""
    row = {"name": run.frame.name, "status": "done", "message": None}
    if isinstance(result, PnpDepthError):
        state.fail(run, str(result))
        return row | {"status": "failed", "message": str(result)}
    state.add(run, result)
    if result.get("diverged"):
        return row | {"status": "diverged", "message": result["diverged"]}
    return row


def _write(
    request: SweepRequest,
    sampling: Sampling,
    networks: Mapping[Model, SweptNetwork],
    names: Sequence[str],
    state: SweepState,
) -> dict[str, Any]:
    """Writes the tables and plots; returns the contents of sweep.json."""
    lines: dict[Model, Lines] = {
        model: {run.id: state.result(run.key) for run in each.runs}
        for model, each in networks.items()
    }
    studies: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    for study in request.studies:
        cells = []
        for cell in study.cells():
            model = model_of(cell, request)
            plan = networks[model].plan
            figures = _figures(plan.setup(cell), names, lines[model])
            summary = summarise(figures, request.resamples, cost=request.cost)
            cells.append({"parameters": dict(cell), **summary})
            rows += [{"study": study.name, "parameters": cell, "figures": f} for f in figures]
        plot = f"sweep_{study.name}.{request.plot_format}" if request.plots else None
        if plot is not None:
            draw_study(study, cells, request.output / plot)
        values = {axis.name: list(axis.values) for axis in study.axes}
        studies.append(
            {
                "name": study.name,
                "parameters": values,
                "plot": plot,
                "cells": cells,
                "over_seeds": over_seeds(cells),
            }
        )
    first, *others = networks.values()
    record = {
        "command": "sweep",
        "source": str(request.source),
        "output": str(request.output),
        "model": first.refiner.model_record,
        **({"more_models": [each.refiner.model_record for each in others]} if others else {}),
        "frames": list(names),
        "seeds": request.seeds,
        "base": first.base | asdict(sampling),
        "studies": studies,
    }
    write_sweep(request.output, record)
    write_frames(request.output / "sweep_frames.csv", rows)
    return record


def _figures(setup: Setup, names: Sequence[str], lines: Lines) -> list[FrameFigures]:
    """A cell's scores of each frame and seed."""
    return [
        FrameFigures.of(
            name,
            seed,
            setup.iterations,
            linear=lines[name, seed, setup.sampling, None],
            curve=lines[name, seed, setup.sampling, setup.method],
        )
        for name in names
        for seed in setup.seeds
    ]
