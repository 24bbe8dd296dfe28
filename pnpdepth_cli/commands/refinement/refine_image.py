"""`pnpdepth refine`: one image, its sparse depth, and a network; refined depth and its record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.pipeline import peak_memory_mb, timed, versions
from pnpdepth_cli.commands.refinement.outputs import (
    plan_outputs,
    remove_outdated,
    within_range,
    without_unknown,
    write_outputs,
)
from pnpdepth_cli.commands.refinement.refine_request import Outputs, RefineRequest
from pnpdepth_cli.commands.tables import names_of_depths
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.dataset import frame_record
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.resolve import normalisation_name, with_input_range
from pnpdepth_cli.io.atomic import all_or_none, make_folder
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.io.visualisation import gain
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.spent import parts_of
from pnpdepth_cli.stages import AFTER, BEFORE, GT, HELD_OUT, LINEAR, USED, VALIDATION

Stages = dict[str, frame_record.Scores]


def refine_image(request: RefineRequest) -> frame_record.FrameRecord:
    """Refines one frame, writes its depth and companions, and returns its record.

    Args:
        request: Files, network and settings of the refinement.

    Raises:
        PnpDepthError: What was asked for is at fault; then nothing is written.
    """
    seconds = dict[str, float]()
    outputs = plan_outputs(request)
    with timed(seconds, "read"):
        inputs = read_requested(request)
    with timed(seconds, "load network"), parts_of(seconds, "load network"):
        method = load_method(request, inputs)
    with timed(seconds, "refine"), method:
        frame = method.refine(inputs, with_stages=inputs.gt is not None)
    return write_refined(request, outputs, method, inputs, frame, seconds)


def read_requested(request: RefineRequest) -> Frame:
    """Returns the frame that is asked for, as `read_frame` reads it."""
    return read_frame(
        request.files,
        request.read_options,
        seed=request.method.seed,
        holdout=request.holdout,
        needs_camera=request.view_3d,
    )


def load_method(
    request: RefineRequest, first: Frame, more: Callable[[], Sequence[Frame]] = tuple
) -> Method:
    """Returns the method that is asked for; this first frame decides what networks leave open.

    Args:
        request: Networks and settings of the refinement.
        first: The first frame.
        more: Function of further frames, which decide as well; called only if a network needs it.

    Raises:
        UsageError: The request combines what cannot be combined.
        ModelError: The network cannot be loaded.
    """
    own = load_network(request.model, request.checkpoint, request.device)
    others = [load_network(model, None, request.device) for model in request.more_models]
    return Method(
        [with_input_range(own, request.normalise), *others],
        request.method,
        first,
        more,
        validated=request.baselines,
        uncertainty=request.uncertainty or request.unknown == "zero",
        keep_measured=request.keep_measured,
    )


def write_refined(
    request: RefineRequest,
    outputs: Outputs,
    method: Method,
    inputs: Frame,
    frame: Refined,
    seconds: dict[str, float],
    *,
    batch: frame_record.BatchState | None = None,
    folder: Path | None = None,
) -> frame_record.FrameRecord:
    """Scores the refined frame and writes it in place of an earlier result, its record last.

    The record is the same from run to run, except `seconds` and `peak_memory_mb`.

    Args:
        request: How the frame was refined.
        outputs: The files to write, by kind.
        method: The method that refined it.
        inputs: The frame as it was read.
        frame: The refined frame.
        seconds: Seconds by what they were spent on; gets those of writing.
        batch: What the record keeps for the batch that the frame is of.
        folder: Output folder of that batch, which the record's paths start from.
    """
    frame = within_range(outputs, inputs, without_unknown(request, inputs, frame))
    record = record_of(request, method, inputs, frame)
    record = scored(record, inputs, frame, with_baselines=request.baselines)
    make_folder(outputs["depth"].parent, below=folder)
    remove_outdated(outputs)
    with all_or_none(outputs.values()):
        with timed(seconds, "write"):
            figures = write_outputs(outputs, inputs, frame, names_of_depths(record))
        record = replace(
            record,
            batch=batch,
            figures=figures,
            outputs={
                kind: path.relative_to(folder).as_posix() if folder else str(path)
                for kind, path in outputs.items()
                if kind != "improvement" or kind in figures
            },
            seconds=seconds,
            peak_memory_mb=peak_memory_mb(method.own.network.device),
        )
        if "record" in outputs:
            record.write(outputs["record"])
    return record


def record_of(
    request: RefineRequest, method: Method, frame: Frame, refined: Refined
) -> frame_record.FrameRecord:
    """Returns the record of a refined frame, without its errors, outputs and times."""
    # What the frame is called, and what the networks say.
    network, files = method.own.network, request.files
    spec = request.model
    if network.definition.input_kind == "map":
        spec = str(files.depths[0]) if files.depths else "array"
    weights = network.checkpoint
    first = files.image_file or files.sparse
    of_networks = [note for member in method.members for note in member.network.notes]
    held_out = _held_out(frame)
    own_used = len(frame.own) - len(held_out)
    # Status, files, method, settings and points, in the order of the record.
    return frame_record.FrameRecord(
        name=files.name or (first.stem if first else ""),
        group=files.group,
        status="diverged" if refined.diverged else "done",
        message=str(refined.diverged) if refined.diverged else None,
        versions=versions(),
        unit=frame.unit,
        inputs=dict(frame.sources),
        neighbours=list(frame.neighbours),
        camera=frame_record.CameraRecord.of(frame.camera, frame.pose) if frame.camera else None,
        model=frame_record.ModelRecord(
            name=network.definition.name,
            spec=spec,
            checkpoint=str(weights) if weights else None,
            checkpoint_sha256=fingerprint(weights).sha256 if weights else None,
        ),
        method=frame_record.MethodRecord(
            name=method.asked.method,
            propagation=refined.propagation,
            networks=[_network_record(member) for member in method.members],
        ),
        settings={
            "method": method.asked.method,
            "layer": method.own.layer,
            **asdict(method.own.settings),
            "seed": method.asked.seed,
            "step": refined.step,
            "propagate": refined.propagation,
            "output_kind": network.definition.output_kind,
            "normalise": normalisation_name(network.definition),
            "holdout": request.holdout,
            "device": str(network.device),
        },
        registration=asdict(refined.registration) if refined.registration else None,
        alignment=asdict(refined.alignment) if refined.alignment else None,
        size=(frame.size[1], frame.size[0]),
        points=frame_record.PointsRecord(
            used=len(refined.used),
            held_out=len(held_out),
            nearest=float(frame.own.depth.min()),
            farthest=float(frame.own.depth.max()),
            moved=len(refined.used) - own_used if frame.neighbours else None,
        ),
        weights=dict(refined.weights),
        loss=list(refined.losses),
        notes=[note for note in (*frame.notes, *of_networks, *refined.notes) if note],
    )


def scored(
    record: frame_record.FrameRecord,
    frame: Frame,
    refined: Refined,
    *,
    with_baselines: bool = False,
) -> frame_record.FrameRecord:
    """Returns the record with the errors of the refined depth, by what the frame knows."""
    return replace(
        record,
        errors=_errors_of(refined, frame, with_baselines=with_baselines),
        improved_fraction=_improved_fraction(refined, frame),
    )


def _network_record(member: OpenNetwork) -> frame_record.NetworkRecord:
    """The settings of one network."""
    settings = asdict(member.settings)
    del settings["propagate"]  # the residual of the result is propagated, not of a network
    return frame_record.NetworkRecord(name=member.name, layer=member.layer, **settings)


def _held_out(frame: Frame) -> SparsePoints:
    """The points of the frame that nothing uses."""
    return frame.points.select(slice(0)) if frame.held_out is None else frame.held_out


def _errors_of(refined: Refined, frame: Frame, *, with_baselines: bool) -> dict[str, Stages]:
    """The errors of each stage and of linear interpolation, by each basis that the frame has."""

    def baselines(points: SparsePoints, before: Tensor) -> Iterator[tuple[str, Tensor]]:
        """The prediction of each baseline but the linear one that does not fail on the frame."""
        for name in BASELINES if with_baselines else ():
            with suppress(ModelError):  # such as a line through points that are all equally far
                if name != LINEAR:
                    yield name, BASELINES[name](points, before)

    errors, validation = dict[str, Stages](), refined.validation
    held_out = _held_out(frame)
    before, after = torch.from_numpy(refined.before), torch.from_numpy(refined.depth)
    maps, beside = {BEFORE: before, AFTER: after}, dict[str, Tensor]()
    if frame.gt is not None or len(held_out):
        beside[LINEAR] = linear(frame.points)
    # Against the truth, all others are scored on the pixels where the result is known.
    if frame.gt is not None:
        gt = torch.from_numpy(frame.gt)
        known = torch.where(after > 0, gt, 0)
        stages = {name: torch.from_numpy(depth) for name, depth in refined.stages.items()}
        scored = maps | stages | beside | dict(baselines(frame.points, before))
        errors[GT] = {
            name: score(depth, gt if name == AFTER else known).to_json()
            for name, depth in scored.items()
        }
    errors[HELD_OUT] = _at_points(held_out, maps | beside)
    # At validation points, each is predicted without them.
    if validation is not None:
        others = baselines(validation.kept, validation.network)
        predicted = {name: validation.points.sample(depth) for name, depth in others}
        errors[VALIDATION] = {
            name: {"mae": validation.error(at), "points": len(validation.points)}
            for name, at in (dict(validation.predicted) | predicted).items()
        }
    errors[USED] = _at_points(refined.used, maps)
    return {basis: stages for basis, stages in errors.items() if stages}


def _at_points(points: SparsePoints, maps: dict[str, Tensor]) -> Stages:
    """The errors of depth maps (H, W) at points of the same image, where both are known."""
    stages: Stages = {}
    for name, depth in maps.items():
        error = (points.sample(depth) - points.depth)[points.known_in(depth)].double()
        if len(error):
            mae, rmse = float(error.abs().mean()), float(error.square().mean().sqrt())
            stages[name] = {"mae": mae, "rmse": rmse, "points": len(error)}
    return stages if AFTER in stages and BEFORE in stages else {}


def _improved_fraction(refined: Refined, frame: Frame) -> float | None:
    """The fraction of the pixels with ground truth, else of held-out points, whose error fell."""
    before, after, gt = refined.before, refined.depth, frame.gt
    if gt is None:
        maps = torch.from_numpy(before), torch.from_numpy(after)
        held_out = _held_out(frame)
        points = held_out.select(held_out.known_in(maps[1]))
        before, after = (points.sample(depth).numpy() for depth in maps)
        gt = points.depth.numpy()
    gains = gain(before, after, gt)
    known = gains[np.isfinite(gains)]
    return float((known > 0).mean()) if known.size else None
