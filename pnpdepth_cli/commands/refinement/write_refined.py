"""Scores a refined frame, and writes its depth with its companions and record."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.refinement.outputs import (
    remove_outdated,
    within_range,
    without_unknown,
    write_outputs,
)
from pnpdepth_cli.commands.requests.refine_request import Outputs, RefineRequest
from pnpdepth_cli.commands.shared.pipeline import peak_memory_mb, timed, versions
from pnpdepth_cli.commands.shared.tables import names_of_depths
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.frame_record import (
    BatchState,
    CameraRecord,
    FrameRecord,
    MethodRecord,
    ModelRecord,
    NetworkRecord,
    PointsRecord,
    ResultRecord,
    Scores,
)
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.resolve import normalisation_name
from pnpdepth_cli.io.atomic import all_or_none, make_folder
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.io.visualisation import gain
from pnpdepth_cli.measures import AFTER, BEFORE, GT, HELD_OUT, LINEAR, USED, VALIDATION, score
from pnpdepth_cli.points import SparsePoints

Stages = dict[str, Scores]


def write_refined(
    request: RefineRequest,
    outputs: Outputs,
    method: Method,
    inputs: ReadFrame,
    frame: Refined,
    seconds: dict[str, float],
    *,
    batch: BatchState | None = None,
    folder: Path | None = None,
) -> FrameRecord:
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
    frame = without_unknown(request, inputs, frame)
    frame = within_range(outputs, inputs, frame)
    record = _frame_of(request, method, inputs, frame)
    result = _result_of(request, method, inputs, frame)
    make_folder(outputs["depth"].parent, below=folder)
    remove_outdated(outputs)
    with all_or_none(outputs.values()):
        # The depth and its companions.
        with timed(seconds, "write"):
            figures = write_outputs(outputs, inputs, frame, names_of_depths(result))
        # The record, which says which of them there are.
        result = replace(
            result,
            outputs={
                kind: path.relative_to(folder).as_posix() if folder else str(path)
                for kind, path in outputs.items()
                if kind != "improvement" or kind in figures
            },
            figures=figures,
            seconds=seconds,
            peak_memory_mb=peak_memory_mb(method.own.network.device),
        )
        record = replace(record, batch=batch, result=result)
        if "record" in outputs:
            record.write(outputs["record"])
    return record


def _frame_of(
    request: RefineRequest, method: Method, frame: ReadFrame, refined: Refined
) -> FrameRecord:
    """The record of a refined frame, without its result."""
    files = request.files
    first = files.image_file or files.sparse
    of_networks = [note for member in method.members for note in member.network.notes]
    return FrameRecord(
        name=files.name or (first.stem if first else ""),
        group=files.group,
        status="diverged" if refined.diverged else "done",
        message=str(refined.diverged) if refined.diverged else None,
        inputs=dict(frame.sources),
        unit=frame.unit,
        errors=_errors_of(refined, frame, with_baselines=request.baselines),
        notes=[note for note in (*frame.notes, *of_networks, *refined.notes) if note],
    )


def _result_of(
    request: RefineRequest, method: Method, frame: ReadFrame, refined: Refined
) -> ResultRecord:
    """The record of a result, without its outputs and times."""
    network = method.own.network
    weights = network.checkpoint
    held_out = frame.held_out
    is_map = network.definition.input_kind == "map"
    # The points that were used, of which some are of neighbouring frames.
    own_used = len(frame.own) - len(held_out)
    points = PointsRecord(
        used=len(refined.used),
        held_out=len(held_out),
        nearest=float(frame.own.depth.min()),
        farthest=float(frame.own.depth.max()),
        moved=len(refined.used) - own_used if frame.neighbours else None,
    )
    # The settings of the user's network, with nothing left open.
    settings = {
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
    }
    return ResultRecord(
        size=(frame.size[1], frame.size[0]),
        points=points,
        neighbours=list(frame.neighbours),
        camera=CameraRecord.of(frame.camera, frame.pose) if frame.camera else None,
        model=ModelRecord(
            name=network.definition.name,
            spec=str(request.files.depths[0]) if is_map else request.model,
            checkpoint=str(weights) if weights else None,
            checkpoint_sha256=fingerprint(weights).sha256 if weights else None,
        ),
        method=MethodRecord(
            name=method.asked.method,
            propagation=refined.propagation,
            networks=[_network_record(member) for member in method.members],
        ),
        settings=settings,
        weights=dict(refined.weights),
        registration=asdict(refined.registration) if refined.registration else None,
        alignment=asdict(refined.alignment) if refined.alignment else None,
        loss=list(refined.losses),
        improved_fraction=_improved_fraction(refined, frame),
        versions=versions(),
    )


def _network_record(member: OpenNetwork) -> NetworkRecord:
    """The settings of one network."""
    settings = asdict(member.settings)
    del settings["propagate"]  # the residual of the result is propagated, not of a network
    return NetworkRecord(name=member.name, layer=member.layer, **settings)


def _errors_of(refined: Refined, frame: ReadFrame, *, with_baselines: bool) -> dict[str, Stages]:
    """The errors of each stage and of linear interpolation, by each basis that the frame has."""

    def baselines(points: SparsePoints, before: Tensor) -> Iterator[tuple[str, Tensor]]:
        """The prediction of each baseline but the linear one that does not fail on the frame."""
        for name in BASELINES if with_baselines else ():
            with suppress(ModelError):  # such as a line through points that are all equally far
                if name != LINEAR:
                    yield name, BASELINES[name](points, before)

    errors = dict[str, Stages]()
    validation = refined.validation
    held_out = frame.held_out
    before = torch.from_numpy(refined.before)
    after = torch.from_numpy(refined.depth)
    maps = {BEFORE: before, AFTER: after}
    beside = dict[str, Tensor]()
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
            stages[name] = {
                "mae": float(error.abs().mean()),
                "rmse": float(error.square().mean().sqrt()),
                "points": len(error),
            }
    return stages if AFTER in stages and BEFORE in stages else {}


def _improved_fraction(refined: Refined, frame: ReadFrame) -> float | None:
    """The fraction of the pixels with ground truth, else of held-out points, whose error fell."""
    before, after, gt = refined.before, refined.depth, frame.gt
    if gt is None:
        maps = torch.from_numpy(before), torch.from_numpy(after)
        held_out = frame.held_out
        points = held_out.select(held_out.known_in(maps[1]))
        before, after = (points.sample(depth).numpy() for depth in maps)
        gt = points.depth.numpy()
    gains = gain(before, after, gt)
    known = gains[np.isfinite(gains)]
    return float((known > 0).mean()) if known.size else None
