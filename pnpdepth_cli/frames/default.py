"""The default method for one frame: experts, fused by how well each predicts points it did not get.

A fifth of the points, whole scan lines of a LiDAR, are validation points. Every expert predicts
the frame twice, from all points and from the others (`frames.fuse`). The weights with which they
predict the validation points best, close to prior weights, fuse the depths from all points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.outliers import far_points, outliers
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.frames import fuse
from pnpdepth_cli.frames.frame import Frame, Prediction, Refined, Validation, is_dense, make_refined
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.stages import AFTER, ALONE, BEFORE, LINEAR, PROPAGATED, UPDATED


def refine_default(networks: Sequence[OpenNetwork], frame: Frame, *, seed: int = 0) -> Refined:
    """Returns the frame refined by the default method.

    Args:
        networks: The networks, open, the user's first.
        frame: The frame, its image moved to its points.
        seed: Random seed of the validation points.

    Raises:
        PnpDepthError: A network gives no depth.
    """
    for each in networks:
        each.next_image()
    # Points that contradict their neighbours are outliers. The network that weighs its points
    # judges, else the user's: a useless network does not decide which points are used.
    judge = next((each for each in networks if each.weighs_points), networks[0])
    inliers, judged = without_outliers(judge, frame)
    # A fifth of the inliers are validation points, which every expert predicts from the others.
    split = fuse.split_frame(inliers, judged.before, seed)
    experts = fuse.predictions(networks, split, {judge: judged})
    # Where the image does not help, an expert that does not see it joins.
    experts, warnings = fuse.add_blind_expert(networks, split, experts)
    # The weights that predict the validation points best, close to prior weights, fuse the depths.
    weights = fuse.fit_weights(experts, split)
    experts = fuse.with_mirrored(networks, experts, weights)
    fused = fuse.weighted_mean([(e.dense(split), w) for e in experts if (w := weights[e.name]) > 0])
    # Points far from the depth of a network that weighs them are outliers, too.
    if judge.weighs_points and not is_dense(inliers.points):
        inliers = inliers.without(far_points(judged.before, inliers.points))
    # The residual at the inliers is propagated to every pixel.
    depth = _propagate(fused, inliers, split)
    # On scan lines, a completion network of that scanner has most of the result.
    shares = fuse.scanner_shares(experts, split, weights)
    depth = _with_shares(depth, {e.name: e.dense(split) for e in experts if e.of_scanner}, shares)
    weights = {name: (1 - sum(shares.values())) * w for name, w in weights.items()} | shares
    fusing, own = fuse.fusing_network(networks), experts[0].whole
    alone = next((e for e in experts[1:] if fusing is not None and e.name == fusing.name), None)
    assert own is not None
    return make_refined(
        frame,
        own,
        depth,
        used=inliers.points,
        notes=(*_notes(frame, inliers, split, experts, alone, weights), *warnings),
        stages={} if frame.gt is None else _stages(experts[0], alone, inliers, split),
        validation=_validation(experts, alone, split, shares),
        weights=weights,
    )


def without_outliers(judge: OpenNetwork, frame: Frame) -> tuple[Frame, Prediction]:
    """Returns the frame without its outliers, and what a network gives for it.

    Outliers differ from its prediction otherwise than their neighbours do. Of many points, those
    that contradict their neighbours by themselves are outliers too.

    Raises:
        PnpDepthError: The network gives no depth.
    """
    points = frame.points
    suspected = outliers(torch.ones(points.size), points, frame.rgb)
    # A network that weighs its points is given the outliers too, once they are known.
    again = bool(suspected.any()) and judge.weighs_points
    consistent = replace(frame, points=points.select(~suspected))
    judged = fuse.predict(judge, consistent, updates=not again)
    outlying = outliers(judged.before, points, frame.rgb)
    if len(points) >= fuse.FEW_POINTS:
        outlying = outlying | suspected
    inliers = frame.without(outlying)
    if again or not torch.equal(outlying, suspected):
        judged = fuse.predict(judge, inliers)
    return inliers, judged


def _propagate(depth: Tensor, frame: Frame, split: fuse.ValidatedFrame) -> Tensor:
    """Depth (H, W) with its residual at the points propagated."""
    return propagate(depth, frame.points, frame.rgb, kind=split.propagation)


def _with_shares(depth: Tensor, own: Mapping[str, Tensor], shares: Mapping[str, float]) -> Tensor:
    """Depth (…) with the own depths of completion networks, whose shares are by name."""
    rest = (depth, 1 - sum(shares.values()))
    return fuse.weighted_mean([rest, *((own[name], share) for name, share in shares.items())])


def _stages(
    own: fuse.Expert, alone: fuse.Expert | None, frame: Frame, split: fuse.ValidatedFrame
) -> dict[str, Tensor]:
    """The user's network after each step of its own, and the network that takes a prior alone."""
    assert own.whole is not None
    before, updated = own.whole.before, own.whole.after
    propagated = updated if own.of_scanner else _propagate(own.dense(split), frame, split)
    stages = {BEFORE: before, UPDATED: updated, PROPAGATED: propagated}
    if alone is not None:
        stages[ALONE] = _propagate(alone.dense(split), frame, split)
    return stages


def _validation(
    experts: Sequence[fuse.Expert],
    alone: fuse.Expert | None,
    split: fuse.ValidatedFrame,
    shares: Mapping[str, float],
) -> Validation | None:
    """The stages and the result at the validation points; None without any.

    Each fifth of these is predicted by weights that were fitted to the others.
    """
    own, points = experts[0], split.points
    if not len(points):
        return None
    part, result = torch.arange(len(points)) % fuse.FOLDS, torch.empty(len(points))
    for fold in range(fuse.FOLDS):
        weights = fuse.fit_weights(experts, split, part != fold)
        fused = fuse.weighted_mean([(each.at, weights[each.name]) for each in experts])
        result[part == fold] = fused[part == fold]
    given = split.kept.points
    if split.kept.outliers is not None:
        given = given.joined(split.kept.outliers)
    assert own.kept is not None
    predicted = {
        BEFORE: points.sample(own.kept.before),
        PROPAGATED: own.updated if own.of_scanner else own.at,
    }
    if own.user is not None and not own.user.takes_points:  # else z was not updated here
        predicted[UPDATED] = own.updated
    if alone is not None:
        predicted[ALONE] = alone.at
    predicted[AFTER] = _with_shares(result, {each.name: each.updated for each in experts}, shares)
    predicted[LINEAR] = linear(given, points.xy)
    return Validation(
        points=points,
        kept=given,
        network=own.kept.before,
        weights=split.weights,
        predicted=predicted,
    )


def _notes(
    frame: Frame,
    inliers: Frame,
    split: fuse.ValidatedFrame,
    experts: Sequence[fuse.Expert],
    alone: fuse.Expert | None,
    weights: Mapping[str, float],
) -> tuple[str, ...]:
    """Which points were left out, and which of the user's networks have no part in the result."""
    notes = list[str]()
    if left_out := len(frame.points) - len(inliers.points):
        count = f"{left_out:,} of {len(frame.points):,} points"
        notes.append(f"outliers: {count} left out, inconsistent with the others")
    for own in experts:
        of_user = sum(weights[each.name] for each in experts if each.user is own.user)
        if own.user is None or own.name != own.user.name or of_user >= fuse.LEAST_PART:
            continue
        why = "its depth does not help to predict the points from each other"
        if len(split.points) and alone is not None:
            why = (
                f"at {len(split.points):,} validation points its error is"
                f" {split.error(own.at):.4f}, that of {alone.name} {split.error(alone.at):.4f}"
            )
        notes.append(f"{own.name} has no part in the result: {why}")
    return tuple(notes)
