"""A frame refined with held-out points: `--auto`, `--baselines` and `--uncertainty`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.auto.auto import (
    MIN_POINTS,
    AutoRefined,
    Choice,
    refine_automatically,
)
from pnpdepth_cli.auto.candidates import Candidate, RefinementConfig, default_configs
from pnpdepth_cli.auto.uncertainty import uncertainty
from pnpdepth_cli.choices import BASELINES, PROPAGATIONS
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import DepthMap, Frame, RefinedFrame
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.request import RefineRequest


def refine_with_folds(
    network: Network,
    layer: str,
    settings: RefineSettings,
    request: RefineRequest,
    frame: Frame,
    gt: DepthMap | None,
    shortlist: Sequence[Candidate] | None = None,
) -> RefinedFrame:
    """Returns the frame refined by its best candidate with `--auto`, else as the settings say.

    Args:
        network: The network.
        layer: The layer to cut at.
        settings: How z is updated.
        request: What was asked for.
        frame: The frame with all points that may be used.
        gt: (H, W) metres, ground truth to score the baselines at.
        shortlist: With `--auto`, the candidates that were best on other frames; only they compete.
    """
    hold_out = request.hold_out
    asked = RefinementConfig(layer=layer, settings=settings)
    fixed = Candidate(
        config=asked, iterations=settings.iterations, propagate=request.method.propagate or "none"
    )
    configs, budget_s = [asked], hold_out.time_budget_s
    if hold_out.auto and shortlist is None:
        configs = default_configs(network.definition, layer, settings)
    elif shortlist is not None:
        first = default_configs(network.definition, layer, settings)[0]
        configs = [first, *(each.config for each in shortlist if each.config)]
        budget_s = math.inf
    result = refine_automatically(
        network,
        list(dict.fromkeys(configs)),
        frame,
        shortlist=shortlist,
        fixed=None if hold_out.auto else fixed,
        propagations=_competing_propagations(request),
        budget_s=budget_s,
        seed=hold_out.seed,
    )
    refined = replace(
        result.frame,
        choice=_record(result.choice) if hold_out.auto else None,
        notes=(
            *result.frame.notes,
            *result.notes,
            *auto_notes(result.choice, request, network.definition),
        ),
    )
    if hold_out.baselines:
        refined = replace(refined, baselines=baseline_scores(result, gt))
    if hold_out.uncertainty:
        sigma, note = uncertainty(result, refined.after)
        refined = replace(refined, sigma=sigma, notes=(*refined.notes, note))
    return refined


def best_candidates(
    network: Network,
    layer: str,
    settings: RefineSettings,
    request: RefineRequest,
    frames: Sequence[Frame],
) -> tuple[Candidate, ...]:
    """Returns the candidates that are best on these frames, one or a few of each.

    Arguments as of `refine_with_folds`. A frame that fails is left out.

    Raises:
        PnpDepthError: All frames fail; the error is the first one's.
    """
    configs = default_configs(network.definition, layer, settings)
    best: dict[Candidate, None] = {}
    errors: list[PnpDepthError] = []
    for frame in frames:
        try:
            result = refine_automatically(
                network,
                configs,
                frame,
                propagations=_competing_propagations(request),
                budget_s=request.hold_out.time_budget_s,
                seed=request.hold_out.seed,
            )
        except PnpDepthError as error:
            errors.append(error)
        else:
            best |= dict.fromkeys(result.choice.candidates)
    if errors and not best:
        raise errors[0]
    return tuple(best)


def _competing_propagations(request: RefineRequest) -> tuple[str, ...]:
    """The propagation that was asked for, or all."""
    kind = request.method.propagate
    if kind is None:
        return tuple(PROPAGATIONS)
    return () if kind == "none" else (kind,)


def auto_notes(
    choice: Choice, request: RefineRequest, definition: ModelDefinition
) -> tuple[str, ...]:
    """Returns what the user is told of the choice; nothing without `--auto`."""
    if not request.hold_out.auto:
        return ()
    if choice.error is None:
        return (
            f"auto: with fewer than {MIN_POINTS} points none can be held out; taken is {choice}",
        )
    errors = {str(one.candidate): one.error for one in choice.scored}
    best = min((name for name in BASELINES if name in errors), key=lambda name: errors[name])
    network = choice.network_error
    assert network is not None
    note = (
        f"auto: {choice}; MAE {choice.error:.4f} at {choice.held_out:,} held-out points in"
        f" {choice.folds} folds (network {network:.4f}, best baseline {best} {errors[best]:.4f})"
    )
    if definition.input_kind == "rgb" or network <= errors[best]:
        return (note,)
    return (
        note,
        f"auto: {definition.name} takes the points itself, and was scored with gaps where some were"
        " held out; if it is trained for points like these, see what it gives without --auto",
    )


def _record(choice: Choice) -> dict[str, Any]:
    """The choice in JSON's own types."""
    parts = zip(choice.weights, choice.candidates, strict=True)
    return {
        "chosen": [{"weight": weight, **_candidate(each)} for weight, each in parts],
        "held_out_mae": choice.error,
        "held_out_points": choice.held_out,
        "folds": choice.folds,
        "tried": [
            {"held_out_mae": one.error, **_candidate(one.candidate)} for one in choice.scored
        ],
    }


def _candidate(candidate: Candidate) -> dict[str, Any]:
    if candidate.baseline is not None:
        return {"way": str(candidate), "baseline": candidate.baseline}
    assert candidate.config is not None
    return {
        "way": str(candidate),
        "layer": candidate.config.layer,
        **asdict(candidate.config.settings),
        "iterations": candidate.iterations,
        "propagate": candidate.propagate,
    }


def baseline_scores(result: AutoRefined, gt: DepthMap | None) -> dict[str, dict[str, Any]]:
    """Returns the scores of every baseline, of the network and of the result, by name.

    Each has the MAE at held-out points and, with ground truth, all metrics.
    """
    errors = {str(one.candidate): one.error for one in result.choice.scored}
    truth = None if gt is None else torch.from_numpy(gt)
    scores: dict[str, dict[str, Any]] = {}
    for name in BASELINES:
        possible = truth is not None and (name in errors or not errors)
        dense = result.depths.dense(Candidate(baseline=name)) if possible else None
        scores[name] = _scores(errors.get(name), dense, truth)
    before, after = (torch.from_numpy(d) for d in (result.frame.before, result.frame.after))
    scores["network"] = _scores(result.choice.network_error, before, truth)
    scores["result"] = _scores(result.choice.error, after, truth)
    return scores


def _scores(error: float | None, dense: Tensor | None, truth: Tensor | None) -> dict[str, Any]:
    metrics = None if truth is None or dense is None else asdict(score(dense, truth))
    return {"held_out_mae": error, "scores": metrics}
