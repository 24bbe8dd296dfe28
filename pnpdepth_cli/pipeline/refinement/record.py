"""The record of a refined frame: what was asked for, what was done, and the errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.core.metrics import Scores, score
from pnpdepth_cli.frames.frame import RefinedFrame
from pnpdepth_cli.pipeline.refinement.against_linear import compared_with_linear
from pnpdepth_cli.pipeline.refinement.baseline_table import baseline_scores
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.points import PointError, point_error
from pnpdepth_cli.pipeline.refinement.refiner import Refiner
from pnpdepth_cli.pipeline.refinement.resolve import normalisation_name
from pnpdepth_cli.pipeline.stopwatch import versions


def record_of(refiner: Refiner, inputs: Inputs, frame: RefinedFrame) -> dict[str, Any]:
    """Returns what the record says of a refined frame, apart from its files and times."""
    request, network = refiner.request, refiner.network
    hold_out, method = request.hold_out, refiner.method
    propagate = method.options.propagate
    return {
        "versions": versions(),
        "unit": inputs.unit,
        "inputs": inputs.record,
        "camera": None if inputs.camera is None else inputs.camera.record(),
        "model": refiner.model_record,
        "method": {
            "kind": "default" if method.is_default else "fixed",
            "reason": method.reason,
            "networks": [member.network.definition.name for member in refiner.members],
        },
        "settings": {
            "layer": refiner.layer,
            **asdict(refiner.settings),
            "step": frame.refinement.step,
            "propagate": "gp" if method.is_default else propagate or "none",
            "output_kind": network.definition.output_kind,
            "normalise": normalisation_name(network.definition),
            "holdout": hold_out.holdout,
            "seed": hold_out.seed,
            "precision": request.network.precision,
            "tile": request.network.tile,
            "device": str(network.device),
        },
        "registration": asdict(frame.registration) if frame.registration else None,
        "alignment": asdict(frame.alignment) if frame.alignment else None,
        "size": [inputs.size[1], inputs.size[0]],
        "points": {
            "used": len(frame.used),
            "held_out": len(frame.held_out),
            "nearest": float(inputs.points.depth.min()),
            "farthest": float(inputs.points.depth.max()),
            **_moved_points(inputs, frame),
        },
        "loss": list(frame.refinement.losses),
        "kept": frame.refinement.kept,
        **({"warm_start": frame.refinement.warm} if frame.in_window else {}),
        "sparse_error": _before_after(frame, lambda d: point_error(d, frame.used)),
        "held_out_error": _before_after(frame, lambda d: point_error(d, frame.held_out)),
        "scores": _before_after(frame, lambda d: _score(d, inputs.gt)),
        "linear": compared_with_linear(frame, inputs.gt),
        "stages": _stages(frame, inputs),
        "hidden_point_steps": dict(frame.steps) or None,
        "baselines": baseline_scores(frame, inputs.gt) if hold_out.baselines else None,
        "diverged": str(frame.diverged) if frame.diverged else None,
        "notes": [note for note in (*inputs.notes, *_notes(refiner), *frame.notes) if note],
    }


def _moved_points(inputs: Inputs, frame: RefinedFrame) -> dict[str, int]:
    """The number of used points that are neighbours', for a frame with neighbours."""
    if not inputs.neighbours:
        return {}
    return {"moved": len(frame.used) - (len(inputs.points) - len(frame.held_out))}


def _notes(refiner: Refiner) -> list[str]:
    return [note for member in refiner.members for note in member.network.notes]


def _stages(frame: RefinedFrame, inputs: Inputs) -> list[dict[str, Any]] | None:
    """The scores of each stage of the default method; None for a fixed method, or without truth."""
    if not frame.stages or inputs.gt is None:
        return None
    scores = {name: _score(depth, inputs.gt) for name, depth in frame.stages.items()}
    return [{"stage": name, "scores": asdict(s)} for name, s in scores.items() if s is not None]


def _score(depth: NDArray[np.float32], gt: NDArray[np.float32] | None) -> Scores | None:
    return None if gt is None else score(torch.from_numpy(depth), torch.from_numpy(gt))


def _before_after(
    frame: RefinedFrame, measure: Callable[[NDArray[np.float32]], PointError | Scores | None]
) -> dict[str, Any] | None:
    before, after = measure(frame.before), measure(frame.after)
    if before is None or after is None:
        return None
    return {"before": asdict(before), "after": asdict(after)}
