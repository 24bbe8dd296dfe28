"""`pnpdepth sweep`: errors against ground truth over one or two varied parameters."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from pnpdepth_cli.commands.batch.batch import Listener
from pnpdepth_cli.commands.batch.frames import Task, find_frames, reference_frames, task_of
from pnpdepth_cli.commands.batch.reading import read_frame
from pnpdepth_cli.commands.batch.request import BatchRequest, FrameSelection
from pnpdepth_cli.commands.refinement.inputs import Inputs
from pnpdepth_cli.commands.refinement.record import model_record
from pnpdepth_cli.commands.refinement.refine import load_refiner
from pnpdepth_cli.commands.sweep.axes import Cell, Study, values_of
from pnpdepth_cli.commands.sweep.journal import Journal
from pnpdepth_cli.commands.sweep.plan import Plan, Runs
from pnpdepth_cli.commands.sweep.plots import draw_study, need_matplotlib
from pnpdepth_cli.commands.sweep.points import OWN, Sampling, frame_points
from pnpdepth_cli.commands.sweep.running import results
from pnpdepth_cli.commands.sweep.tables import row_of, summarise, write_sweep
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.io.atomic import make_folder, remove_leftovers
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.io.lock import locked_folder
from pnpdepth_cli.io.remote import RemotePath
from pnpdepth_cli.sensors import SamplePattern

Model = tuple[str, "Path | None"]
"""A network and its weights, as the user names them."""

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
    points: Cell = field(default_factory=dict)
    """Other parameters of the points that are not varied."""
    seeds: int = 1
    """Draws of the points, with consecutive seeds."""
    plots: str = "png"
    """One of PLOT_FORMATS, or "none"."""
    cost: bool = False
    """True to report the time of the refinement beside its error."""
    resamples: int = 2000
    """Bootstrap samples behind the intervals."""

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UsageError(f"--seeds must be >= 1, got {self.seeds}")


@dataclass(frozen=True, kw_only=True)
class _Network:
    """A network of the sweep and its runs."""

    spec: str
    """What the user called it."""
    refiner: Refiner
    plan: Plan
    base: dict[str, Any]
    """The settings that are not varied."""
    runs: Runs


def run_sweep(request: SweepRequest, listener: Listener) -> dict[str, Any]:
    """Writes tables and plots of the studies; returns the contents of sweep.json.

    Runs that are done with these settings and files are not computed again. Frames that fail are
    reported and counted.

    Raises:
        PnpDepthError: For what concerns all frames.
    """
    output = request.output
    if isinstance(output, RemotePath):
        raise UsageError(f"{output}: sweep writes to a local folder; name one with -o")
    if request.plots != "none":
        need_matplotlib()
    sampling, tasks = _frames(request, listener)
    make_folder(output)
    with locked_folder(output, None, lambda: None):
        remove_leftovers(output)
        journal = Journal(output)
        for note in journal.notes:
            listener.say(note)
        cells: dict[Model, list[Cell]] = {}
        for study in request.studies:
            for cell in study.cells():
                cells.setdefault(_model_of(cell, request), []).append(cell)
        networks = {
            model: _network(model, of, request, sampling, tasks, listener)
            for model, of in cells.items()
        }
        to_do = {
            model: [run for run in each.runs.values() if not journal.is_done(run)]
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
                row = {"name": run.frame.name, "status": "done", "message": None}
                if isinstance(result, PnpDepthError):  # it is tried again next time
                    row |= {"status": "failed", "message": str(result)}
                else:
                    journal.add(run, result)
                    if result.get("diverged"):
                        row |= {"status": "diverged", "message": result["diverged"]}
                listener.frame(row)
        return _write(request, sampling, networks, [task.name for task, _ in tasks], journal)


def _frames(request: SweepRequest, listener: Listener) -> tuple[Sampling, list[tuple[Task, Frame]]]:
    """Where points come from unless that is varied, and the frames with ground truth."""
    batch = BatchRequest(
        source=request.source,
        output=request.output,
        refine=request.refine.with_fields(sample=SamplePattern(count=1)),
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
        origin = "the frames' own" if own else "uniform of the ground truth"
        listener.say(f"points: {origin}; --sample to change")
    if request.points:
        sampling = sampling.with_values(values_of(request.points, of_points=True))
    cells = [cell for study in request.studies for cell in study.cells()]
    samplings = [sampling.with_values(values_of(cell, of_points=True)) for cell in cells]
    scan = request.refine.files.scan
    if any(each.lidar for each in samplings):
        # the calibration is then of the camera, not of a scan
        given: dict[str, Any] = {"calib": scan.calib, "camera": scan.camera}
        given = {name: value for name, value in given.items() if value is not None}
        frames = [replace(frame, **given) for frame in frames]
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
    cells: Sequence[Cell],
    request: SweepRequest,
    sampling: Sampling,
    tasks: Sequence[tuple[Task, Frame]],
    listener: Listener,
) -> _Network:
    """The network, loaded, and the runs of its cells."""
    named = {"model": model[0], "checkpoint": model[1]}
    refine = request.refine.with_fields(**named)
    tasks = [
        (replace(task, request=task.request.with_fields(**named)), frame) for task, frame in tasks
    ]
    layer = next((cell["layer"] for cell in cells if "layer" in cell), refine.method.layer)
    refiner = _resolved(layer, refine.method.seed, tasks, listener)
    definition = refiner.network.definition
    if layer is None or definition.default_layer is None:  # where `refine` cuts the first frame
        defaults = replace(definition.defaults, layer=refiner.layer)
        definition = replace(definition, defaults=defaults)
    plan = Plan(definition=definition, base=refine, sampling=sampling, seeds=request.seeds)
    settings, method = resolve_settings(definition, refine.method.with_preset()), plan.method({})[0]
    base = asdict(settings) | {"layer": method.layer, "propagate": method.propagate}
    listener.say(
        f"network: {definition.name}; where not varied: cut at {base['layer']},"
        f" {base['iterations']} updates of z ({base['update']}, {base['loss']}, step {base['lr']})"
    )
    runs = plan.runs(cells, tasks)
    for each in dict.fromkeys(run.method.layer for run in runs.values() if run.method):
        with refiner.network.cut_at(each):
            pass  # reports an unknown layer before anything is computed
    return _Network(spec=model[0], refiner=refiner, plan=plan, base=base, runs=runs)


def _resolved(
    layer: str | None, seed: int, tasks: Sequence[tuple[Task, Frame]], listener: Listener
) -> Refiner:
    """The network, its definition resolved on the first frame that can be read.

    A layer to cut at is named, as the network may have no default.
    """

    def read(task: Task, frame: Frame) -> Inputs:
        """The frame with points of its ground truth, so as not to depend on what is varied."""
        inputs = read_frame(task)
        known = 0 if inputs.gt is None else int((inputs.gt > 0).sum())
        some = Sampling(sensor="uniform", points=str(min(_RESOLVE_POINTS, known)))
        return replace(inputs, points=frame_points(some, seed, inputs, task.request, frame))

    def others(number: int) -> Iterator[Inputs]:
        """Further frames, which decide the input range as well; errors are reported later."""
        for other in reference_frames(tasks, number):
            with contextlib.suppress(PnpDepthError):
                yield read(*other)

    errors = []
    for number, (task, frame) in enumerate(tasks):
        try:
            inputs = read(task, frame)
        except InputError as error:
            errors.append(error)
            continue
        further = partial(lambda first: list(others(first)), number)
        refiner = load_refiner(task.request.with_fields(layer=layer), inputs, further)
        for note in inputs.notes:
            if task.request.files.sample is None or not note.startswith("sparse"):
                listener.say(f"{task.name}: {note}")
        for note in refiner.network.notes:
            listener.say(note)
        return refiner
    raise errors[0]


def _write(
    request: SweepRequest,
    sampling: Sampling,
    networks: Mapping[Model, _Network],
    names: Sequence[str],
    journal: Journal,
) -> dict[str, Any]:
    """Writes the tables and plots; returns the contents of sweep.json."""
    studies: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    for study in request.studies:
        cells = []
        for cell in study.cells():
            network = networks[_model_of(cell, request)]
            of_cell = _rows(study, cell, network, names, journal)
            summary = summarise(of_cell, request.resamples)
            for each in (summary, *of_cell):
                if not request.cost:
                    each.pop("time_s", None)
            cells.append({"parameters": dict(cell), **summary})
            rows += of_cell
        plot = None if request.plots == "none" else f"sweep_{study.name}.{request.plots}"
        if plot is not None:
            draw_study(study, cells, request.output / plot)
        values = {axis.name: list(axis.values) for axis in study.axes}
        studies.append({"name": study.name, "parameters": values, "plot": plot, "cells": cells})
    first, *others = networks.values()
    record = {
        "command": "sweep",
        "source": str(request.source),
        "output": str(request.output),
        "model": _record_of(first),
        **({"more_models": [_record_of(each) for each in others]} if others else {}),
        "frames": list(names),
        "seeds": request.seeds,
        "base": first.base | asdict(sampling),
        "studies": studies,
    }
    write_sweep(request.output, record, rows)
    return record


def _record_of(network: _Network) -> dict[str, Any]:
    return model_record(network.refiner.network, network.spec)


def _rows(
    study: Study, cell: Cell, network: _Network, names: Sequence[str], journal: Journal
) -> list[dict[str, Any]]:
    """A row for each frame of a cell and each draw of its points."""
    sampling, seeds = network.plan.draws(cell)
    (method, iterations), rows = network.plan.method(cell), []
    for name in names:
        for seed in seeds:
            linear, refined = (
                journal.result(network.runs[name, seed, sampling, each]) for each in (None, method)
            )
            scores = row_of(iterations, linear, refined)
            rows.append({"study": study.name, **cell, "frame": name, "seed": seed, **scores})
    return rows
