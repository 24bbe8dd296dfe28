"""`pnpdepth sweep`: errors against ground truth over one or two varied parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

from pnpdepth_cli.auto.predictions import SplitCache
from pnpdepth_cli.errors import (
    DeviceError,
    InputError,
    PnpDepthError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.io.atomic import make_folder, remove_leftovers
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.lock import locked_folder
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.pipeline.batch.batch import Listener
from pnpdepth_cli.pipeline.batch.frames import Task, find_frames, task_of
from pnpdepth_cli.pipeline.batch.request import BatchRequest, FrameSelection
from pnpdepth_cli.pipeline.batch.settings import model_identity
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.pipeline.refinement.load_refiner import load_refiner
from pnpdepth_cli.pipeline.refinement.method import with_preset
from pnpdepth_cli.pipeline.refinement.refiner import Refiner
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.pipeline.sweep.axes import Cell, Study
from pnpdepth_cli.pipeline.sweep.plan import Plan, Run, RunId, Setup, sampling_of
from pnpdepth_cli.pipeline.sweep.plots import draw_study, need_matplotlib
from pnpdepth_cli.pipeline.sweep.points import OWN, Sampling, frame_points
from pnpdepth_cli.pipeline.sweep.running import result_of
from pnpdepth_cli.pipeline.sweep.seeds import over_seeds
from pnpdepth_cli.pipeline.sweep.state import SweepState
from pnpdepth_cli.pipeline.sweep.summary import FrameFigures, summarise, write_frames, write_sweep
from pnpdepth_cli.sensors import SamplePattern

T = TypeVar("T")
Lines = Mapping[RunId, "dict[str, Any] | None"]
Model = tuple[str, "Path | None"]
"""A network and its weights, as the user names them."""
_GROUND_TRUTH_ONLY = SamplePattern(count=1)
_RESOLVE_POINTS = 500
"""Points of the ground truth that the definition is resolved on; the paper uses 500 indoors."""


@dataclass(frozen=True, kw_only=True)
class SweepRequest(FrameSelection):
    """What to vary, over which frames."""

    studies: Sequence[Study]
    """As `studies_of` returns them."""
    sampling: Sampling | None = None
    """Where points come from unless that is varied; None for the frames' own, or else the ground
    truth."""
    seeds: int = 1
    """Draws of the points, with consecutive seeds."""
    plots: bool = True
    """True to write a plot of each study."""
    plot_format: str = "png"
    """One of PLOT_FORMATS."""
    cost: bool = False
    """True to report the time of the refinement beside its error."""
    resamples: int = 2000
    """Bootstrap samples behind the intervals."""

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UsageError(f"seeds {self.seeds}: the points have to be drawn once at least")


def run_sweep(request: SweepRequest, listener: Listener) -> dict[str, Any]:
    """Writes tables and plots of the studies; returns the contents of sweep.json.

    Runs that are done with these settings and files are not computed again. Frames that fail are
    reported and counted.

    Raises:
        PnpDepthError: For what concerns all frames.
    """
    if request.plots:
        need_matplotlib()
    sampling, tasks = _frames(request, listener)
    make_folder(request.output)
    with locked_folder(request.output, None, lambda: _clean(request.output)):
        state = SweepState(request.output)
        for note in state.notes():
            listener.say(note)
        networks = {
            model: _network(model, request, sampling, tasks, listener) for model in _models(request)
        }
        runs = [(each, run) for each in networks.values() for run in each.runs]
        to_do = [(each, run) for each, run in runs if not state.is_done(run)]
        listener.say(
            f"{len(tasks):,} frames, {len(runs):,} runs: {len(runs) - len(to_do):,} done already,"
            f" {len(to_do):,} to do"
        )
        listener.begin(len(to_do))
        for each in networks.values():
            own = [run for owner, run in to_do if owner is each]
            for row in _rows(own, each.refiner, state):
                listener.frame(row)
        return _write(request, sampling, networks, [task.name for task, _ in tasks], state)


@dataclass(frozen=True, kw_only=True)
class _Network:
    """A network of the sweep and its runs."""

    refiner: Refiner
    """The network, loaded."""
    base: dict[str, Any]
    """The settings that are not varied."""
    plan: Plan
    """What its cells need."""
    runs: tuple[Run, ...]
    """Of all frames."""


def _models(request: SweepRequest) -> list[Model]:
    """The networks of the cells, each once; one in most sweeps."""
    cells = [cell for study in request.studies for cell in study.cells()]
    return list(dict.fromkeys(_model_of(cell, request) for cell in cells))


def _model_of(cell: Cell, request: SweepRequest) -> Model:
    """The network of a cell, varied as `NETWORK` or `NETWORK@WEIGHTS`, and its weights."""
    network = request.refine.network
    if "model" not in cell:
        return network.model, network.checkpoint
    spec, at, weights = cell["model"].partition("@")
    if not at and network.checkpoint is not None:
        raise UsageError("--checkpoint is of one network; vary model=NETWORK@WEIGHTS instead")
    return spec, Path(weights) if at else None


def _network(
    model: Model,
    request: SweepRequest,
    sampling: Sampling,
    tasks: Sequence[tuple[Task, Frame]],
    listener: Listener,
) -> _Network:
    """The network, loaded, and the runs of its cells."""
    spec, checkpoint = model
    cells = [
        cell
        for study in request.studies
        for cell in study.cells()
        if _model_of(cell, request) == model
    ]
    refine = request.refine.with_fields(model=spec, checkpoint=checkpoint)
    tasks = [
        (replace(task, request=task.request.with_fields(model=spec, checkpoint=checkpoint)), frame)
        for task, frame in tasks
    ]
    refiner = _resolved(replace(request, refine=refine), tasks, listener)
    definition = refiner.network.definition
    plan = Plan(cells, definition, refine, sampling, request.seeds, model_identity(refine))
    for layer in plan.layers:
        with refiner.network.cut_at(layer):
            pass  # reports an unknown layer before anything is computed
    return _Network(
        refiner=refiner,
        base=_base(definition, refine),
        plan=plan,
        runs=tuple(run for task, frame in tasks for run in plan.runs(task, frame)),
    )


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


def _resolved(
    request: SweepRequest, tasks: Sequence[tuple[Task, Frame]], listener: Listener
) -> Refiner:
    """The network, its definition resolved on the first frame that can be read.

    Points of the ground truth are used, so that it does not depend on what is varied.
    """
    errors = []
    for task, frame in tasks:
        try:
            inputs = read_inputs(task.request)
            known = 0 if inputs.gt is None else int((inputs.gt > 0).sum())
            some = Sampling(sensor="uniform", points=str(min(_RESOLVE_POINTS, known)))
            points = frame_points(some, request.refine.hold_out.seed, inputs, task.request, frame)
        except InputError as error:
            errors.append(error)
            continue
        refiner = load_refiner(
            task.request.with_fields(layer=_some_layer(request)), replace(inputs, points=points)
        )
        for note in inputs.notes:
            if task.request.files.sample is None or not note.startswith("sparse"):
                listener.say(f"{task.name}: {note}")
        for note in refiner.network.notes:
            listener.say(note)
        base = _base(refiner.network.definition, request.refine)
        listener.say(
            f"network: {refiner.network.definition.name}; where not varied: cut at {base['layer']},"
            f" {base['iterations']} updates of z ({base['update']}, {base['loss']}, step"
            f" {base['lr']})"
        )
        return refiner
    raise errors[0]


def _some_layer(request: SweepRequest) -> str | None:
    """A layer of the study or of the request, as a network may have no default."""
    axes = [axis for study in request.studies for axis in study.axes if axis.name == "layer"]
    return axes[0].values[0] if axes else request.refine.method.layer


def _base(definition: ModelDefinition, request: RefineRequest) -> dict[str, Any]:
    """The settings that are not varied."""
    method = with_preset(request.method)
    settings = resolve_settings(definition, method)
    layer = method.layer or definition.default_layer
    return {
        "layer": None if layer is None else resolve_layer(definition, layer),
        **asdict(settings),
        "propagate": method.propagate or "none",
    }


def _rows(runs: Sequence[Run], refiner: Refiner, state: SweepState) -> Iterator[dict[str, Any]]:
    """Computes and records each run; yields a row for each. Frames are read once."""
    with SplitCache(refiner.network) as cache:
        for _, of_frame in groupby(runs, key=lambda run: run.frame.name):
            frame_runs = list(of_frame)
            inputs = _result_or_error(read_inputs, frame_runs[0].task.request)
            for _, of_points in groupby(frame_runs, key=lambda run: (run.sampling, run.seed)):
                same_points = list(of_points)
                failed = isinstance(inputs, PnpDepthError)
                drawn = inputs if failed else _result_or_error(_drawn, same_points[0], inputs)
                for run in same_points:
                    yield _done(run, drawn, cache, state)


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


def _done(
    run: Run, inputs: Inputs | PnpDepthError, cache: SplitCache, state: SweepState
) -> dict[str, Any]:
    """Computes and records the run; returns its row for a listener."""
    result = (
        inputs
        if isinstance(inputs, PnpDepthError)
        else _result_or_error(result_of, run, inputs, cache)
    )
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
    networks: Mapping[Model, _Network],
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
            model = _model_of(cell, request)
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
