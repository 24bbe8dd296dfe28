"""A frame refined with what held-out points tell: --auto, --baselines and --uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.completion.baselines import BASELINES
from pnpdepth_cli.completion.propagation import calibration
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.auto import (
    FEWEST,
    SPREADING,
    AutoRefined,
    Choice,
    refine_automatically,
    usual_trials,
)
from pnpdepth_cli.pipeline.refinement.frame import FrameToRefine, RefinedFrame
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.ways import Trial, Way

_BELIEVED = 0.05
"""Of 0…1; a held-out point that is believed less says nothing of how sure the depth is."""
_FACTORS = (0.01, 1000.0)
"""A standard deviation is stretched by no more than this, whatever a few points say."""


def refine_with_folds(
    network: Network,
    layer: str,
    settings: RefineSettings,
    request: RefineRequest,
    task: FrameToRefine,
    ways: Sequence[Way] | None = None,
) -> RefinedFrame:
    """The frame refined as asked: its best way with --auto, else as the settings say.

    ways: with --auto, those that were best on other frames; only they compete.
    """
    asked = Trial(layer=layer, settings=settings)
    fixed = Way(trial=asked, iterations=settings.iterations, propagate=task.propagate)
    trials, budget_s = [asked], request.hold_out.time_budget_s
    if request.hold_out.auto and ways is None:
        trials = usual_trials(network.definition, layer, settings)
    elif ways is not None:
        first = usual_trials(network.definition, layer, settings)[0]
        trials, budget_s = [first, *(way.trial for way in ways if way.trial)], math.inf
    found = refine_automatically(
        network,
        list(dict.fromkeys(trials)),
        task.inputs,
        task.used,
        ways=ways,
        fixed=None if request.hold_out.auto else fixed,
        spreading=_spreading(request),
        budget_s=budget_s,
        seed=request.hold_out.seed,
    )
    frame = replace(
        found.frame,
        held_out=task.held_out,
        choice=_record(found.choice) if request.hold_out.auto else None,
        notes=(
            *found.frame.notes,
            *found.notes,
            *auto_notes(found.choice, request, network.definition),
        ),
    )
    if request.hold_out.baselines:
        frame = replace(frame, baselines=baseline_scores(found, task.inputs))
    if request.hold_out.uncertainty:
        sigma, note = uncertainty(found, frame.after)
        frame = replace(frame, sigma=sigma, notes=(*frame.notes, note))
    return frame


def ways_of(
    network: Network,
    layer: str,
    settings: RefineSettings,
    request: RefineRequest,
    tasks: Sequence[FrameToRefine],
) -> tuple[Way, ...]:
    """The ways that are best on these frames, one or a few of each.

    What is wrong with a frame is told when it is its turn; with all of them, it is raised.
    """
    trials = usual_trials(network.definition, layer, settings)
    found: dict[Way, None] = {}
    errors: list[PnpDepthError] = []
    for task in tasks:
        try:
            made = refine_automatically(
                network,
                trials,
                task.inputs,
                task.used,
                spreading=_spreading(request),
                budget_s=request.hold_out.time_budget_s,
                seed=request.hold_out.seed,
            )
        except PnpDepthError as error:
            errors.append(error)
        else:
            found |= dict.fromkeys(made.choice.ways)
    if errors and not found:
        raise errors[0]
    return tuple(found)


def _spreading(request: RefineRequest) -> tuple[str, ...]:
    """How --auto may spread what is left at the points: as asked, or in any way."""
    if request.method.propagate is None:
        return SPREADING
    return () if request.method.propagate == "none" else (request.method.propagate,)


def auto_notes(
    choice: Choice, request: RefineRequest, definition: ModelDefinition
) -> tuple[str, ...]:
    """What the user is told of the choice; nothing if none was asked for."""
    if choice.error is None:
        return (
            (f"auto: with fewer than {FEWEST} points none can be held out; taken is {choice}",)
            if request.hold_out.auto
            else ()
        )
    if not request.hold_out.auto:
        return ()
    by_name = {str(one.way): one.error for one in choice.scored}
    best = min((name for name in BASELINES if name in by_name), key=lambda name: by_name[name])
    network = choice.network
    assert network is not None
    said = (
        f"auto: {choice}; {choice.error:.4f} m off at {choice.held_out:,} held-out points in"
        f" {choice.folds} folds (network {network:.4f} m, best baseline {best}"
        f" {by_name[best]:.4f} m)"
    )
    if definition.input_kind == "rgb" or network <= by_name[best]:
        return (said,)
    return (
        said,
        f"auto: {definition.name} takes the points itself, and was scored with gaps where some were"
        " held out; if it is trained for points like these, see what it gives without --auto",
    )


def _record(choice: Choice) -> dict[str, Any]:
    """The choice in JSON's own types."""
    parts = zip(choice.weights, choice.ways, strict=True)
    return {
        "chosen": [{"weight": weight, **_way(way)} for weight, way in parts],
        "held_out_mae": choice.error,
        "held_out_points": choice.held_out,
        "folds": choice.folds,
        "tried": [{"held_out_mae": one.error, **_way(one.way)} for one in choice.scored],
    }


def _way(way: Way) -> dict[str, Any]:
    if way.baseline is not None:
        return {"way": str(way), "baseline": way.baseline}
    assert way.trial is not None
    settings = asdict(way.trial.settings) | {"iterations": way.iterations}
    return {"way": str(way), "layer": way.trial.layer, **settings, "propagate": way.propagate}


def baseline_scores(found: AutoRefined, inputs: Inputs) -> dict[str, dict[str, Any]]:
    """MAE at held-out points, and scores on the truth, of every baseline, network and result."""
    errors = {str(one.way): one.error for one in found.choice.scored}
    truth = None if inputs.gt is None else torch.from_numpy(inputs.gt)
    scores: dict[str, dict[str, Any]] = {}
    for name in BASELINES:
        possible = truth is not None and (name in errors or not errors)
        dense = found.depths.dense(Way(baseline=name)) if possible else None
        scores[name] = _scores(errors.get(name), dense, truth)
    scores["network"] = _scores(found.choice.network, torch.from_numpy(found.frame.before), truth)
    scores["result"] = _scores(found.choice.error, torch.from_numpy(found.frame.after), truth)
    return scores


def _scores(error: float | None, dense: Tensor | None, truth: Tensor | None) -> dict[str, Any]:
    scored = None if truth is None or dense is None else asdict(score(dense, truth))
    return {"held_out_mae": error, "scores": scored}


def uncertainty(found: AutoRefined, depth: NDArray[np.float32]) -> tuple[NDArray[np.float32], str]:
    """The standard deviation (H, W) of the depth in metres, and how it was calibrated.

    The Gaussian process says where the depth is surer and where less, the held-out points by what
    factor: 68 per cent of them are within ± one of it.
    """
    relative = found.depths.relative_sigma()
    if not found.folds:
        note = "uncertainty: too few points to calibrate it with"
        return (relative.numpy() * depth).astype(np.float32), note
    beyond = []
    for fold in found.folds:
        parts = zip(found.choice.weights, found.choice.ways, strict=True)
        predicted = sum(weight * fold.at(each) for weight, each in parts)
        assert isinstance(predicted, Tensor)
        sigma = fold.held_out.sample(fold.depths.relative_sigma())
        good = (fold.believed > _BELIEVED) & (predicted > 0) & (sigma > 0)
        residual = fold.held_out.depth[good].log() - predicted[good].log()
        beyond.append(torch.stack([residual, sigma[good]]))
    residual, sigma = torch.cat(beyond, dim=1)
    factor = min(max(calibration(residual, sigma), _FACTORS[0]), _FACTORS[1])
    note = f"uncertainty: calibrated with {len(residual):,} held-out points (factor {factor:.2f})"
    return (factor * relative.numpy() * depth).astype(np.float32), note
