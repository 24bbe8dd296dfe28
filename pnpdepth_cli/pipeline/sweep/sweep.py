"""`pnpdepth sweep`: errors against ground truth over one or two varied parameters."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.io.atomic import make_folder, remove_leftovers
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.lock import locked_folder
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.pipeline.batch.batch import Listener
from pnpdepth_cli.pipeline.batch.frames import Task, find_frames, reference_frames, task_of
from pnpdepth_cli.pipeline.batch.reading import read_frame
from pnpdepth_cli.pipeline.batch.request import BatchRequest, FrameSelection
from pnpdepth_cli.pipeline.batch.settings import model_identity
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.record import model_record
from pnpdepth_cli.pipeline.refinement.refine import load_refiner
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.sweep.axes import Cell, Study
from pnpdepth_cli.pipeline.sweep.plan import Plan, Run, sampling_of
from pnpdepth_cli.pipeline.sweep.plots import draw_study, need_matplotlib
from pnpdepth_cli.pipeline.sweep.points import OWN, Sampling, frame_points
from pnpdepth_cli.pipeline.sweep.running import Result, results
from pnpdepth_cli.pipeline.sweep.state import SweepState
from pnpdepth_cli.pipeline.sweep.summary import (
    FrameFigures,
    over_seeds,
    summarise,
    write_frames,
    write_sweep,
)
from pnpdepth_cli.sensors import SamplePattern

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
    plot_format: str = "png"
    """One of PLOT_FORMATS."""
    cost: bool = False
    """True to report the time of the refinement beside its error."""
    resamples: int = 2000
    """Bootstrap samples behind the intervals."""

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UsageError(f"seeds {self.seeds}: the points have to be drawn once at least")


@dataclass(frozen=True, kw_only=True)
class _Network:
    """A network of the sweep and its runs."""

    spec: str
    refiner: Refiner
    base: dict[str, Any]
    """The settings that are not varied."""
    plan: Plan
    runs: tuple[Run, ...]
    """Of all frames."""


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
    sampling, tasks = _frames(request, listener)
    make_folder(request.output)
    with locked_folder(request.output, None, lambda: _clean(request.output)):
        state = SweepState(request.output)
        for note in state.notes:
            listener.say(note)
        cells = [cell for study in request.studies for cell in study.cells()]
        models = dict.fromkeys(_model_of(cell, request) for cell in cells)
        networks = {model: _network(model, request, sampling, tasks, listener) for model in models}
        to_do = {
            model: [run for run in each.runs if not state.is_done(run)]
            for model, each in networks.items()
        }
        count = sum(len(each.runs) for each in networks.values())
        left = sum(map(len, to_do.values()))
        listener.say(
            f"{len(tasks):,} frames, {count:,} runs: {count - left:,} done already, {left:,} to do"
        )
        listener.begin(left)
        for model, each in networks.items():
            for run, result in results(to_do[model], each.refiner.network):
                listener.frame(_recorded(run, result, state))
        return _write(request, sampling, networks, [task.name for task, _ in tasks], state)


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
    if any(each.lidar for each in samplings):
        # the calibration is then of the camera, not of a scan
        frames = [
            replace(
                frame,
                calib=scan.calib or frame.calib,
                camera=frame.camera if scan.camera is None else scan.camera,
            )
            for frame in frames
        ]
        scan = replace(scan, calib=None, camera=None)
    own_wanted = any(each.sensor == OWN for each in samplings)
    reading_own = replace(batch, refine=request.refine.with_fields(scan=scan, sample=None))
    return sampling, [
        (task_of(reading_own if own_wanted and frame.sparse else batch, frame), frame)
        for frame in frames
    ]


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
    axes = [axis for study in request.studies for axis in study.axes if axis.name == "layer"]
    layer = axes[0].values[0] if axes else refine.method.layer
    refiner = _resolved(layer, refine, tasks, listener)
    definition = refiner.network.definition
    if layer is None:  # the default is what `refine` cuts the first frame at
        defaults = replace(definition.defaults, layer=refiner.layer)
        definition = replace(definition, defaults=defaults)
    base = _base(definition, refine)
    listener.say(
        f"network: {definition.name}; where not varied: cut at {base['layer']},"
        f" {base['iterations']} updates of z ({base['update']}, {base['loss']}, step {base['lr']})"
    )
    plan = Plan(cells, definition, refine, sampling, request.seeds, model_identity(refine))
    for each in plan.layers:
        with refiner.network.cut_at(each):
            pass  # reports an unknown layer before anything is computed
    runs = tuple(run for task, frame in tasks for run in plan.runs(task, frame))
    return _Network(spec=spec, refiner=refiner, base=base, plan=plan, runs=runs)


def _resolved(
    layer: str | None,
    refine: RefineRequest,
    tasks: Sequence[tuple[Task, Frame]],
    listener: Listener,
) -> Refiner:
    """The network, its definition resolved on the first frame that can be read.

    Args:
        layer: A layer to cut at, as a network may have no default.
        refine: How frames are refined.
        tasks: The frames.
        listener: Receives notes.
    """
    seed = refine.method.seed
    errors = []
    for number, (task, frame) in enumerate(tasks):
        try:
            inputs = _with_points_of_truth(task, frame, seed)
        except InputError as error:
            errors.append(error)
            continue

        def others(number: int = number) -> list[Inputs]:
            """Further frames, which decide the input range as well."""
            read = []
            for other in reference_frames(tasks, number):
                with contextlib.suppress(PnpDepthError):  # it is read again, which reports this
                    read.append(_with_points_of_truth(*other, seed))
            return read

        refiner = load_refiner(task.request.with_fields(layer=layer), inputs, others)
        for note in inputs.notes:
            if task.request.files.sample is None or not note.startswith("sparse"):
                listener.say(f"{task.name}: {note}")
        for note in refiner.network.notes:
            listener.say(note)
        return refiner
    raise errors[0]


def _with_points_of_truth(task: Task, frame: Frame, seed: int) -> Inputs:
    """The frame with points of its ground truth, so as not to depend on what is varied."""
    inputs = read_frame(task)
    known = 0 if inputs.gt is None else int((inputs.gt > 0).sum())
    some = Sampling(sensor="uniform", points=str(min(_RESOLVE_POINTS, known)))
    return replace(inputs, points=frame_points(some, seed, inputs, task.request, frame))


def _base(definition: ModelDefinition, request: RefineRequest) -> dict[str, Any]:
    """The settings that are not varied."""
    method = request.method.with_preset()
    settings = resolve_settings(definition, method)
    layer = method.layer or definition.default_layer
    return {
        "layer": None if layer is None else resolve_layer(definition, layer),
        **asdict(settings),
        "propagate": method.propagate or "none",
    }


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
    networks: Mapping[Model, _Network],
    names: Sequence[str],
    state: SweepState,
) -> dict[str, Any]:
    """Writes the tables and plots; returns the contents of sweep.json."""
    lines = {
        (model, run.id): state.result(run.key)
        for model, each in networks.items()
        for run in each.runs
    }
    studies: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    for study in request.studies:
        cells = []
        for cell in study.cells():
            model = _model_of(cell, request)
            setup = networks[model].plan.setup(cell)
            figures = [
                FrameFigures.of(
                    name,
                    seed,
                    setup.iterations,
                    linear=lines[model, (name, seed, setup.sampling, None)],
                    curve=lines[model, (name, seed, setup.sampling, setup.method)],
                )
                for name in names
                for seed in setup.seeds
            ]
            summary = summarise(figures, request.resamples, cost=request.cost)
            cells.append({"parameters": dict(cell), **summary})
            rows += [{"study": study.name, "parameters": cell, "figures": f} for f in figures]
        plot = f"sweep_{study.name}.{request.plot_format}" if request.plots else None
        if plot is not None:
            draw_study(study, cells, request.output / plot)
        studies.append(
            {
                "name": study.name,
                "parameters": {axis.name: list(axis.values) for axis in study.axes},
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
        "model": model_record(first.refiner.network, first.spec),
        **(
            {"more_models": [model_record(each.refiner.network, each.spec) for each in others]}
            if others
            else {}
        ),
        "frames": list(names),
        "seeds": request.seeds,
        "base": first.base | asdict(sampling),
        "studies": studies,
    }
    write_sweep(request.output, record)
    write_frames(request.output / "sweep_frames.csv", rows)
    return record
