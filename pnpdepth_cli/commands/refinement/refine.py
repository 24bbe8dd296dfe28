"""`pnpdepth refine`: one image, its sparse depth, and a network; refined depth and its record."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.error_tables import made_by
from pnpdepth_cli.commands.refinement.output_files import Outputs, plan_outputs, stale_outputs
from pnpdepth_cli.commands.refinement.outputs import within_range, write_outputs
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.commands.stopwatch import Stopwatch, peak_memory_mb, versions
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.dataset.frame_camera import camera_to_json
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import DivergedError, ModelError
from pnpdepth_cli.frames.default import ALIGNED, RESULT
from pnpdepth_cli.frames.frame import DepthMap, Frame, Refined
from pnpdepth_cli.frames.fuse import LINEAR
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.frames.resolve import normalisation_name, with_input_range
from pnpdepth_cli.io.atomic import all_or_none
from pnpdepth_cli.io.record import sha256_of, write_json
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.points import SparsePoints


class RefineOutcome(NamedTuple):
    """A refined frame on disk: what its record holds, the files that were written, and why the
    refinement stopped early, if it did."""

    record: dict[str, Any]
    outputs: Outputs
    diverged: DivergedError | None


def refine_image(
    request: RefineRequest,
    *,
    on_iteration: Callable[[int, int, float], None] = lambda done, of, loss: None,
) -> RefineOutcome:
    """Refines one frame, writes its depth and companions, and returns what was done.

    Args:
        request: What is asked for.
        on_iteration: Called with (done, of, loss) after each update of z.

    Raises:
        PnpDepthError: Any of its kinds; then nothing is written.
    """
    watch = Stopwatch()
    outputs = plan_outputs(request)
    with watch("read"):
        inputs = read_requested(request)
    with watch("load network"):
        refiner = load_refiner(request, inputs)
    with watch("refine"), refiner:
        of = refiner.settings.iterations
        frame = refiner.refine_frame(
            inputs, on_iteration=lambda done, loss: on_iteration(done, of, loss)
        )
    return write_refined(request, outputs, refiner, inputs, frame, watch)


def read_requested(request: RefineRequest) -> Frame:
    """Returns the frame that is asked for, as `read_frame` reads it."""
    return read_frame(
        request.files,
        request.read_options,
        seed=request.method.seed,
        holdout=request.hold_out.holdout,
        needs_camera=request.outputs.view_3d,
    )


def load_refiner(
    request: RefineRequest, first: Frame, more: Callable[[], Sequence[Frame]] = tuple
) -> Refiner:
    """Returns the refiner that is asked for; this first frame decides what networks leave open.

    Args:
        request: What is asked for.
        first: The first frame.
        more: Gives further frames, which decide as well; called only if a network needs it.

    Raises:
        UsageError: The request combines what cannot be combined.
        ModelError: The network cannot be loaded.
    """
    choice, hold_out = request.network, request.hold_out
    chosen = [(choice.model, choice.checkpoint), *((spec, None) for spec in choice.more_models)]
    networks = [load_network(spec, checkpoint, choice.device) for spec, checkpoint in chosen]
    networks[0] = with_input_range(networks[0], choice.normalise)
    refiner = Refiner(
        networks,
        request.method,
        uncertainty=hold_out.uncertainty,
        check=hold_out.baselines,
        compact=not choice.no_compact,
    )
    return refiner.decide(first, more)


def write_refined(
    request: RefineRequest,
    outputs: Outputs,
    refiner: Refiner,
    inputs: Frame,
    frame: Refined,
    watch: Stopwatch,
) -> RefineOutcome:
    """Scores the refined frame and writes it with its record.

    The record is the same from run to run, except `seconds` and `peak_memory_mb`.
    """
    frame = within_range(outputs, inputs, frame)
    record = record_of(request, refiner, inputs, frame)
    stale = list[Path]()
    if "record" in outputs:
        record_path = outputs["record"]
        stale = stale_outputs(record_path.parent, record_path.stem, outputs)
    with all_or_none(outputs.values()):
        with watch("write"):
            record |= write_outputs(outputs, inputs, frame, made_by(record))
        record["seconds"] = watch.seconds
        record["peak_memory_mb"] = peak_memory_mb(refiner.network.device)
        if "record" in outputs:
            write_json(outputs["record"], record)
    for path in stale:  # of a run with other options
        path.unlink(missing_ok=True)
    return RefineOutcome(record=record, outputs=outputs, diverged=frame.diverged)


def record_of(
    request: RefineRequest, refiner: Refiner, inputs: Frame, frame: Refined
) -> dict[str, Any]:
    """Returns what the record says of a refined frame, apart from its files and times."""
    network, gt = refiner.network, inputs.gt
    own_used = len(inputs.own) - len(frame.held_out)
    moved = {"moved": len(frame.used) - own_used} if "neighbours" in inputs.sources else {}
    of_networks = [note for member in refiner.members for note in member.network.notes]
    stages = None if gt is None else frame.stages  # of the default method
    return {
        "versions": versions(),
        "unit": inputs.unit,
        "inputs": dict(inputs.sources),
        "camera": inputs.camera and camera_to_json(inputs.camera, inputs.pose),
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
        "weights": dict(frame.weights),  # of the experts of the default method
        "loss": list(frame.losses),
        "sparse_error": _before_after(frame, lambda depth: _point_error(depth, frame.used)),
        "held_out_error": _before_after(frame, lambda depth: _point_error(depth, frame.held_out)),
        "scores": _before_after(frame, lambda depth: _scores(depth, gt)),
        "linear": _compared_with_linear(frame, inputs.points, gt),
        "stages": [{"stage": n, "scores": _scores(d, gt)} for n, d in stages.items()]
        if stages
        else None,
        "baselines": _baseline_scores(frame, inputs.points, gt)
        if request.hold_out.baselines
        else None,
        "diverged": str(frame.diverged) if frame.diverged else None,
        "notes": [note for note in (*inputs.notes, *of_networks, *frame.notes) if note],
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


def _point_error(depth: DepthMap, points: SparsePoints) -> dict[str, Any] | None:
    """The errors of depth (H, W) at points of its frame; None where it is unknown at all."""
    predicted = points.sample(torch.from_numpy(depth))
    error = (predicted - points.depth)[predicted > 0].double()
    if not len(error):
        return None
    mae, rmse = float(error.abs().mean()), float(error.square().mean().sqrt())
    return {"points": len(error), "mae": mae, "rmse": rmse}


def _scores(depth: DepthMap, gt: DepthMap | None) -> dict[str, Any] | None:
    """The errors of depth (H, W) against the ground truth."""
    if gt is None:
        return None
    return score(torch.from_numpy(depth), torch.from_numpy(gt)).to_json()


def _before_after(
    frame: Refined, measure: Callable[[DepthMap], dict[str, Any] | None]
) -> dict[str, Any] | None:
    before, after = measure(frame.before), measure(frame.after)
    return None if before is None or after is None else {"before": before, "after": after}


def _compared_with_linear(
    frame: Refined, given: SparsePoints, gt: DepthMap | None
) -> dict[str, Any]:
    """The errors of linear interpolation of all given points, where the result is scored.

    "scores" on the pixels of the ground truth where the result is known, "held_out_error" at the
    points of `--holdout`, and "validation", the MAE of each stage at the validation points; each
    None without such pixels or points. "worse": whether the MAE of the result is above that of
    linear interpolation, by the first of these that there is; None without any.
    """
    compared: dict[str, Any] = {"scores": None, "held_out_error": None, "validation": None}
    worse: list[bool] = []
    if gt is not None or len(frame.held_out):
        dense = linear(given).numpy()
        truth = None if gt is None else np.where(frame.after > 0, gt, np.float32(0))
        own, result = _scores(dense, truth), _scores(frame.after, truth)
        if own is not None and result is not None:
            compared["scores"] = own
            worse.append(result["mae"] > own["mae"])
        own, result = (_point_error(depth, frame.held_out) for depth in (dense, frame.after))
        if own is not None and result is not None:
            compared["held_out_error"] = own
            worse.append(result["mae"] > own["mae"])
    if (validation := frame.validation) is not None:
        errors = {name: validation.error(at) for name, at in validation.predicted.items()}
        compared["validation"] = {"points": len(validation.points), **errors}
        worse.append(errors[RESULT] > errors[LINEAR])
    return compared | {"worse": worse[0] if worse else None}


def _baseline_scores(
    frame: Refined, given: SparsePoints, gt: DepthMap | None
) -> dict[str, dict[str, Any]]:
    """The scores of every baseline of all given points, of the network and of the result, by name.

    Each has the MAE at the validation points, where there are enough points, and all metrics, where
    there is ground truth. A baseline that fails on the frame is left out.
    """
    validation, scores = frame.validation, dict[str, dict[str, Any]]()
    before = torch.from_numpy(frame.before)
    for name, baseline in BASELINES.items():
        try:
            error = None
            if validation is not None:
                at = baseline.at(validation.points.xy, validation.kept, validation.network)
                error = validation.error(at)
            metrics = None
            if gt is not None:
                metrics = _scores(baseline.depth(given, before).numpy(), gt)
        except ModelError:  # such as a line through points that are all equally far
            continue
        scores[name] = {"validation_mae": error, "scores": metrics}
    for name, stage, depth in (("network", ALIGNED, frame.before), ("result", RESULT, frame.after)):
        error = None if validation is None else validation.error(validation.predicted[stage])
        scores[name] = {"validation_mae": error, "scores": _scores(depth, gt)}
    return scores
