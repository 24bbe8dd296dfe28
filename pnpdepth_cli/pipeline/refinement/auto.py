"""`--auto`: the best way to dense depth for a frame, by its error at points that are held out.

Points that their neighbours clearly tell otherwise are left out first, if there are any. The others
are shared out into folds. Every way is given the points of all folds but one and is
scored at those of that one, in turn; the best way, or mean of a few, is then given all points. The
network as it is and every simple baseline are among the ways, so what is returned is never worse
than they are at the held-out points.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.auto.blending import Blend, best_blend, held_out_error
from pnpdepth_cli.auto.cross_validation import spatial_folds
from pnpdepth_cli.completion.alignment import align, where_predicted
from pnpdepth_cli.completion.baselines import BASELINES
from pnpdepth_cli.completion.local_alignment import trust
from pnpdepth_cli.completion.propagation import wrong
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import ModelError, PnpDepthError
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.frame import RefinedFrame
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.ways import (
    Depths,
    HeldCut,
    Trajectory,
    Trial,
    Way,
    trajectories,
    updates_of,
)
from pnpdepth_cli.points import SparsePoints

FOLDS = 4
FEWEST = 5
"""With fewer points than this none is held out."""
ENOUGH = 250
"""With this many held-out points no further fold is looked at."""
MANY = 50
"""Of so many points those are wrong, too, that only the other points tell otherwise."""
SPREADING = ("gp", "diffusion")


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A way and its mean absolute error at the held-out points, metres."""

    way: Way
    error: float


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The ways whose weighted mean is taken, and what it was chosen by.

    error: its mean absolute error at the held-out points, metres; None where none was held out.
    network: that of the network as it is. scored: every way that was tried, the best first.
    """

    ways: tuple[Way, ...]
    weights: tuple[float, ...]
    error: float | None = None
    network: float | None = None
    held_out: int = 0
    folds: int = 0
    scored: tuple[Scored, ...] = ()

    def __str__(self) -> str:
        if len(self.ways) == 1:
            return str(self.ways[0])
        parts = zip(self.weights, self.ways, strict=True)
        return "mean of " + " and ".join(f"{weight:.0%} {way}" for weight, way in parts)


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Some points held out, how much each is believed (M,), and the depths by all others."""

    held_out: SparsePoints
    believed: Tensor
    depths: Depths

    def at(self, way: Way) -> Tensor:
        """The way's depth (M,) at the held-out points."""
        return self.depths.at(self.held_out.xy, way)


@dataclass(frozen=True, kw_only=True)
class AutoRefined:
    """A frame refined by the chosen ways, and what they were chosen from.

    depths: by all points.
    """

    frame: RefinedFrame
    choice: Choice
    depths: Depths
    folds: tuple[Fold, ...]
    notes: tuple[str, ...]


def usual_trials(definition: ModelDefinition, layer: str, settings: RefineSettings) -> list[Trial]:
    """Ways to update z, the most promising first: as asked, and with what was left unsaid changed.

    Those that differ from the first in their alignment alone are the usual ones; what takes more
    time comes after them, other layers last.
    """
    adam = replace(settings, update="adam", lr="3%", schedule="constant", blur=0.0, iterations=10)
    steps = [settings, adam]
    if settings == replace(RefineSettings(), align=settings.align):
        steps.reverse()  # nobody has tuned the paper's steps to this network
    kinds = [settings.align] + (["auto"] if settings.align == "none" else [])
    layers = [layer, *(other for other in definition.layers if other != layer)]
    trials = [
        Trial(layer=cut, settings=replace(step, align=kind))
        for cut in layers
        for step in steps
        for kind in kinds
    ]
    return list(dict.fromkeys(trials))


def refine_automatically(
    network: Network,
    trials: Sequence[Trial],
    inputs: Inputs,
    used: SparsePoints,
    *,
    ways: Sequence[Way] | None = None,
    fixed: Way | None = None,
    spreading: Sequence[str] = SPREADING,
    budget_s: float | None = None,
    seed: int = 0,
) -> AutoRefined:
    """The frame's depth by the way, or the mean of a few, that is best at held-out points.

    trials: ways to update z; the first is tried in any case. ways: only these, the network and the
    simple baselines compete, such as those that were best on other frames. fixed: this way is
    taken, and the others are only scored. spreading: the propagations that compete, of
    `completion.propagation.PROPAGATIONS`. budget_s: no trial is begun that would end after this
    many seconds, judged by the trials before it; trials that differ in alignment alone count as
    one. With no time budget, only trials that differ from the first in alignment are tried.
    """
    notes: tuple[str, ...] = ()
    with HeldCut(network) as cut:
        if fixed is None:
            used, notes = _without_wrong(cut, trials[0], inputs, used)
        folds = _folds(used, seed)
        sets = [used, *(kept for kept, _ in folds)]
        made, said = _tried(cut, trials, inputs, sets, budget_s)
    plain = next(iter(made.values()))
    depths = [
        Depths(inputs, points, plain[i].depths[0], {trial: of[i] for trial, of in made.items()})
        for i, points in enumerate(sets)
    ]
    believed = _believed(used, plain[0].depths[0])
    scored = tuple(
        Fold(held_out=used.select(held), believed=believed[held], depths=each)
        for (_, held), each in zip(folds, depths[1:], strict=True)
    )
    choice = _chosen(scored, tuple(made), ways if fixed is None else (fixed,), fixed, spreading)
    after = torch.stack([depths[0].dense(way) for way in choice.ways])
    after = (torch.tensor(choice.weights).view(-1, 1, 1) * after).sum(dim=0)
    weighed = sorted(zip(choice.weights, choice.ways, strict=True), key=lambda one: -one[0])
    trial = next((way.trial for _, way in weighed if way.trial), next(iter(made)))
    frame = replace(made[trial][0].frame, before=plain[0].frame.before, after=after.numpy())
    return AutoRefined(
        frame=frame, choice=choice, depths=depths[0], folds=scored, notes=(*notes, *said)
    )


def _without_wrong(
    cut: HeldCut, trial: Trial, inputs: Inputs, used: SparsePoints
) -> tuple[SparsePoints, tuple[str, ...]]:
    """The points that are not clearly wrong, and what is said of the others.

    They are wrong beside what the network predicts from those that are not wrong beside each other:
    one that takes the points follows the wrong ones too. Of many points, what is wrong beside the
    others is left out as well; of a few, it may be all that is seen of a small thing.
    """
    rgb = inputs.picture()
    doubted = wrong(torch.ones(used.size), used, rgb)
    plain = replace(trial, settings=replace(trial.settings, iterations=0))
    (found,) = trajectories(cut, [plain], inputs, [used.select(~doubted)])[plain]
    if isinstance(found, PnpDepthError):
        return used, ()
    beside_network = wrong(found.depths[0], used, rgb)
    doubted = beside_network | doubted if len(used) >= MANY else beside_network
    count = int(doubted.sum())
    if not count:
        return used, ()
    return used.select(~doubted), (
        f"auto: {count:,} of {len(used):,} points left out; all around tells them otherwise",
    )


def _folds(used: SparsePoints, seed: int) -> list[tuple[SparsePoints, Tensor]]:
    """(the points that are kept, which are held out) of each fold that is looked at."""
    if len(used) < FEWEST:
        return []
    fold = spatial_folds(used, FOLDS, seed=seed)
    looked_at = min(FOLDS, max(1, round(ENOUGH * FOLDS / len(used))))
    held = [fold == number for number in range(looked_at)]
    return [(used.select(~one), one) for one in held if 0 < int(one.sum()) < len(used)]


def _tried(
    cut: HeldCut,
    trials: Sequence[Trial],
    inputs: Inputs,
    sets: Sequence[SparsePoints],
    budget_s: float | None,
) -> tuple[dict[Trial, list[Trajectory]], tuple[str, ...]]:
    """The trials' trajectories with each set of points, and what was left out for the time."""
    began = time.monotonic()
    made: dict[Trial, list[Trajectory]] = {}
    first_error: PnpDepthError | None = None
    tried = 0
    for number, variants in enumerate(_alike(trials)):
        spent = time.monotonic() - began
        if budget_s is None and number:
            return made, ()
        if made and budget_s is not None and spent * (number + 1) > budget_s * number:
            return made, (f"auto: {tried} trials made; for more the time budget is too short",)
        found = trajectories(cut, variants, inputs, sets, needless=_needless)
        tried += len(found)
        for trial, each in found.items():
            good = [one for one in each if isinstance(one, Trajectory)]
            if len(good) == len(sets):
                made[trial] = good
            else:
                first_error = first_error or next(e for e in each if isinstance(e, PnpDepthError))
    if not made and first_error is not None:
        raise first_error
    return made, ()


def _alike(trials: Sequence[Trial]) -> list[list[Trial]]:
    """The trials in order, those together that differ in their alignment alone."""
    groups: dict[Trial, list[Trial]] = {}
    for trial in trials:
        same = replace(trial, settings=replace(trial.settings, align="none"))
        groups.setdefault(same, []).append(trial)
    return list(groups.values())


def _needless(trial: Trial, first: Trajectory) -> bool:
    """Whether the trial aligns what needs no alignment."""
    if trial.settings.align != "auto":
        return False
    if first.frame.alignment is not None:
        return True
    prediction, used = first.depths[0], first.frame.used
    known, points = where_predicted(prediction, used)
    made = align(points.sample(torch.where(known, prediction, 1.0)), points, ("depth",), "auto")
    return made.kind == "none"


def _believed(points: SparsePoints, prediction: Tensor) -> Tensor:
    """(N,) 0…1: how much each point is believed when it is scored; wrong ones would decide all."""
    at_points = points.sample(prediction)
    missing = points.depth.double().log() - at_points.clamp_min(1e-6).double().log()
    return torch.where(at_points > 0, trust(points, missing), 0.0)


def _chosen(
    folds: Sequence[Fold],
    trials: Sequence[Trial],
    only: Sequence[Way] | None,
    fixed: Way | None,
    spreading: Sequence[str],
) -> Choice:
    if not folds:
        usual = Way(
            trial=trials[0],
            iterations=trials[0].settings.iterations,
            propagate=next(iter(spreading), "none"),
        )
        return Choice(ways=(fixed or usual,), weights=(1.0,))
    depth = torch.cat([fold.held_out.depth for fold in folds])
    believed = torch.cat([fold.believed for fold in folds]).float()
    if not bool(believed.any()):  # the network sees nothing at these points
        believed = torch.ones_like(believed)
    predicted: dict[Way, Tensor] = {}

    def scored(ways: Sequence[Way]) -> dict[Way, float]:
        for way in ways:
            if way in predicted:
                continue
            try:
                predicted[way] = torch.cat([fold.at(way) for fold in folds])
            except ModelError:
                if way.baseline is None:
                    raise  # else no line fits points that are all equally far; it does not compete
        errors = {way: predicted[way] for way in ways if way in predicted}
        return {way: float(held_out_error(at, depth, believed)) for way, at in errors.items()}

    usual = Way(trial=trials[0], iterations=trials[0].settings.iterations)
    plain = Way(trial=trials[0])
    simple = [*(Way(baseline=name) for name in BASELINES), plain]
    scored([*simple, usual])
    if only is not None:
        scored(only)
    else:
        errors = scored([Way(trial=t, iterations=k) for t in trials for k in (0, *updates_of(t))])
        best = min(errors, key=lambda way: errors[way])
        starts = dict.fromkeys([Way(trial=best.trial), best])
        scored([replace(way, propagate=kind) for way in starts for kind in spreading])
    errors = scored(list(predicted))
    ways = list(predicted)
    if fixed is None:
        blend = best_blend(
            torch.stack(list(predicted.values())),
            depth,
            believed,
            usual=ways.index(usual),
            simple=[number for number, way in enumerate(ways) if way in simple],
        )
    else:
        blend = Blend((ways.index(fixed),), (1.0,), errors[fixed])
    return Choice(
        ways=tuple(ways[member] for member in blend.members),
        weights=blend.weights,
        error=blend.error,
        network=errors[plain],
        held_out=len(depth),
        folds=len(folds),
        scored=tuple(
            Scored(way=way, error=error)
            for way, error in sorted(errors.items(), key=lambda one: one[1])
        ),
    )
