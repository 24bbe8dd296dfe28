"""The record of a refined frame, with its errors."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.commands.stopwatch import versions
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.dataset.frame_record import (
    CameraRecord,
    FrameRecord,
    MethodRecord,
    ModelRecord,
    PointsRecord,
    Scores,
)
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.frames.frame import DepthMap, Frame
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.refined import Refined
from pnpdepth_cli.frames.resolve import normalisation_name
from pnpdepth_cli.io.file_bytes import sha256_of
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.stages import AFTER, BEFORE, GT, HELD_OUT, LINEAR, USED, VALIDATION

Stages = dict[str, Scores]


def record_of(
    request: RefineRequest, method: Method, frame: Frame, refined: Refined
) -> FrameRecord:
    """Returns the record of a refined frame, without its outputs and times."""
    # What the frame is called, and what the networks say.
    network, files = method.network, request.files
    first = files.image_file or files.sparse
    of_networks = [note for member in method.members for note in member.network.notes]
    own_used = len(frame.own) - len(refined.held_out)
    # Status, files, method, settings, points and errors, in the order of the record.
    return FrameRecord(
        name=files.name or (first.stem if first else ""),
        group=files.group,
        status="diverged" if refined.diverged else "done",
        message=str(refined.diverged) if refined.diverged else None,
        versions=versions(),
        unit=frame.unit,
        inputs=dict(frame.sources),
        neighbours=list(frame.neighbours),
        camera=CameraRecord.of(frame.camera, frame.pose) if frame.camera else None,
        model=model_record(network, request.network.model),
        method=MethodRecord(
            kind="default" if method.is_default else "fixed",
            reason=method.asked.fixed_by or "default",
            networks=[member.network.definition.name for member in method.members],
        ),
        settings={
            "method": method.asked.method,
            "layer": method.own.layer,
            **asdict(method.settings),
            "seed": method.asked.seed,
            "step": refined.refinement.step,
            "propagate": "gp" if method.is_default else method.settings.propagate,
            "output_kind": network.definition.output_kind,
            "normalise": normalisation_name(network.definition),
            "holdout": request.hold_out.holdout,
            "precision": network.precision,
            "device": str(network.device),
        },
        registration=asdict(refined.registration) if refined.registration else None,
        alignment=asdict(refined.alignment) if refined.alignment else None,
        size=(frame.size[1], frame.size[0]),
        points=PointsRecord(
            used=len(refined.used),
            held_out=len(refined.held_out),
            nearest=float(frame.own.depth.min()),
            farthest=float(frame.own.depth.max()),
            moved=len(refined.used) - own_used if frame.neighbours else None,
        ),
        weights=dict(refined.weights),
        loss=list(refined.losses),
        errors=errors_of(refined, frame, with_baselines=request.hold_out.baselines),
        notes=[note for note in (*frame.notes, *of_networks, *refined.notes) if note],
    )


def model_record(network: Network, spec: str) -> ModelRecord:
    """Returns what a record keeps of a network; `spec` is what the user called it."""
    checkpoint = network.checkpoint
    return ModelRecord(
        name=network.definition.name,
        spec=spec,
        checkpoint=str(checkpoint) if checkpoint else None,
        checkpoint_sha256=_digest(checkpoint, checkpoint.stat().st_mtime_ns)
        if checkpoint
        else None,
    )


@functools.lru_cache(maxsize=8)
def _digest(checkpoint: Path, mtime_ns: int) -> str:
    """The SHA-256 of a checkpoint, computed once for all frames."""
    return sha256_of(checkpoint)


def errors_of(refined: Refined, frame: Frame, *, with_baselines: bool = False) -> dict[str, Stages]:
    """Returns the errors of each stage, and of linear interpolation of all points, by basis.

    A basis is left out where the frame has no such pixels or points.

    Args:
        refined: The refined frame.
        frame: The frame with its ground truth and its points, also those held out.
        with_baselines: Whether the other baselines of the points are stages as well.
    """
    is_compared = with_baselines and frame.gt is not None
    baselines = dict(_baselines(refined, frame.points)) if is_compared else {}
    maps = {BEFORE: refined.before, AFTER: refined.after}
    beside: dict[str, DepthMap] = {}
    if frame.gt is not None or len(refined.held_out):
        beside[LINEAR] = linear(frame.points).numpy()
    errors = {
        GT: _against_truth(frame.gt, refined, maps, beside | baselines),
        HELD_OUT: _at_points(refined.held_out, maps | beside),
        VALIDATION: _at_validation_points(refined, with_baselines=with_baselines),
        USED: _at_points(refined.used, maps),
    }
    return {basis: stages for basis, stages in errors.items() if stages}


def _against_truth(
    gt: DepthMap | None,
    refined: Refined,
    maps: dict[str, DepthMap],
    beside: dict[str, DepthMap],
) -> Stages:
    """Scores of the result, and those of all others on the pixels where the result is known."""
    if gt is None:
        return {}
    known = np.where(refined.after > 0, gt, np.float32(0))
    stages = {name: depth for name, depth in refined.stages.items() if name != BEFORE}
    return {
        name: _scores(depth, gt if name == AFTER else known)
        for name, depth in (maps | stages | beside).items()
    }


def _scores(depth: DepthMap, gt: DepthMap) -> Scores:
    """The errors of depth (H, W) against ground truth (H, W)."""
    return score(torch.from_numpy(depth), torch.from_numpy(gt)).to_json()


def _at_points(points: SparsePoints, maps: dict[str, DepthMap]) -> Stages:
    """The errors of depth maps (H, W) at points of the same image, where both are known."""
    stages: Stages = {}
    for name, depth in maps.items():
        predicted = points.sample(torch.from_numpy(depth))
        error = (predicted - points.depth)[predicted > 0].double()
        if not len(error):
            continue
        mae, rmse = float(error.abs().mean()), float(error.square().mean().sqrt())
        stages[name] = {"mae": mae, "rmse": rmse, "points": len(error)}
    return stages if AFTER in stages and BEFORE in stages else {}


def _at_validation_points(refined: Refined, *, with_baselines: bool) -> Stages:
    """The MAE of each stage, predicted without the validation points."""
    validation = refined.validation
    if validation is None:
        return {}
    predicted, count = dict(validation.predicted), len(validation.points)
    if with_baselines:
        for name, baseline in BASELINES.items():
            try:
                at = baseline.at(validation.points.xy, validation.kept, validation.network)
            except ModelError:  # such as a line through points that are all equally far
                continue
            predicted.setdefault(name, at)
    return {name: {"mae": validation.error(at), "points": count} for name, at in predicted.items()}


def _baselines(refined: Refined, given: SparsePoints) -> Iterator[tuple[str, DepthMap]]:
    """The depth of the other baselines of all given points that do not fail on the frame."""
    before = torch.from_numpy(refined.before)
    for name, baseline in BASELINES.items():
        if name == LINEAR:  # is compared with in any case
            continue
        try:
            yield name, baseline.depth(given, before).numpy()
        except ModelError:  # such as a line through points that are all equally far
            continue
