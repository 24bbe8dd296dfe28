"""The record of a refined frame: what was asked for, what was done, and the errors."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.refinement.inputs import Inputs
from pnpdepth_cli.commands.stopwatch import versions
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import Scores, score
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.frames.default import ALIGNED, LINEAR, RESULT
from pnpdepth_cli.frames.frame import Check, DepthMap, Refined
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.frames.resolve import normalisation_name
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class PointError:
    """Error of a depth map at the sparse points where it is known, metres."""

    points: int
    mae: float
    rmse: float


def record_of(refiner: Refiner, inputs: Inputs, frame: Refined) -> dict[str, Any]:
    """Returns what the record says of a refined frame, apart from its files and times."""
    request, network = inputs.request, refiner.network
    moved = {"moved": len(frame.used) - inputs.own_used} if inputs.has_neighbours else {}
    return {
        "versions": versions(),
        "unit": inputs.unit,
        "inputs": inputs.record,
        "camera": None if inputs.camera is None else inputs.camera.record(),
        "model": model_record(network, request.network.model),
        "method": {
            "kind": "default" if refiner.is_default else "fixed",
            "reason": refiner.asked.fixed_by or "default",
            "networks": [member.network.definition.name for member in refiner.members],
        },
        "settings": {
            **asdict(refiner.settings),
            "seed": refiner.asked.seed,
            "step": frame.refinement.step,
            "propagate": "gp" if refiner.is_default else refiner.settings.propagate,
            "output_kind": network.definition.output_kind,
            "normalise": normalisation_name(network.definition),
            "holdout": request.hold_out.holdout,
            "precision": network.precision,
            "device": str(network.device),
        },
        "registration": asdict(frame.registration) if frame.registration else None,
        "alignment": asdict(frame.alignment) if frame.alignment else None,
        "size": [inputs.size[1], inputs.size[0]],
        "points": {
            "used": len(frame.used),
            "held_out": len(frame.held_out),
            "nearest": float(inputs.own.depth.min()),
            "farthest": float(inputs.own.depth.max()),
            **moved,
        },
        "loss": list(frame.losses),
        "kept": frame.refinement.kept,
        **({"warm_start": frame.refinement.warm} if frame.in_window else {}),
        "sparse_error": _before_after(frame, lambda d: point_error(d, frame.used)),
        "held_out_error": _before_after(frame, lambda d: point_error(d, frame.held_out)),
        "scores": _before_after(frame, lambda d: _score(d, inputs.gt)),
        "linear": compared_with_linear(frame, inputs.gt),
        "stages": _stages(frame, inputs.gt),
        "hidden_point_steps": dict(frame.steps) or None,
        "baselines": baseline_scores(frame, inputs.gt) if request.hold_out.baselines else None,
        "diverged": str(frame.diverged) if frame.diverged else None,
        "notes": [note for note in (*inputs.notes, *_notes(refiner), *frame.notes) if note],
    }


def model_record(network: Network, spec: str) -> dict[str, Any]:
    """Returns the entries of a network in a record; `spec` is what the user called it."""
    checkpoint = network.checkpoint
    return {
        "name": network.definition.name,
        "spec": spec,
        "checkpoint": str(checkpoint) if checkpoint else None,
        "checkpoint_sha256": _digest(checkpoint, checkpoint.stat().st_mtime_ns)
        if checkpoint
        else None,
    }


@functools.lru_cache(maxsize=8)
def _digest(checkpoint: Path, mtime_ns: int) -> str:
    """The SHA-256 of a checkpoint, computed once for all frames."""
    return sha256_of(checkpoint)


def point_error(depth: DepthMap, points: SparsePoints) -> PointError | None:
    """Returns the error of depth (H, W) at points of its frame; None where it is unknown at all."""
    predicted = points.sample(torch.from_numpy(depth))
    error = (predicted - points.depth)[predicted > 0].double()
    if not len(error):
        return None
    return PointError(
        points=len(error), mae=float(error.abs().mean()), rmse=float(error.square().mean().sqrt())
    )


def compared_with_linear(frame: Refined, gt: DepthMap | None) -> dict[str, Any]:
    """Returns the errors of linear interpolation of the same points, where the result is scored.

    Args:
        frame: The refined frame.
        gt: (H, W) metres, 0 = unknown. None without ground truth.

    Returns:
        "scores" on the pixels of the ground truth where the result is known, "held_out_error" at
        the points of `--holdout`, and "check", the MAE of each stage at the hidden points; each
        None without such pixels or points. "worse": whether the MAE of the result is above that of
        linear interpolation, by the first of these that there is; None without any.
    """
    compared: dict[str, Any] = {"scores": None, "held_out_error": None, "check": None}
    worse: list[bool] = []
    if gt is not None or len(frame.held_out):
        dense = linear(frame.used)
        if gt is not None:
            after = torch.from_numpy(frame.after)
            truth = torch.where(after > 0, torch.from_numpy(gt), 0.0)
            own = score(dense, truth)
            compared["scores"] = asdict(own)
            worse.append(score(after, truth).mae > own.mae)
        error = point_error(dense.numpy(), frame.held_out)
        result = point_error(frame.after, frame.held_out)
        if error is not None and result is not None:
            compared["held_out_error"] = asdict(error)
            worse.append(result.mae > error.mae)
    if frame.check is not None:
        errors = {name: frame.check.error(name) for name in frame.check.predicted}
        compared["check"] = {"points": len(frame.check.hidden), **errors}
        worse.append(errors[RESULT] > errors[LINEAR])
    return compared | {"worse": worse[0] if worse else None}


def baseline_scores(frame: Refined, gt: DepthMap | None) -> dict[str, dict[str, Any]]:
    """Returns the scores of every baseline, of the network and of the result, by name.

    Each has the MAE at the hidden points and, with ground truth, all metrics. A baseline that
    fails on the frame is left out.

    Args:
        frame: The refined frame, with its check where there are enough points.
        gt: (H, W) metres, 0 = unknown. None without ground truth.
    """
    truth = None if gt is None else torch.from_numpy(gt)
    before, after = torch.from_numpy(frame.before), torch.from_numpy(frame.after)
    check, scores = frame.check, dict[str, dict[str, Any]]()
    for name, baseline in BASELINES.items():
        try:
            error = None if check is None else _hidden_error(check, name)
            dense = None if truth is None else baseline.depth(frame.used, before)
        except ModelError:  # such as a line through points that are all equally far
            continue
        scores[name] = _baseline_entry(error, dense, truth)
    of_network, of_result = (
        None if check is None else check.error(name) for name in (ALIGNED, RESULT)
    )
    scores["network"] = _baseline_entry(of_network, before, truth)
    scores["result"] = _baseline_entry(of_result, after, truth)
    return scores


def _hidden_error(check: Check, name: str) -> float:
    predicted = BASELINES[name].at(check.hidden.xy, check.kept, check.network)
    return check.with_prediction(name, predicted).error(name)


def _baseline_entry(
    error: float | None, dense: Tensor | None, truth: Tensor | None
) -> dict[str, Any]:
    metrics = None if truth is None or dense is None else asdict(score(dense, truth))
    return {"held_out_mae": error, "scores": metrics}


def _notes(refiner: Refiner) -> list[str]:
    return [note for member in refiner.members for note in member.network.notes]


def _stages(frame: Refined, gt: DepthMap | None) -> list[dict[str, Any]] | None:
    """The scores of each stage of the default method; None for a fixed method, or without truth."""
    if not frame.stages or gt is None:
        return None
    scores = {name: _score(depth, gt) for name, depth in frame.stages.items()}
    return [{"stage": name, "scores": asdict(s)} for name, s in scores.items() if s is not None]


def _score(depth: DepthMap, gt: DepthMap | None) -> Scores | None:
    return None if gt is None else score(torch.from_numpy(depth), torch.from_numpy(gt))


def _before_after(
    frame: Refined, measure: Callable[[DepthMap], PointError | Scores | None]
) -> dict[str, Any] | None:
    before, after = measure(frame.before), measure(frame.after)
    if before is None or after is None:
        return None
    return {"before": asdict(before), "after": asdict(after)}
