"""Chooses among candidates by their error at held-out points (`--auto`).

1. Outliers, points inconsistent with their neighbours, are removed.
2. The other points are divided into folds. Each candidate is given the points of all folds but one
   and scored at the points of that one.
3. The best candidate, or mean of a few, is given all points.

The network's own depth and every baseline are candidates, so that the result is never worse than
they are at the held-out points.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.auto.blending import Blend, best_blend, held_out_error
from pnpdepth_cli.auto.candidates import (
    Candidate,
    CandidateDepths,
    RefinementConfig,
    SplitCache,
    Trajectory,
    trajectories,
)
from pnpdepth_cli.auto.cross_validation import spatial_folds
from pnpdepth_cli.choices import BASELINES, PROPAGATIONS
from pnpdepth_cli.completion.alignment import align, where_predicted
from pnpdepth_cli.completion.outliers import inlier_weights, outliers
from pnpdepth_cli.errors import ModelError, PnpDepthError
from pnpdepth_cli.frames.frame import Frame, RefinedFrame
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints

FOLDS = 4
MIN_POINTS = 5
"""With fewer points none is held out."""
ENOUGH_HELD_OUT = 250
"""With this many held-out points no further fold is scored."""
MIN_POINTS_FOR_JOINT_OUTLIERS = 50
"""From this many points on, points inconsistent with other points alone are outliers too."""


@dataclass(frozen=True, kw_only=True)
class ScoredCandidate:
    """A candidate and its error."""

    candidate: Candidate
    """The candidate."""
    error: float
    """Mean absolute error at the held-out points, metres."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The candidates whose weighted mean is taken, and what decided it."""

    candidates: tuple[Candidate, ...]
    """The chosen candidates."""
    weights: tuple[float, ...]
    """Their weights, with a sum of 1."""
    error: float | None = None
    """Mean absolute error at the held-out points, metres. None where none was held out."""
    network_error: float | None = None
    """The same of the network's own depth."""
    held_out: int = 0
    """Number of held-out points."""
    folds: int = 0
    """Number of folds."""
    scored: tuple[ScoredCandidate, ...] = ()
    """Every candidate that was tried, the best first."""

    def __str__(self) -> str:
        if len(self.candidates) == 1:
            return str(self.candidates[0])
        parts = zip(self.weights, self.candidates, strict=True)
        return "mean of " + " and ".join(f"{weight:.0%} {each}" for weight, each in parts)


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Held-out points and the candidates' depths from all other points."""

    held_out: SparsePoints
    """The held-out points, M of them."""
    inlier_weights: Tensor
    """(M,) 0…1, the weight of each point in a score."""
    depths: CandidateDepths
    """Depths from all other points."""

    def at(self, candidate: Candidate) -> Tensor:
        """Returns the candidate's depth (M,) metres at the held-out points."""
        return self.depths.at(self.held_out.xy, candidate)


@dataclass(frozen=True, kw_only=True)
class AutoRefined:
    """A frame refined by the chosen candidates, and what they were chosen from."""

    frame: RefinedFrame
    """The refined frame."""
    choice: Choice
    """What was chosen."""
    depths: CandidateDepths
    """The candidates' depths from all points."""
    folds: tuple[Fold, ...]
    """The folds."""
    notes: tuple[str, ...]
    """What a person should know."""


def refine_automatically(
    network: Network,
    configs: Sequence[RefinementConfig],
    frame: Frame,
    *,
    shortlist: Sequence[Candidate] | None = None,
    fixed: Candidate | None = None,
    propagations: Sequence[str] | None = None,
    budget_s: float | None = None,
    seed: int = 0,
) -> AutoRefined:
    """Returns the frame's depth by the best candidate, or mean of a few, at held-out points.

    Args:
        network: The network.
        configs: Refinements to try. The first is tried in any case. With no time budget, only
            those that differ from the first in alignment are tried.
        frame: The frame with all points that may be used.
        shortlist: Only these, the network and the baselines compete, such as those that were best
            on other frames.
        fixed: This candidate is taken; the others are only scored.
        propagations: Propagations that compete. None: all in `choices.PROPAGATIONS`.
        budget_s: No refinement is begun that would end after this many seconds, judged by those
            before it. Configurations that differ in alignment alone count as one.
        seed: Of the folds.

    Raises:
        PnpDepthError: No configuration gives a depth; the error is the first one's.
    """
    notes: tuple[str, ...] = ()
    with SplitCache(network) as cache:
        if fixed is None:
            frame, notes = _without_outliers(cache, configs[0], frame)
        folds = _folds(frame.points, seed)
        point_sets = [frame.points, *(kept for kept, _ in folds)]
        refined, budget_notes = _refined_in_time(cache, configs, frame, point_sets, budget_s)
    first = next(iter(refined.values()))
    depths = [
        CandidateDepths(
            frame.with_points(points),
            first[i].depths[0],
            {config: of_config[i] for config, of_config in refined.items()},
        )
        for i, points in enumerate(point_sets)
    ]
    weights = _inlier_weights(frame.points, first[0].depths[0])
    scored_folds = tuple(
        Fold(held_out=frame.points.select(held), inlier_weights=weights[held], depths=each)
        for (_, held), each in zip(folds, depths[1:], strict=True)
    )
    competing = tuple(PROPAGATIONS) if propagations is None else propagations
    choice = _choose(
        scored_folds, tuple(refined), shortlist if fixed is None else (fixed,), fixed, competing
    )
    return AutoRefined(
        frame=_blended(choice, depths[0], refined),
        choice=choice,
        depths=depths[0],
        folds=scored_folds,
        notes=(*notes, *budget_notes),
    )


def _blended(
    choice: Choice,
    depths: CandidateDepths,
    refined: dict[RefinementConfig, list[Trajectory]],
) -> RefinedFrame:
    """The weighted mean of the chosen candidates; losses are those of the heaviest refinement."""
    after = torch.stack([depths.dense(candidate) for candidate in choice.candidates])
    after = (torch.tensor(choice.weights).view(-1, 1, 1) * after).sum(dim=0)
    by_weight = sorted(zip(choice.weights, choice.candidates, strict=True), key=lambda p: -p[0])
    first = next(iter(refined))
    config = next((candidate.config for _, candidate in by_weight if candidate.config), first)
    before = refined[first][0].frame.before
    return replace(refined[config][0].frame, before=before, after=after.numpy())


def _without_outliers(
    cache: SplitCache, config: RefinementConfig, frame: Frame
) -> tuple[Frame, tuple[str, ...]]:
    """The frame without outliers, and a note on them.

    Outliers are inconsistent with their neighbours beside what the network predicts from the points
    that are consistent among each other: a network that takes the points follows outliers too. Of
    many points, those inconsistent with the other points alone are outliers as well; of a few, such
    a point may be all that is seen of a small object.
    """
    points = frame.points
    suspected = outliers(torch.ones(points.size), points, frame.rgb)
    plain = replace(config, settings=replace(config.settings, iterations=0))
    (result,) = trajectories(cache, [plain], frame, [points.select(~suspected)])[plain]
    if isinstance(result, PnpDepthError):
        return frame, ()
    found = outliers(result.depths[0], points, frame.rgb)
    if len(points) >= MIN_POINTS_FOR_JOINT_OUTLIERS:
        found = found | suspected
    count = int(found.sum())
    if not count:
        return frame, ()
    note = f"auto: {count:,} of {len(points):,} points left out; all around tells them otherwise"
    return frame.with_points(points.select(~found)), (note,)


def _folds(points: SparsePoints, seed: int) -> list[tuple[SparsePoints, Tensor]]:
    """(the points that are kept, which are held out) of each fold that is scored."""
    if len(points) < MIN_POINTS:
        return []
    fold = spatial_folds(points, FOLDS, seed=seed)
    scored = min(FOLDS, max(1, round(ENOUGH_HELD_OUT * FOLDS / len(points))))
    held = [fold == number for number in range(scored)]
    return [(points.select(~one), one) for one in held if 0 < int(one.sum()) < len(points)]


def _refined_in_time(
    cache: SplitCache,
    configs: Sequence[RefinementConfig],
    frame: Frame,
    point_sets: Sequence[SparsePoints],
    budget_s: float | None,
) -> tuple[dict[RefinementConfig, list[Trajectory]], tuple[str, ...]]:
    """The refinements with each set of points, and a note on those left out for time."""
    start = time.monotonic()
    refined: dict[RefinementConfig, list[Trajectory]] = {}
    first_error: PnpDepthError | None = None
    tried = 0
    for number, variants in enumerate(_grouped_by_alignment(configs)):
        spent = time.monotonic() - start
        if budget_s is None and number:
            return refined, ()
        if refined and budget_s is not None and spent * (number + 1) > budget_s * number:
            return refined, (f"auto: {tried} trials made; for more the time budget is too short",)
        results = trajectories(cache, variants, frame, point_sets, is_redundant=_aligns_the_aligned)
        tried += len(results)
        for config, each in results.items():
            good = [one for one in each if isinstance(one, Trajectory)]
            if len(good) == len(point_sets):
                refined[config] = good
            else:
                first_error = first_error or next(e for e in each if isinstance(e, PnpDepthError))
    if not refined and first_error is not None:
        raise first_error
    return refined, ()


def _grouped_by_alignment(configs: Sequence[RefinementConfig]) -> list[list[RefinementConfig]]:
    """The configurations in order, those that differ in alignment alone in one group."""
    groups: dict[RefinementConfig, list[RefinementConfig]] = {}
    for config in configs:
        key = replace(config, settings=replace(config.settings, align="none"))
        groups.setdefault(key, []).append(config)
    return list(groups.values())


def _aligns_the_aligned(config: RefinementConfig, first: Trajectory) -> bool:
    """Whether the configuration aligns what needs no alignment."""
    if config.settings.align != "auto":
        return False
    if first.frame.alignment is not None:
        return True
    prediction = first.depths[0]
    known, points = where_predicted(prediction, first.frame.used)
    at_points = points.sample(torch.where(known, prediction, 1.0))
    return align(at_points, points, ("depth",), "auto").kind == "none"


def _inlier_weights(points: SparsePoints, prediction: Tensor) -> Tensor:
    """(N,) 0…1: the weight of each point in a score; outliers would decide all."""
    at_points = points.sample(prediction)
    residual = points.depth.double().log() - at_points.clamp_min(1e-6).double().log()
    return torch.where(at_points > 0, inlier_weights(points, residual), 0.0)


class _Scoreboard:
    """Predictions of candidates at all held-out points, each computed once."""

    def __init__(self, folds: Sequence[Fold]) -> None:
        self._folds = folds
        self.depth = torch.cat([fold.held_out.depth for fold in folds])
        weights = torch.cat([fold.inlier_weights for fold in folds]).float()
        # Without any weight the network sees nothing at these points.
        self.weights = weights if bool(weights.any()) else torch.ones_like(weights)
        self.predicted: dict[Candidate, Tensor] = {}

    def score(self, candidates: Sequence[Candidate]) -> dict[Candidate, float]:
        """Returns the errors in metres of the candidates that can compete."""
        for candidate in candidates:
            if candidate in self.predicted:
                continue
            try:
                self.predicted[candidate] = torch.cat([fold.at(candidate) for fold in self._folds])
            except ModelError:
                # No line fits points that are all equally far: such a baseline does not compete.
                if candidate.baseline is None:
                    raise
        return {
            each: float(held_out_error(self.predicted[each], self.depth, self.weights))
            for each in candidates
            if each in self.predicted
        }

    def blend(self, default: Candidate, baselines: Sequence[Candidate]) -> Blend:
        """Returns the best blend of everything scored, by position in `predicted`."""
        candidates = list(self.predicted)
        return best_blend(
            torch.stack(list(self.predicted.values())),
            self.depth,
            self.weights,
            default=candidates.index(default),
            baselines=[number for number, each in enumerate(candidates) if each in baselines],
        )


def _choose(
    folds: Sequence[Fold],
    configs: Sequence[RefinementConfig],
    shortlist: Sequence[Candidate] | None,
    fixed: Candidate | None,
    propagations: Sequence[str],
) -> Choice:
    first = configs[0]
    default = Candidate(config=first, iterations=first.settings.iterations)
    if not folds:
        default = replace(default, propagate=next(iter(propagations), "none"))
        return Choice(candidates=(fixed or default,), weights=(1.0,))
    board = _Scoreboard(folds)
    network = Candidate(config=first)
    baselines = [*(Candidate(baseline=name) for name in BASELINES), network]
    board.score([*baselines, default])
    if shortlist is None:
        board.score(_promising(board, configs, propagations))
    else:
        # A configuration of other frames may be redundant on this one, or have failed.
        board.score([each for each in shortlist if each.config in (None, *configs)])
    candidates = list(board.predicted)
    errors = board.score(candidates)
    if fixed is None:
        blend = board.blend(default, baselines)
    else:
        blend = Blend((candidates.index(fixed),), (1.0,), errors[fixed])
    return Choice(
        candidates=tuple(candidates[member] for member in blend.members),
        weights=blend.weights,
        error=blend.error,
        network_error=errors[network],
        held_out=len(board.depth),
        folds=len(folds),
        scored=tuple(
            ScoredCandidate(candidate=each, error=error)
            for each, error in sorted(errors.items(), key=lambda one: one[1])
        ),
    )


def _promising(
    board: _Scoreboard, configs: Sequence[RefinementConfig], propagations: Sequence[str]
) -> list[Candidate]:
    """Propagations of the best refinement, and of the network's depth that it starts from."""
    errors = board.score(
        [Candidate(config=c, iterations=k) for c in configs for k in (0, *c.competing_iterations)]
    )
    best = min(errors, key=lambda candidate: errors[candidate])
    starts = dict.fromkeys([Candidate(config=best.config), best])
    return [replace(start, propagate=kind) for start in starts for kind in propagations]
