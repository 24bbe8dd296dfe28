"""The networks of a sweep, loaded, and what is computed with each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.pipeline.batch.batch import Listener
from pnpdepth_cli.pipeline.batch.frames import Task, reference_frames
from pnpdepth_cli.pipeline.batch.settings import model_identity
from pnpdepth_cli.pipeline.refinement.method import with_preset
from pnpdepth_cli.pipeline.refinement.refiner import Refiner
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.pipeline.sweep.axes import Cell
from pnpdepth_cli.pipeline.sweep.computing import FirstFrame
from pnpdepth_cli.pipeline.sweep.plan import Plan, Run
from pnpdepth_cli.pipeline.sweep.points import Sampling
from pnpdepth_cli.pipeline.sweep.request import SweepRequest

Model = tuple[str, "Path | None"]
"""A network and its weights, as the user names them."""


@dataclass(frozen=True, kw_only=True)
class SweptNetwork:
    """A network of the sweep and its runs."""

    refiner: Refiner
    """The network, loaded."""
    first: FirstFrame
    """The frame that its definition was resolved on."""
    base: dict[str, Any]
    """The settings that are not varied."""
    plan: Plan
    """What its cells need."""
    runs: tuple[Run, ...]
    """Of all frames."""


def models_of(request: SweepRequest) -> list[Model]:
    """Returns the networks of the cells, each once; one in most sweeps."""
    cells = [cell for study in request.studies for cell in study.cells()]
    return list(dict.fromkeys(model_of(cell, request) for cell in cells))


def model_of(cell: Cell, request: SweepRequest) -> Model:
    """Returns the network of a cell, varied as `NETWORK` or `NETWORK@WEIGHTS`, and its weights."""
    network = request.refine.network
    if "model" not in cell:
        return network.model, network.checkpoint
    spec, at, weights = cell["model"].partition("@")
    if not at and network.checkpoint is not None:
        raise UsageError("--checkpoint is of one network; vary model=NETWORK@WEIGHTS instead")
    return spec, Path(weights) if at else None


def swept_network(
    model: Model,
    request: SweepRequest,
    sampling: Sampling,
    tasks: Sequence[tuple[Task, Frame]],
    listener: Listener,
) -> SweptNetwork:
    """Returns the network, loaded, and the runs of its cells."""
    spec, checkpoint = model
    cells = [
        cell
        for study in request.studies
        for cell in study.cells()
        if model_of(cell, request) == model
    ]
    refine = request.refine.with_fields(model=spec, checkpoint=checkpoint)
    tasks = [
        (replace(task, request=task.request.with_fields(model=spec, checkpoint=checkpoint)), frame)
        for task, frame in tasks
    ]
    first, refiner = _resolved(replace(request, refine=refine), tasks, listener)
    definition = _with_layer(refiner, request)
    plan = Plan(cells, definition, refine, sampling, request.seeds, model_identity(refine))
    for layer in plan.layers:
        with refiner.network.cut_at(layer):
            pass  # reports an unknown layer before anything is computed
    return SweptNetwork(
        refiner=refiner,
        first=first,
        base=_base(definition, refine),
        plan=plan,
        runs=tuple(run for task, frame in tasks for run in plan.runs(task, frame)),
    )


def _resolved(
    request: SweepRequest, tasks: Sequence[tuple[Task, Frame]], listener: Listener
) -> tuple[FirstFrame, Refiner]:
    """The network, its definition resolved on the first frame that can be read, and that frame.

    Where workers compute, it is loaded here on the CPU, to plan.
    """
    errors = []
    for number, (task, frame) in enumerate(tasks):
        first = FirstFrame(
            task=task,
            frame=frame,
            seed=request.refine.hold_out.seed,
            layer=_some_layer(request),
            others=tuple(reference_frames(tasks, number)),
        )
        try:
            inputs = first.read()
        except InputError as error:
            errors.append(error)
            continue
        refiner = first.load(inputs, device=None if request.cluster.ray is None else "cpu")
        for note in inputs.notes:
            if task.request.files.sample is None or not note.startswith("sparse"):
                listener.say(f"{task.name}: {note}")
        for note in refiner.network.notes:
            listener.say(note)
        base = _base(_with_layer(refiner, request), request.refine)
        listener.say(
            f"network: {refiner.network.definition.name}; where not varied: cut at {base['layer']},"
            f" {base['iterations']} updates of z ({base['update']}, {base['loss']}, step"
            f" {base['lr']})"
        )
        return first, refiner
    raise errors[0]


def _some_layer(request: SweepRequest) -> str | None:
    """A layer of the study or of the request, as a network may have no default."""
    axes = [axis for study in request.studies for axis in study.axes if axis.name == "layer"]
    return axes[0].values[0] if axes else request.refine.method.layer


def _with_layer(refiner: Refiner, request: SweepRequest) -> ModelDefinition:
    """The definition; its default layer is the one that `refine` cuts the first frame at."""
    definition = refiner.network.definition
    if _some_layer(request) is not None:
        return definition
    return replace(definition, defaults=replace(definition.defaults, layer=refiner.layer))


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
