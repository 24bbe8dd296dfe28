"""The record of a refined frame: what is kept of its networks, settings, points and errors."""

from __future__ import annotations

import platform
from collections.abc import Iterator
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
        group: Sequence that the frame is of.
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
    own = refined.networks[0]
    # The points that were used, of which some are of neighbouring frames.
    own_used = len(frame.own) - len(frame.held_out)
    points = PointsRecord(
        used=len(refined.used),
        held_out=len(frame.held_out),
        nearest=float(frame.own.depth.min()),
        farthest=float(frame.own.depth.max()),
        moved=len(refined.used) - own_used if frame.neighbours else None,
    )
    # The settings of the user's network, with nothing left open.
    settings = {
        "method": refined.asked.method,
        "layer": own.layer,
        **asdict(own.settings),
        "seed": refined.asked.seed,
        "step": refined.step,
        "propagate": refined.propagation,
        "output_kind": own.output_kind,
        "normalise": own.normalise,
        "holdout": holdout,
        "device": own.device,
    }
    weights = own.checkpoint
    return ResultRecord(
        size=(frame.size[1], frame.size[0]),
        points=points,
        neighbours=list(frame.neighbours),
        camera=CameraRecord.of(frame.camera, frame.pose) if frame.camera else None,
        model=ModelRecord(
            name=own.name,
            spec=spec or own.name,
            checkpoint=str(weights) if weights else None,
            checkpoint_sha256=fingerprint(weights).sha256 if weights else None,
        ),
        method=MethodRecord(
            name=refined.asked.method,
            propagation=refined.propagation,
            networks=[_network_record(network) for network in refined.networks],
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
    """The settings of one network."""
    settings = asdict(network.settings)
    del settings["propagate"]  # the residual of the result is propagated, not of a network
    return NetworkRecord(name=network.name, layer=network.layer, **settings)


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
