"""`pnpdepth sweep`: errors against ground truth over one or two varied parameters."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.commands.batch.batch import Listener
from pnpdepth_cli.commands.batch.frames import Task, find_frames, task_of
from pnpdepth_cli.commands.batch.records import code_digests, model_identity, settings_of
from pnpdepth_cli.commands.batch.request import BatchRequest, FrameSelection
from pnpdepth_cli.commands.batch.running import read_frame, reference_frames
from pnpdepth_cli.commands.refinement.inputs import Inputs
from pnpdepth_cli.commands.refinement.refine import load_refiner, model_record
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.commands.sweep.axes import Cell, Study, values_of
from pnpdepth_cli.commands.sweep.outputs import (
    draw_study,
    need_matplotlib,
    row_of,
    summarise,
    write_sweep,
)
from pnpdepth_cli.commands.sweep.points import OWN, Sampling, frame_points
from pnpdepth_cli.commands.sweep.running import Journal, Run, results
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.io.atomic import make_folder, remove_leftovers
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.io.lock import locked_folder
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.sensors import SamplePattern
from pnpdepth_cli.settings import Settings

Model = tuple[str, "Path | None"]
"""A network and its weights, as the user names them."""
Frames = Sequence[tuple[Task, Frame]]

_RESOLVE_POINTS = 500
"""Points of the ground truth that the definition is resolved on; the paper uses 500 indoors."""


@dataclass(frozen=True, kw_only=True)
class SweepRequest(FrameSelection):
    """What to vary, over which frames."""

    studies: Sequence[Study]
    sampling: Sampling | None = None
    """Where points come from unless that is varied; None for the frames' own, or else the ground
    truth."""
    points: Cell = field(default_factory=dict)
    """Other parameters of the points that are not varied."""
    seeds: int = 1
    """Draws of the points, with consecutive seeds."""
    plots: str = "png"
    cost: bool = False
    resamples: int = 2000

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UsageError(f"--seeds must be >= 1, got {self.seeds}")

    @property
    def cells(self) -> list[Cell]:
        """The cells of all studies."""
        return [cell for study in self.studies for cell in study.cells()]


@dataclass(frozen=True, kw_only=True)
class _Network:
    """A network of the sweep, and how its cells are computed."""

    spec: str
    refiner: Refiner
    definition: ModelDefinition
    base: RefineRequest
    """How a frame is refined where nothing is varied."""
    sampling: Sampling
    """The points where nothing is varied."""
    seeds: int
    assumed: tuple[str, ...]
    """Kinds of depth files whose scale is assumed, in the frame that it was resolved on."""

    def settings(self, cell: Cell) -> Settings:
        """Returns how a cell refines. Raises UsageError if parameters contradict each other."""
        varied = values_of(cell, of_points=False)
        varied = {name: value for name, value in varied.items() if name not in ("model", "seed")}
        options = replace(self.base.method, **varied).with_preset()
        settings = resolve_settings(self.definition, options)
        return replace(settings, propagate=options.propagate or "none", preset=None)

    def draws(self, cell: Cell) -> tuple[Sampling, Sequence[int]]:
        """Returns where a cell's points come from, and the seeds of their draws."""
        sampling = self.sampling.with_values(values_of(cell, of_points=True))
        if "seed" in cell:
            return sampling, (int(cell["seed"]),)
        own = self.base.method.seed
        return sampling, range(own, own + (self.seeds if sampling.is_random else 1))

    def runs(self, cells: Sequence[Cell], frames: Frames) -> dict[Any, Run]:
        """Returns the runs of the cells by frame, seed, points and settings.

        A run is computed once, however many cells use it. Those of a frame follow each other, and
        among these those with the same points.
        """
        identity, states = model_identity(self.base), dict[Path, Any]()
        wanted: dict[tuple[Sampling, int], dict[Settings, None]] = {}
        for cell in cells:
            sampling, seeds = self.draws(cell)
            for seed in seeds:
                wanted.setdefault((sampling, seed), {})[self.settings(cell)] = None
        runs = {}
        for task, frame in frames:
            read = settings_of(task.request, identity, "files", "network") | {"frame": frame.name}
            del read["sample"]  # `sampling` says it
            for (sampling, seed), several in wanted.items():
                paths = dict(_files(task, frame, sampling))
                states |= {path: _state(path) for path in paths.values() if path not in states}
                files = {name: states[path] for name, path in paths.items()}
                drawn = {"seed": seed, "sampling": sampling.record(), "files": files}
                for settings in several:
                    decides = plain(read | drawn | {"settings": settings})
                    if code := code_digests(settings):
                        decides["code"] = code
                    text = json.dumps(decides, sort_keys=True)
                    runs[frame.name, seed, sampling, settings] = Run(
                        task=task, frame=frame, seed=seed, sampling=sampling, settings=settings,
                        key=hashlib.sha256(text.encode()).hexdigest(),
                    )  # fmt: skip
        return runs


def _files(task: Task, frame: Frame, sampling: Sampling) -> Iterator[tuple[str, Path]]:
    """The files that decide the result with these points."""
    own = sampling.sensor == OWN
    yield from ((n, path) for n, path in task.inputs.items() if own or n in ("image", "gt"))
    if sampling.lidar is not None and frame.calib is not None:
        yield "calib", frame.calib


def _state(path: Path) -> tuple[int, int] | None:
    """What changes with a file's content: size and time."""
    try:
        status = path.stat()
    except OSError:  # the run will say so
        return None
    return status.st_size, status.st_mtime_ns


def run_sweep(request: SweepRequest, listener: Listener) -> dict[str, Any]:
    """Writes tables and plots of the studies; returns the contents of sweep.json.

    Runs that are done with these settings and files are not computed again. Frames that fail are
    reported and counted.

    Raises:
        PnpDepthError: For what concerns all frames.
    """
    output = request.output
    if request.plots != "none":
        need_matplotlib()
    sampling, frames = _frames(request, listener)
    make_folder(output)
    with locked_folder(output, None, lambda: None):
        remove_leftovers(output)
        journal = Journal(output)
        cells: dict[Model, list[Cell]] = {}
        for cell in request.cells:
            cells.setdefault(_model_of(cell, request), []).append(cell)
        networks, runs = {}, {}
        for model, of_model in cells.items():
            network = networks[model] = _network(
                model, of_model, request, sampling, frames, listener
            )
            runs[model] = network.runs(of_model, frames)
            for layer in dict.fromkeys(run.settings.layer for run in runs[model].values()):
                if layer is not None:
                    with network.refiner.network.cut_at(layer):
                        pass  # reports an unknown layer before anything is computed
        to_do = {
            model: [run for run in of.values() if run.key not in journal.results]
            for model, of in runs.items()
        }
        count, left = (sum(map(len, of.values())) for of in (runs, to_do))
        listener.say(
            f"{len(frames):,} frames, {count:,} runs: {count - left:,} done already, {left:,} to do"
        )
        listener.begin(left)
        for model, network in networks.items():
            for run, result in results(to_do[model], network.refiner.network):
                row = {"name": run.frame.name, "status": "done", "message": None}
                if isinstance(result, PnpDepthError):  # it is tried again next time
                    row |= {"status": "failed", "message": str(result)}
                else:
                    journal.add(run, result)
                    if result["diverged"]:
                        row |= {"status": "diverged", "message": result["diverged"]}
                listener.frame(row)
        return _write(request, networks, runs, [task.name for task, _ in frames], journal)


def _frames(request: SweepRequest, listener: Listener) -> tuple[Sampling, Frames]:
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
    samplings = [sampling.with_values(values_of(cell, of_points=True)) for cell in request.cells]
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
    frames: Frames,
    listener: Listener,
) -> _Network:
    """The network, loaded, its definition resolved on the first frame that can be read.

    A layer to cut at is named, as the network may have no default.
    """
    named = {"model": model[0], "checkpoint": model[1]}
    base = request.refine.with_fields(**named)
    layer = next((cell["layer"] for cell in cells if "layer" in cell), base.method.layer)
    tasks = [(replace(t, request=t.request.with_fields(**named)), frame) for t, frame in frames]

    def read(task: Task, frame: Frame) -> Inputs:
        """The frame with points of its ground truth, so as not to depend on what is varied."""
        inputs = read_frame(task)
        known = 0 if inputs.gt is None else int((inputs.gt > 0).sum())
        some = Sampling(sensor="uniform", points=str(min(_RESOLVE_POINTS, known)))
        return replace(
            inputs, points=frame_points(some, base.method.seed, inputs, task.request, frame)
        )

    errors: list[InputError] = []
    for task, frame in tasks:
        try:
            inputs = read(task, frame)
            break
        except InputError as error:
            errors.append(error)
    else:
        raise errors[0]

    def others() -> list[Inputs]:
        """Further frames, which decide the input range as well; errors are reported later."""
        found = []
        for other in reference_frames(tasks, len(errors)):
            with contextlib.suppress(PnpDepthError):
                found.append(read(*other))
        return found

    refiner = load_refiner(task.request.with_fields(layer=layer), inputs, others)
    for note in inputs.notes:
        if task.request.files.sample is None or not note.startswith("sparse"):
            listener.say(f"{task.name}: {note}")
    for note in refiner.network.notes:
        listener.say(note)
    definition = refiner.network.definition
    if layer is None or definition.default_layer is None:  # where `refine` cuts the first frame
        defaults = replace(definition.defaults, layer=refiner.layer)
        definition = replace(definition, defaults=defaults)
    network = _Network(
        spec=model[0],
        refiner=refiner,
        definition=definition,
        base=base,
        sampling=sampling,
        seeds=request.seeds,
        assumed=inputs.assumed,
    )
    own = network.settings({})
    listener.say(
        f"network: {definition.name}; where not varied: cut at {own.layer},"
        f" {own.iterations} updates of z ({own.update}, {own.loss}, step {own.lr})"
    )
    return network


def _write(
    request: SweepRequest,
    networks: Mapping[Model, _Network],
    runs: Mapping[Model, Mapping[Any, Run]],
    names: Sequence[str],
    journal: Journal,
) -> dict[str, Any]:
    """Writes the tables and plots; returns the contents of sweep.json."""
    studies: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    for study in request.studies:
        cells = []
        for cell in study.cells():
            model = _model_of(cell, request)
            settings = networks[model].settings(cell)
            sampling, seeds = networks[model].draws(cell)
            of_cell = []
            for name in names:
                for seed in seeds:
                    run = runs[model][name, seed, sampling, settings]
                    scores = row_of(journal.results.get(run.key), timed=request.cost)
                    row = {"study": study.name, **cell, "frame": name, "seed": seed, **scores}
                    of_cell.append(row)
            cells.append({"parameters": dict(cell), **summarise(of_cell, request.resamples)})
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
        "model": model_record(first.refiner.network, first.spec),
        **({"more_models": [model_record(n.refiner.network, n.spec) for n in others]}
           if others else {}),
        "frames": list(names),
        "assumed": list(first.assumed),
        "seeds": request.seeds,
        "base": asdict(first.settings({})) | asdict(first.sampling),
        "studies": studies,
    }  # fmt: skip
    write_sweep(request.output, record, rows)
    return record
