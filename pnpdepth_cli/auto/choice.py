"""The choice among candidates by their error at held-out points.

The default candidate, the fusion of all networks with its residual propagated, is taken unless
another one is better beyond chance. What is taken is never worse than any baseline at these points.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import torch
from torch import Tensor

from pnpdepth_cli.auto.blending import Blend, best_blend, held_out_error, weighted_mean
from pnpdepth_cli.auto.candidates import FUSED_ITERATIONS, Candidate, RefinementConfig, fusion
from pnpdepth_cli.auto.predictions import CandidateDepths
from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.errors import ModelError, PnpDepthError
from pnpdepth_cli.points import SparsePoints

FUSION_WEIGHTS = (0.25, 0.75)
"""Weights of the first of two networks that compete besides one half."""
FUSED_NETWORKS = 3
"""Networks of which every pair is fused."""


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
    geometric: bool = False
    """Whether the mean is that of log depth."""
    error: float | None = None
    """Mean absolute error at the held-out points, metres. None where none was held out."""
    network_error: float | None = None
    """The same of the user's network."""
    held_out: int = 0
    """Number of held-out points."""
    folds: int = 0
    """Number of folds."""
    scored: tuple[ScoredCandidate, ...] = ()
    """Every candidate that was tried, the best first."""

    @property
    def is_interpolation(self) -> bool:
        """Whether baselines of points alone have most of the weight."""
        weight = sum(
            weight
            for weight, each in zip(self.weights, self.candidates, strict=True)
            if each.baseline is not None and not BASELINES[each.baseline].needs_prediction
        )
        return weight > 0.5

    def __str__(self) -> str:
        if len(self.candidates) == 1:
            return str(self.candidates[0])
        parts = zip(self.weights, self.candidates, strict=True)
        kind = "geometric mean" if self.geometric else "mean"
        return f"{kind} of " + " and ".join(f"{weight:.0%} {each}" for weight, each in parts)

    def mean(self, depths: Sequence[Tensor]) -> Tensor:
        """Returns the mean (…) of the chosen candidates' depths (…)."""
        return weighted_mean(torch.stack(list(depths)), self.weights, geometric=self.geometric)

    def uses(self, network: str) -> bool:
        """Returns whether the network of this name contributes to the depth."""
        return any(
            config.network == network for each in self.candidates for config in each.configs
        ) or any(
            each.baseline is not None and BASELINES[each.baseline].needs_prediction
            for each in self.candidates
        )

    def error_of(self, candidate: Candidate) -> float | None:
        """Returns the candidate's error at the held-out points; None if it was not scored."""
        return next((one.error for one in self.scored if one.candidate == candidate), None)


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Held-out points and the candidates' depths from all other points."""

    held_out: SparsePoints
    """The held-out points, M of them."""
    inlier_weights: Tensor
    """(M,) 0…1, the weight of each point in a score."""
    depths: CandidateDepths
    """Depths from all other points."""
    predictions: dict[Candidate, Tensor] = field(default_factory=dict)
    """Depth (M,) metres at the held-out points of each candidate that was asked for."""

    def at(self, candidate: Candidate) -> Tensor:
        """Returns the candidate's depth (M,) metres at the held-out points."""
        if candidate not in self.predictions:
            self.predictions[candidate] = self.depths.at(self.held_out.xy, candidate)
        return self.predictions[candidate]

    def predicted(self, choice: Choice) -> Tensor:
        """Returns the depth (M,) metres of the chosen mean at the held-out points."""
        return choice.mean([self.at(each) for each in choice.candidates])


@dataclass(frozen=True, kw_only=True)
class Competition:
    """Which candidates compete."""

    configs: tuple[RefinementConfig, ...]
    """One refinement of each network, the user's first."""
    cascades: tuple[Candidate, ...] = ()
    """Networks that are given another network's depth as a prior."""
    propagations: tuple[str, ...]
    """Propagations that compete, the default first."""
    shortlist: tuple[Candidate, ...] | None = None
    """Only these, the networks and the baselines compete, such as the best of other frames."""
    fixed: Candidate | None = None
    """This candidate is taken; the others are only scored."""
    hidden_points: Mapping[RefinementConfig, RefinementConfig] = field(default_factory=dict)
    """Refinements by hidden points that chosen networks get. They do not compete."""
    deadline: float | None = None
    """Time by `time.monotonic` after which nothing is tried and no step by hidden points begins."""

    @property
    def network(self) -> Candidate:
        """The user's network without refinement."""
        return Candidate(config=self.configs[0])

    @property
    def default(self) -> Candidate:
        """The candidate to take where no other is better beyond chance."""
        return self.fusion if self.fixed is None else self.fixed

    @property
    def fusion(self) -> Candidate:
        """Networks and cascades fused; it also continues baselines outside the points' hull."""
        members = [*self.members, *self.cascades]
        weights = [each.config.weight for each in members if each.config is not None]
        return fusion(members, weights, self._propagate)

    @property
    def members(self) -> list[Candidate]:
        """Each network's depth before propagation: one that takes the points is not refined."""
        return [
            Candidate(config=each, iterations=min(each.settings.iterations, FUSED_ITERATIONS))
            for each in self.configs
        ]

    def candidates(self) -> Iterator[Candidate]:
        """Yields the candidates of the networks that compete, besides refinements alone."""
        for config, member in zip(self.configs, self.members, strict=True):
            yield Candidate(config=config)
            yield replace(member, propagate=self._propagate)
        for cascade in self.cascades:
            yield cascade
            yield replace(cascade, propagate=self._propagate)
        for pair in combinations([*self.cascades, *self.members][:FUSED_NETWORKS], 2):
            for weight in (*FUSION_WEIGHTS, 0.5):
                yield fusion(pair, (weight, 1 - weight), self._propagate)

    @property
    def _propagate(self) -> str:
        return next(iter(self.propagations), "none")


def choose(folds: Sequence[Fold], competition: Competition) -> Choice:
    """Returns the candidate, or mean of a few, that is best beyond chance at the held-out points.

    Args:
        folds: Held-out points with the depths from the others. Without any, the default is taken.
        competition: Which candidates compete.
    """
    if not folds:
        return Choice(candidates=(competition.default,), weights=(1.0,))
    board = _Scoreboard(folds)
    baselines = {Candidate(baseline=name): each for name, each in BASELINES.items()}
    plain = list(baselines)
    board.score([competition.network, *plain, competition.default])
    if competition.fixed is not None:
        return _taken(board, competition, competition.fixed)
    if competition.shortlist is not None:
        board.score(competition.shortlist)
    else:
        _score_all(board, competition)
    of_points = [each for each, baseline in baselines.items() if not baseline.needs_prediction]
    errors = board.errors()
    extended = min(of_points, key=lambda each: errors.get(each, float("inf")))
    board.score([replace(extended, within_hull=True)])
    blend = board.blend(competition.default, [*plain, competition.network], of_points)
    return _choice(board, competition, blend)


def _score_all(board: _Scoreboard, competition: Competition) -> None:
    """Scores the candidates while the deadline allows."""
    board.deadline = competition.deadline
    board.score(competition.candidates())
    board.score(each for config in competition.configs for each in _updates(config))
    errors = board.errors()
    starts = [each for each in errors if each.config is not None and each.propagate == "none"]
    if starts:
        best = min(starts, key=lambda each: errors[each])
        board.score(replace(best, propagate=kind) for kind in competition.propagations)


def _updates(config: RefinementConfig) -> list[Candidate]:
    """The depth of a refinement after each number of updates that competes."""
    return [Candidate(config=config, iterations=k) for k in (0, *config.competing_iterations)]


class _Scoreboard:
    """Predictions of candidates at all held-out points, each computed once."""

    def __init__(self, folds: Sequence[Fold]) -> None:
        self.folds = folds
        self.depth = torch.cat([fold.held_out.depth for fold in folds])
        weights = torch.cat([fold.inlier_weights for fold in folds]).float()
        # Without any weight the network sees nothing at these points.
        self.weights = weights if bool(weights.any()) else torch.ones_like(weights)
        self.predicted: dict[Candidate, Tensor] = {}
        self.deadline: float | None = None
        self._longest = 0.0  # seconds that a candidate took, refined with all sets of points

    def score(self, candidates: Iterable[Candidate]) -> None:
        """Adds candidates; those that fail on this frame or have no time left do not compete."""
        for candidate in candidates:
            if candidate in self.predicted:
                continue
            start = time.monotonic()
            if self.deadline is not None and start + self._longest > self.deadline:
                return
            self._add(candidate)
            self._longest = max(self._longest, time.monotonic() - start)

    def _add(self, candidate: Candidate) -> None:
        try:
            self.predicted[candidate] = torch.cat([fold.at(candidate) for fold in self.folds])
        except ModelError:
            # No line fits points that are all equally far: such a baseline does not compete.
            return
        except PnpDepthError:
            if candidate.baseline is not None:
                raise

    def errors(self) -> dict[Candidate, float]:
        """Returns the error in metres of every candidate that competes."""
        return {
            each: float(held_out_error(predicted, self.depth, self.weights))
            for each, predicted in self.predicted.items()
        }

    def blend(
        self, default: Candidate, baselines: Sequence[Candidate], bounds: Sequence[Candidate]
    ) -> Blend:
        """Returns the best blend of everything scored, by position in `predicted`."""
        candidates = list(self.predicted)
        numbers = {each: number for number, each in enumerate(candidates)}
        return best_blend(
            torch.stack(list(self.predicted.values())),
            self.depth,
            self.weights,
            default=numbers.get(default, 0),
            baselines=[numbers[each] for each in baselines if each in numbers],
            bounds=[numbers[each] for each in bounds if each in numbers],
        )


def _taken(board: _Scoreboard, competition: Competition, fixed: Candidate) -> Choice:
    number = list(board.predicted).index(fixed)
    return _choice(board, competition, Blend((number,), (1.0,), False, board.errors()[fixed]))


def _choice(board: _Scoreboard, competition: Competition, blend: Blend) -> Choice:
    candidates, errors = list(board.predicted), board.errors()
    return Choice(
        candidates=tuple(candidates[member] for member in blend.members),
        weights=blend.weights,
        geometric=blend.geometric,
        error=blend.error,
        network_error=errors.get(competition.network),
        held_out=len(board.depth),
        folds=len(board.folds),
        scored=tuple(
            ScoredCandidate(candidate=each, error=error)
            for each, error in sorted(errors.items(), key=lambda one: one[1])
        ),
    )
