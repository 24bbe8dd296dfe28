"""The default method for one frame: experts, fused by how well each predicts points it did not get.

A fifth of the points, whole scan lines of a LiDAR, are validation points. Every expert predicts
the frame twice, from all points and from the others (`frames.fuse`). The weights with which they
predict the validation points best, close to prior weights, fuse the depths from all points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.outliers import far_points, outliers
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.frames.frame import Frame, is_dense
from pnpdepth_cli.frames.fuse import (
    FEW_POINTS,
    FOLDS,
    LEAST_PART,
    Expert,
    ValidatedFrame,
    add_blind_expert,
    fit_weights,
    predict,
    predictions,
    scanner_shares,
    split_frame,
    weighted_mean,
)
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.refined import Prediction, Refined, Validation, make_refined
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
    judge = next((each for each in networks if each.member.weighs_points), networks[0])
    inliers, judged = without_outliers(judge, frame)
    # A fifth of the inliers are validation points, which every expert predicts from the others.
    split = split_frame(inliers, judged.before, seed)
    experts = predictions(networks, split, {judge: judged})
    # Where the image does not help, an expert that does not see it joins.
    experts, warnings = add_blind_expert(networks, split, experts)
    # The weights that predict the validation points best, close to prior weights, fuse the depths.
    weights = fit_weights(experts, split)
    fused = weighted_mean([(e.dense(), w) for e in experts if (w := weights[e.name]) > 0])
    # Points far from the depth of a network that weighs them are outliers, too.
    if judge.member.weighs_points and not is_dense(inliers.points):
        inliers = inliers.without(far_points(judged.before, inliers.points))
    # The residual at the inliers is propagated to every pixel.
    depth = _propagate(fused, inliers, split)
    # On scan lines, a completion network of that scanner has most of the result.
    shares = scanner_shares(experts, split, weights)
    depth = _with_shares(depth, {e.name: e.dense() for e in experts if e.of_scanner}, shares)
    weights = {name: (1 - sum(shares.values())) * w for name, w in weights.items()} | shares
    return make_refined(
        frame,
        _own(experts[0]),
        depth,
        used=inliers.points,
        notes=(*_notes(frame, inliers, split, experts, weights), *warnings),
        stages={} if frame.gt is None else _stages(experts, inliers, split),
        validation=_validation(experts, split, shares) if len(split.points) else None,
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
    again = bool(suspected.any()) and judge.member.weighs_points
    consistent = frame.with_points(points.select(~suspected)) if bool(suspected.any()) else frame
    judged = predict(judge, consistent, updates=not again)
    outlying = outliers(judged.before, points, frame.rgb)
    if len(points) >= FEW_POINTS:
        outlying = outlying | suspected
    inliers = frame.without(outlying)
    if again or not torch.equal(outlying, suspected):
        judged = predict(judge, inliers)
    return inliers, judged


def _propagate(depth: Tensor, frame: Frame, split: ValidatedFrame) -> Tensor:
    """Depth (H, W) with its residual at the points propagated."""
    return propagate(depth, frame.points, frame.rgb, kind=split.propagation)


def _with_shares(depth: Tensor, own: Mapping[str, Tensor], shares: Mapping[str, float]) -> Tensor:
    """Depth (…) with the own depths of completion networks, whose shares are by name."""
    rest = (depth, 1 - sum(shares.values()))
    return weighted_mean([rest, *((own[name], share) for name, share in shares.items())])


def _own(expert: Expert) -> Prediction:
    """What the network of an expert gives from all points."""
    assert expert.whole is not None
    return expert.whole


def _alone(experts: Sequence[Expert]) -> Expert | None:
    """The network that takes a prior, without one, where it is not the user's."""
    return next((e for e in experts[1:] if e.user is None and e.network is not None), None)


def _stages(experts: Sequence[Expert], frame: Frame, split: ValidatedFrame) -> dict[str, Tensor]:
    """The user's network after each step of its own, and the network that takes a prior alone."""
    own, alone = _own(experts[0]), _alone(experts)
    propagated = own.after if experts[0].of_scanner else _propagate(own.after, frame, split)
    stages = {BEFORE: own.before, UPDATED: own.after, PROPAGATED: propagated}
    return (
        stages if alone is None else stages | {ALONE: _propagate(_own(alone).after, frame, split)}
    )


def _validation(
    experts: Sequence[Expert], split: ValidatedFrame, shares: Mapping[str, float]
) -> Validation:
    """The stages and the result at the validation points.

    Each fifth of these is predicted by weights that were fitted to the others.
    """
    user, alone, part = experts[0], _alone(experts), torch.arange(len(split.points)) % FOLDS
    result = torch.empty(len(split.points))
    for fold in range(FOLDS):
        weights = fit_weights(experts, split, part != fold)
        fused = weighted_mean([(each.at, weights[each.name]) for each in experts])
        result[part == fold] = fused[part == fold]
    given = split.kept.points
    if split.kept.outliers is not None:
        given = given.joined(split.kept.outliers)
    assert user.network is not None
    assert user.kept is not None
    updated = {each.name: each.updated(split) for each in experts}
    predicted = {
        BEFORE: split.points.sample(user.kept.before),
        PROPAGATED: updated[user.name] if user.of_scanner else user.at,
    }
    if not user.network.member.takes_points:  # else z was not updated here
        predicted[UPDATED] = updated[user.name]
    if alone is not None:
        predicted[ALONE] = alone.at
    predicted[AFTER] = _with_shares(result, updated, shares)
    predicted[LINEAR] = linear(given, split.points.xy)
    return Validation(
        points=split.points,
        kept=given,
        network=user.kept.before,
        weights=split.weights,
        predicted=predicted,
    )


def _notes(
    frame: Frame,
    inliers: Frame,
    split: ValidatedFrame,
    experts: Sequence[Expert],
    weights: Mapping[str, float],
) -> tuple[str, ...]:
    """Which points were left out, and which of the user's networks have no part in the result."""
    notes, alone = list[str](), _alone(experts)
    if left_out := len(frame.points) - len(inliers.points):
        notes.append(
            f"outliers: {left_out:,} of {len(frame.points):,} points left out, inconsistent with"
            " the others"
        )
    for own in experts:
        of_user = sum(weights[each.name] for each in experts if each.user is own.user)
        if own.user is None or own.network is not own.user or of_user >= LEAST_PART:
            continue
        why = "its depth does not help to predict the points from each other"
        if len(split.points) and alone is not None:
            why = (
                f"at {len(split.points):,} validation points its error is"
                f" {split.error(own.at):.4f}, that of {alone.name} {split.error(alone.at):.4f}"
            )
        notes.append(f"{own.name} has no part in the result: {why}")
    return tuple(notes)
