"""A frame refined with held-out points: the default choice, `--baselines` and `--uncertainty`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.auto.auto import MIN_POINTS, AutoRefined, refine_automatically
from pnpdepth_cli.auto.candidates import (
    FUSED_ITERATIONS,
    HIDDEN_POINT_STEPS,
    Candidate,
    RefinementConfig,
    cascades,
    default_config,
)
from pnpdepth_cli.auto.choice import Choice, Competition
from pnpdepth_cli.auto.predictions import OpenNetworks
from pnpdepth_cli.auto.uncertainty import uncertainty
from pnpdepth_cli.choices import BASELINES, PROPAGATIONS
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import DepthMap, Frame, RefinedFrame
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.method import Method
from pnpdepth_cli.pipeline.refinement.request import MethodOptions, RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_settings

LINEAR = Candidate(baseline="linear")
"""The interpolation that every result is compared with."""


def competition_of(
    method: Method,
    networks: Sequence[tuple[str, Network, str, RefineSettings]],
    *,
    timed: bool,
    dense: bool = False,
) -> Competition:
    """Returns which candidates compete for a request.

    Args:
        method: Of the request.
        networks: Name, network, layer and settings of each network, the user's first.
        timed: Whether chosen networks make steps by hidden points while time is left, and slow
            propagations compete.
        dense: Whether the points lie as close as a LiDAR's.
    """
    options = method.options
    if not method.chosen:
        name, _, layer, settings = networks[0]
        config = RefinementConfig(network=name, layer=layer, settings=settings)
        fixed = Candidate(
            config=config,
            iterations=settings.iterations,
            propagate=options.propagate or "none",
        )
        return Competition(configs=(config,), propagations=(), fixed=fixed)
    configs = []
    for name, network, layer, settings in networks:
        config = default_config(network.definition, layer, settings, network=name)
        if options.iterations is None and options.lr is None:
            count = min(FUSED_ITERATIONS, config.settings.iterations)
            if network.definition.input_kind != "rgb":
                count = 0
            config = replace(config, settings=replace(config.settings, iterations=count))
        configs.append(config)
    definitions = {name: network.definition for name, network, _, _ in networks}
    hidden_points = {
        config: _by_hidden_points(config, definitions[config.network], dense=dense)
        for config in configs
        if timed and "sparse" in definitions[config.network].input_kind
    }
    return Competition(
        configs=tuple(configs),
        cascades=cascades(configs, definitions),
        propagations=_competing_propagations(options.propagate, timed=timed),
        hidden_points=hidden_points,
    )


def _by_hidden_points(
    config: RefinementConfig, definition: ModelDefinition, *, dense: bool
) -> RefinementConfig:
    settings = resolve_settings(definition, MethodOptions(target="masked"), dense=dense)
    if not dense:
        settings = replace(settings, iterations=HIDDEN_POINT_STEPS)
    return replace(config, settings=settings)


def refine_with_folds(
    opened: OpenNetworks,
    competition: Competition,
    request: RefineRequest,
    frame: Frame,
    gt: DepthMap | None,
) -> RefinedFrame:
    """Returns the frame refined by its best candidate, or by the fixed one.

    Args:
        opened: The networks.
        competition: Which candidates compete.
        request: What was asked for.
        frame: The frame with all points that may be used.
        gt: (H, W) metres, ground truth to score the baselines at.
    """
    hold_out = request.hold_out
    if hold_out.time_budget_s is not None:
        competition = replace(competition, deadline=time.monotonic() + hold_out.time_budget_s)
    result = refine_automatically(opened, competition, frame, seed=hold_out.seed)
    refined = replace(
        result.frame,
        notes=(*result.frame.notes, *result.notes),
        interpolation=_against_linear(result.choice),
    )
    if competition.fixed is None:
        user = competition.configs[0].network
        definition = opened.networks[user].definition
        refined = replace(
            refined,
            choice=_record(result.choice, user),
            notes=(*refined.notes, *choice_notes(result.choice, definition)),
        )
    if result.hidden_points:
        refined = _with_steps(refined, result.hidden_points)
    if hold_out.baselines:
        refined = replace(refined, baselines=baseline_scores(result, gt))
    if hold_out.uncertainty:
        estimate = uncertainty(result, refined.after)
        refined = replace(
            refined,
            sigma=estimate.sigma,
            valid=estimate.valid,
            notes=(*refined.notes, estimate.note),
        )
    return refined


def best_candidates(
    opened: OpenNetworks, competition: Competition, seed: int, frames: Sequence[Frame]
) -> tuple[Candidate, ...]:
    """Returns the default candidate and those that are best on these frames.

    A frame that fails is left out.

    Raises:
        PnpDepthError: All frames fail; the error is the first one's.
    """
    best: dict[Candidate, None] = {competition.default: None}
    errors: list[PnpDepthError] = []
    for frame in frames:
        try:
            result = refine_automatically(opened, competition, frame, seed=seed)
        except PnpDepthError as error:
            errors.append(error)
        else:
            best |= dict.fromkeys(result.choice.candidates)
    if len(errors) == len(frames):
        raise errors[0]
    return tuple(best)


def _competing_propagations(propagation: str | None, *, timed: bool) -> tuple[str, ...]:
    """The propagation that was asked for, or all; without a time budget the fast ones."""
    if propagation is None:
        return tuple(name for name in PROPAGATIONS if timed or PROPAGATIONS[name].at is not None)
    return () if propagation == "none" else (propagation,)


def _against_linear(choice: Choice) -> dict[str, Any] | None:
    """MAE in metres at held-out points of network, linear interpolation and result, if measured."""
    linear = choice.error_of(LINEAR)
    if linear is None or choice.error is None:
        return None
    return {
        "points": choice.held_out,
        "before": choice.network_error,
        "linear": linear,
        "after": choice.error,
    }


def choice_notes(choice: Choice, definition: ModelDefinition) -> tuple[str, ...]:
    """Returns the notes on the choice that are printed."""
    if choice.error is None:
        return (f"choice: {choice}; with fewer than {MIN_POINTS} points none can be held out",)
    errors = {str(one.candidate): one.error for one in choice.scored}
    best = min((name for name in BASELINES if name in errors), key=lambda name: errors[name])
    network = choice.network_error
    assert network is not None
    note = (
        f"choice: {choice}; MAE {choice.error:.4f} at {choice.held_out:,} held-out points"
        f" (network {network:.4f}, best baseline {best} {errors[best]:.4f})"
    )
    if definition.input_kind == "rgb" or network <= errors[best]:
        return (note,)
    return (
        note,
        f"choice: {definition.name} takes the points itself, and was scored with gaps where some"
        " were held out; if it is trained for points like these, see what --preset fast gives",
    )


def _with_steps(frame: RefinedFrame, kept: Mapping[str, int]) -> RefinedFrame:
    """The frame with a note and a record of the steps by hidden points that were kept."""
    steps = ", ".join(f"{count} with {name}" for name, count in kept.items())
    note = f"hidden points: steps made after the choice and kept: {steps}"
    record = None if frame.choice is None else frame.choice | {"hidden_point_steps": dict(kept)}
    return replace(frame, choice=record, notes=(*frame.notes, note))


def _record(choice: Choice, user: str) -> dict[str, Any]:
    """The choice in JSON's own types."""
    parts = zip(choice.weights, choice.candidates, strict=True)
    return {
        "chosen": [{"weight": weight, **_candidate(each)} for weight, each in parts],
        "mean": "geometric" if choice.geometric else "arithmetic",
        "uses_network": choice.uses(user),
        "held_out_mae": choice.error,
        "held_out_points": choice.held_out,
        "folds": choice.folds,
        "tried": [
            {"held_out_mae": one.error, **_candidate(one.candidate)} for one in choice.scored
        ],
    }


def _candidate(candidate: Candidate) -> dict[str, Any]:
    entry: dict[str, Any] = {"candidate": str(candidate)}
    if candidate.baseline is not None:
        return entry | {"baseline": candidate.baseline}
    if candidate.fused:
        parts = zip(candidate.weights, candidate.fused, strict=True)
        return entry | {
            "fused": [{"weight": weight, **_candidate(each)} for weight, each in parts],
            "propagate": candidate.propagate,
        }
    assert candidate.config is not None
    if candidate.prior is not None:
        entry |= {"prior": _candidate(candidate.prior)}
    return entry | {
        "network": candidate.config.network,
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
