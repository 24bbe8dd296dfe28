"""A frame's depth by the best candidate at held-out points: what `pnpdepth refine` does by default.

1. Outliers, points inconsistent with their neighbours, are removed.
2. Some of the other points are held out. Every candidate predicts them from the rest
   (`predictions`), and the best one, or mean of a few, is chosen (`choice`).
3. The chosen candidates are given all points. If there is time, a chosen network that takes the
   points first makes steps by points hidden from its input (`core.weights_refinement`).

The networks alone and every baseline are candidates, so that the result is never worse than they
are at the held-out points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from pnpdepth_cli.auto.choice import Choice, Competition, Fold, choose
from pnpdepth_cli.auto.cross_validation import spatial_folds
from pnpdepth_cli.auto.predictions import CandidateDepths, FramePasses, OpenNetworks
from pnpdepth_cli.completion.outliers import inlier_weights, outliers
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Frame, RefinedFrame
from pnpdepth_cli.points import SparsePoints

FOLDS = 5
MIN_POINTS = 5
"""With fewer points none is held out."""
ENOUGH_HELD_OUT = 100
"""With this many held-out points no further fold is scored."""
MOST_SCORED = 1000
"""Of more held-out points of a fold a random part is scored."""
ENOUGH_FOR_INTERPOLATION = 500
"""With fewer held-out points all folds are scored before baselines of points get most weight."""
MIN_POINTS_FOR_JOINT_OUTLIERS = 50
"""From this many points on, points inconsistent with other points alone are outliers too."""


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
    """The folds that were scored."""
    notes: tuple[str, ...]
    """What a person should know."""
    hidden_points: Mapping[str, int] = field(default_factory=dict)
    """Steps by hidden points that were kept, by network."""


def refine_automatically(
    opened: OpenNetworks, competition: Competition, frame: Frame, *, seed: int = 0
) -> AutoRefined:
    """Returns the frame's depth by the best candidate, or mean of a few, at held-out points.

    Args:
        opened: The networks.
        competition: Which candidates compete.
        frame: The frame with all points that may be used.
        seed: Of the folds.

    Raises:
        PnpDepthError: The user's network gives no depth.
    """
    passes = FramePasses(opened)
    frame, depths, notes = _without_outliers(passes, competition, frame)
    folds = _folds(passes, competition, frame, depths.prediction, seed)
    scored = folds[: _enough(len(frame.points))]
    choice = choose(scored, competition)
    unsure = choice.is_interpolation and choice.held_out < ENOUGH_FOR_INTERPOLATION
    if unsure and len(scored) < len(folds):
        scored = folds
        choice = choose(scored, competition)
    refined = _refined(choice, competition, depths)
    return AutoRefined(
        frame=refined,
        choice=choice,
        depths=depths,
        folds=scored,
        notes=notes,
        hidden_points=depths.kept_steps,
    )


def _refined(choice: Choice, competition: Competition, depths: CandidateDepths) -> RefinedFrame:
    """The chosen mean from all points; losses are those of the heaviest refinement in it."""
    final = depths.with_hidden_points(competition.hidden_points, until=competition.deadline)
    after = choice.mean([final.dense(candidate) for candidate in choice.candidates])
    heaviest = max(zip(choice.weights, choice.candidates, strict=True), key=lambda one: one[0])[1]
    config = next(iter(heaviest.configs), competition.configs[0])
    before = depths.trajectory(competition.configs[0]).frame.before
    return replace(depths.trajectory(config).frame, before=before, after=after.numpy())


def _without_outliers(
    passes: FramePasses, competition: Competition, frame: Frame
) -> tuple[Frame, CandidateDepths, tuple[str, ...]]:
    """The frame without outliers, its depths, and a note on them.

    Outliers are inconsistent with their neighbours beside what the network predicts from the points
    that are consistent among each other: a network that takes the points follows outliers too. Of
    many points, those inconsistent with the other points alone are outliers as well; of a few, such
    a point may be all that is seen of a small object.
    """

    def depths_of(frame: Frame) -> CandidateDepths:
        return CandidateDepths(passes, frame, competition.configs[0], competition.fusion)

    points, depths = frame.points, depths_of(frame)
    if competition.fixed is not None:
        return frame, depths, ()
    suspected = outliers(torch.ones(points.size), points, frame.rgb)
    consistent = depths
    if bool(suspected.any()):
        consistent = depths_of(frame.with_points(points.select(~suspected)))
    try:
        outlying = outliers(consistent.prediction, points, frame.rgb)
    except PnpDepthError:
        return frame, depths, ()
    if len(points) >= MIN_POINTS_FOR_JOINT_OUTLIERS:
        outlying = outlying | suspected
    count = int(outlying.sum())
    if not count:
        return frame, depths, ()
    note = f"outliers: {count:,} of {len(points):,} points left out, inconsistent with the others"
    frame = frame.without(outlying)
    return frame, depths_of(frame), (note,)


def _folds(
    passes: FramePasses, competition: Competition, frame: Frame, prediction: Tensor, seed: int
) -> tuple[Fold, ...]:
    """All folds."""
    points = frame.points
    if len(points) < MIN_POINTS:
        return ()
    weights = _inlier_weights(points, prediction)
    fold = spatial_folds(points, FOLDS, seed=seed)
    masks = [fold == number for number in range(FOLDS)]
    return tuple(
        Fold(
            held_out=points.select(some),
            inlier_weights=weights[some],
            depths=CandidateDepths(
                passes,
                frame.with_points(points.select(~held)),
                competition.configs[0],
                competition.fusion,
            ),
        )
        for held in masks
        if 0 < int(held.sum()) < len(points)
        for some in [_part_of(held, seed)]
    )


def _enough(points: int) -> int:
    """Number of folds that are scored: one of many points, all of a few."""
    return min(FOLDS, max(1, round(ENOUGH_HELD_OUT * FOLDS / max(1, points))))


def _part_of(held: Tensor, seed: int) -> Tensor:
    """(N,) bool: the held-out points that are scored."""
    (numbers,) = held.nonzero(as_tuple=True)
    drawn = torch.randperm(len(numbers), generator=torch.Generator().manual_seed(seed))
    part = torch.zeros_like(held)
    part[numbers[drawn[:MOST_SCORED]]] = True
    return part


def _inlier_weights(points: SparsePoints, prediction: Tensor) -> Tensor:
    """(N,) 0…1: the weight of each point in a score; outliers would decide all."""
    at_points = points.sample(prediction)
    residual = points.depth.double().log() - at_points.clamp_min(1e-6).double().log()
    return torch.where(at_points > 0, inlier_weights(points, residual), 0.0)
