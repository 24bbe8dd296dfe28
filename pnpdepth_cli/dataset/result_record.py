"""The record of a refined frame: what is kept of its networks, settings, points and errors."""

from __future__ import annotations

import platform
from contextlib import suppress
from dataclasses import asdict
from importlib import metadata

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.frame_record import (
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
from pnpdepth_cli.frames.frame import Refined, UsedNetwork
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.io.visualisation import gain
from pnpdepth_cli.measures import AFTER, BEFORE, GT, HELD_OUT, LINEAR, USED, VALIDATION, score
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.version import __version__

Stages = dict[str, Scores]
"""Errors by the stage that they are of, such as `BEFORE` and `AFTER`."""


def record_of_frame(
    refined: Refined,
    frame: ReadFrame,
    *,
    name: str,
    group: str | None = None,
    notes: tuple[str, ...] = (),
    with_baselines: bool = False,
) -> FrameRecord:
    """Returns the record of a refined frame, without its result.

    Args:
        refined: The refined frame.
        frame: The frame as it was read.
        name: Name of the frame.
        group: Sequence that the frame is of. None: none is known.
        notes: Lines for a person, before those of the refined frame.
        with_baselines: Whether every classical completion is scored, too.
    """
    return FrameRecord(
        name=name,
        group=group,
        status="diverged" if refined.diverged else "done",
        message=str(refined.diverged) if refined.diverged else None,
        inputs=dict(frame.sources),
        unit=frame.unit,
        errors=_errors_of(refined, frame, with_baselines=with_baselines),
        notes=[note for note in (*notes, *refined.notes) if note],
    )


def record_of_result(
    refined: Refined, frame: ReadFrame, *, spec: str | None = None, holdout: float = 0.0
) -> ResultRecord:
    """Returns the record of a result, without its outputs and times.

    Args:
        refined: The refined frame.
        frame: The frame as it was read.
        spec: What the user called the network. None: its name.
        holdout: Fraction of the points that is held out.
    """
    network = refined.networks[0]  # the user's; further ones are the program's
    # The points that were used, of which some are of neighbouring frames.
    used_of_frame = len(frame.own_points) - len(frame.held_out)
    points = PointsRecord(
        used=len(refined.used),
        held_out=len(frame.held_out),
        nearest=float(frame.own_points.depth.min()),
        farthest=float(frame.own_points.depth.max()),
        moved=len(refined.used) - used_of_frame if frame.neighbours else None,
    )
    # The settings of the user's network, with nothing left open.
    settings = {
        "method": refined.asked.method,
        "layer": network.layer,
        **asdict(network.settings),
        "seed": refined.asked.seed,
        "step": refined.step,
        "propagate": refined.propagation,
        "output_kind": network.output_kind,
        "normalise": network.normalise,
        "holdout": holdout,
        "device": network.device,
    }
    checkpoint = network.checkpoint
    return ResultRecord(
        size=(frame.size[1], frame.size[0]),
        points=points,
        neighbours=list(frame.neighbours),
        camera=CameraRecord.of(frame.camera, frame.pose) if frame.camera else None,
        model=ModelRecord(
            name=network.name,
            spec=spec or network.name,
            checkpoint=str(checkpoint) if checkpoint else None,
            checkpoint_sha256=fingerprint(checkpoint).sha256 if checkpoint else None,
        ),
        method=MethodRecord(
            name=refined.asked.method,
            propagation=refined.propagation,
            networks=[_network_record(used) for used in refined.networks],
        ),
        settings=settings,
        weights=dict(refined.weights),
        registration=asdict(refined.registration) if refined.registration else None,
        alignment=asdict(refined.alignment) if refined.alignment else None,
        loss=list(refined.losses),
        improved_fraction=_improved_fraction(refined, frame),
        versions=versions(),
    )


def versions() -> dict[str, str]:
    """Returns the versions of the program, Python and the numerical libraries."""
    libraries = ("torch", "numpy", "opencv-python-headless", "OpenEXR")
    return {
        "pnpdepth": __version__,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in libraries},
    }


def _network_record(network: UsedNetwork) -> NetworkRecord:
    """How the depth of one network was aligned and its z updated."""
    settings = asdict(network.settings)
    del settings["propagate"]  # the residual of the result is propagated, not of a network
    return NetworkRecord(name=network.name, layer=network.layer, **settings)


def _errors_of(refined: Refined, frame: ReadFrame, *, with_baselines: bool) -> dict[str, Stages]:
    """The errors of the result, of the stages before it and of linear interpolation.

    Args:
        refined: The refined frame.
        frame: The frame as it was read.
        with_baselines: Whether every classical completion is scored, too.

    Returns:
        Errors by basis (`GT`, `HELD_OUT`, `VALIDATION`, `USED`), of those that the frame has; then
        by stage.
    """
    errors = dict[str, Stages]()
    before = torch.from_numpy(refined.before)
    after = torch.from_numpy(refined.depth)
    own_stages = {BEFORE: before, AFTER: after}
    linear_stage = dict[str, Tensor]()
    if frame.gt is not None or len(frame.held_out):
        linear_stage[LINEAR] = linear(frame.points)
    # Against the truth, all others are scored on those pixels alone where the result is known.
    if frame.gt is not None:
        gt = torch.from_numpy(frame.gt)
        gt_of_result = torch.where(after > 0, gt, 0)
        inner_stages = {name: torch.from_numpy(depth) for name, depth in refined.stages.items()}
        stages = own_stages | inner_stages | linear_stage
        if with_baselines:
            stages |= _baselines(frame.points, before)
        errors[GT] = {
            name: score(depth, gt if name == AFTER else gt_of_result).to_json()
            for name, depth in stages.items()
        }
    errors[HELD_OUT] = _errors_at_points(frame.held_out, own_stages | linear_stage)
    # At validation points, which no stage and no baseline was given.
    validation = refined.validation
    if validation is not None:
        predicted = dict(validation.predicted)  # (N,) at the validation points
        if with_baselines:
            for name, depth in _baselines(validation.kept, validation.network).items():
                predicted[name] = validation.points.sample(depth)
        errors[VALIDATION] = {
            name: {"mae": validation.error(at_points), "points": len(validation.points)}
            for name, at_points in predicted.items()
        }
    errors[USED] = _errors_at_points(refined.used, own_stages)
    return {basis: stages for basis, stages in errors.items() if stages}


def _baselines(points: SparsePoints, before: Tensor) -> dict[str, Tensor]:
    """The depth (H, W) of each classical completion but the linear one, by its name.

    Those that fail on the frame are left out.

    Args:
        points: The points that are completed.
        before: (H, W) metres, the aligned depth of the network.
    """
    completed = dict[str, Tensor]()
    for name in BASELINES:
        if name == LINEAR:
            continue
        with suppress(ModelError):  # such as a line through points that are all equally far
            completed[name] = BASELINES[name](points, before)
    return completed


def _errors_at_points(points: SparsePoints, maps: dict[str, Tensor]) -> Stages:
    """The errors of depth maps at points of the same image, where both are known.

    Args:
        points: The points, of which there may be none.
        maps: (H, W) metres each, by the stage.

    Returns:
        Empty unless the depth is known at some points both before and after.
    """
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
    """The fraction of the pixels with ground truth, else of held-out points, whose error fell.

    None without any.
    """
    before = refined.before
    after = refined.depth
    gt = frame.gt
    # Without ground truth, the same at the held-out points where the result is known, (N,) each.
    if gt is None:
        after_map = torch.from_numpy(after)
        points = frame.held_out.select(frame.held_out.known_in(after_map))
        before = points.sample(torch.from_numpy(before)).numpy()
        after = points.sample(after_map).numpy()
        gt = points.depth.numpy()
    gains = gain(before, after, gt)
    known = gains[np.isfinite(gains)]
    return float((known > 0).mean()) if known.size else None
