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
    LEAST_PART,
    Expert,
    add_blind_expert,
    fit_weights,
    judge_of,
    predict,
    predictions,
    scanner_shares,
    weighs_points,
    weighted_mean,
)
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.refined import Prediction, Refined, Validation, make_refined
from pnpdepth_cli.frames.validation import FOLDS, ValidationSplit, split_frame
from pnpdepth_cli.stages import AFTER, ALONE, BEFORE, LINEAR, PROPAGATED, UPDATED


def refine_default(networks: Sequence[OpenNetwork], frame: Frame, *, seed: int = 0) -> Refined:
    """Returns the frame refined by the default method.

    Args:
        networks: The networks, open, the user's first.
        frame: The frame, its image moved to its points.
        seed: Random seed of the validation points.

    Raises:
        PnpDepthError: The user's network gives no depth.
    """
    for each in networks:
        each.next_image()
    # Points that contradict their neighbours are outliers.
    inliers, judged = without_outliers(networks, frame)
    # A fifth of the inliers are validation points, which every expert predicts from the others.
    split = split_frame(inliers, judged.before, seed)
    experts = predictions(networks, split, judged)
    # Where the image does not help, an expert that does not see it joins.
    experts, warnings = add_blind_expert(networks, split, experts)
    # The weights that predict the validation points best, close to prior weights, fuse the depths.
    weights = fit_weights(experts, split)
    fused = weighted_mean([(e.dense(), weights[e.name]) for e in experts if weights[e.name] > 0])
    # The residual at the inliers is propagated to every pixel.
    inliers = without_far_points(networks, inliers, judged)
    depth = _propagate(fused, inliers, split.propagation)
    # On scan lines, a completion network of that scanner has most of the result.
    shares = scanner_shares(experts, split, weights)
    depth = _with_shares(depth, {e.name: e.dense() for e in experts if e.name in shares}, shares)
    weights = {name: (1 - sum(shares.values())) * w for name, w in weights.items()} | shares
    return make_refined(
        frame,
        _user(experts),
        depth,
        used=inliers.points,
        notes=(*_notes(frame, inliers, split, experts, weights), *warnings),
        stages={} if frame.gt is None else _stages(experts, inliers, split.propagation),
        validation=_validation(experts, split, shares) if len(split.points) else None,
        weights=weights,
    )


def without_outliers(networks: Sequence[OpenNetwork], frame: Frame) -> tuple[Frame, Prediction]:
    """Returns the frame without its outliers, and what the network that judged them gives for it.

    The network that weighs its points judges, else the user's: a useless network does not decide
    which points are used. Outliers differ from its prediction otherwise than their neighbours do.
    Of many points, those that contradict their neighbours by themselves are outliers too.

    Raises:
        PnpDepthError: The network gives no depth.
    """
    points, judge = frame.points, judge_of(networks)
    suspected = outliers(torch.ones(points.size), points, frame.rgb)
    any_suspected = bool(suspected.any())
    consistent = frame.with_points(points.select(~suspected)) if any_suspected else frame
    weighs = any_suspected and weighs_points(judge)
    judged = predict(judge, consistent, updates=not weighs)
    outlying = outliers(judged.before, points, frame.rgb)
    if len(points) >= FEW_POINTS:
        outlying = outlying | suspected
    inliers = frame.without(outlying)
    # A network that weighs its points is given the outliers too, now that they are known.
    if weighs or not torch.equal(outlying, suspected):
        judged = predict(judge, inliers)
    return inliers, judged


def without_far_points(networks: Sequence[OpenNetwork], frame: Frame, judged: Prediction) -> Frame:
    """Returns the frame without points far from the depth of a network that weighs them."""
    if not weighs_points(judge_of(networks)) or is_dense(frame.points):
        return frame
    return frame.without(far_points(judged.before, frame.points))


def _propagate(depth: Tensor, frame: Frame, kind: str) -> Tensor:
    """Depth (H, W) with its residual at the points propagated."""
    return propagate(depth, frame.points, frame.rgb, kind=kind).depth


def _with_shares(depth: Tensor, own: Mapping[str, Tensor], shares: Mapping[str, float]) -> Tensor:
    """Depth (…) with the own depths of completion networks, whose shares are by name."""
    rest = (depth, 1 - sum(shares.values()))
    return weighted_mean([rest, *((own[name], share) for name, share in shares.items())])


def _user(experts: Sequence[Expert]) -> Prediction:
    """What the user's network gives from all points."""
    assert experts[0].prediction is not None
    return experts[0].prediction


def _alone(experts: Sequence[Expert]) -> Expert | None:
    """The network that takes a prior, without one, where it is not the user's."""
    return next((e for e in experts[1:] if e.user is None and e.network is not None), None)


def _stages(experts: Sequence[Expert], frame: Frame, kind: str) -> dict[str, Tensor]:
    """The user's network after each step of its own, and the network that takes a prior alone."""
    user, alone, own = _user(experts), _alone(experts), experts[0].dense()
    propagated = own if experts[0].of_scanner else _propagate(own, frame, kind)
    stages = {BEFORE: user.before, UPDATED: user.after, PROPAGATED: propagated}
    of_alone = {} if alone is None else {ALONE: _propagate(alone.dense(), frame, kind)}
    return stages | of_alone


def _validation(
    experts: Sequence[Expert], split: ValidationSplit, shares: Mapping[str, float]
) -> Validation:
    """The stages and the result at the validation points.

    Each fifth of these is predicted by weights that were fitted to the others.
    """
    user, alone, part = experts[0], _alone(experts), torch.arange(len(split.points)) % FOLDS
    own = user.updated if user.of_scanner else user.at
    predicted = {BEFORE: split.points.sample(user.aligned), PROPAGATED: own}
    # Of networks that take points, z was not updated here.
    if user.network is not None and not user.network.member.takes_points:
        predicted[UPDATED] = user.updated
    if alone is not None:
        predicted[ALONE] = alone.at
    result = torch.empty(len(split.points))
    for fold in range(FOLDS):
        weights = fit_weights(experts, split, part != fold)
        fused = weighted_mean([(each.at, weights[each.name]) for each in experts])
        result[part == fold] = fused[part == fold]
    given = split.kept.points
    if split.kept.outliers is not None:
        given = given.joined(split.kept.outliers)
    return Validation(
        points=split.points,
        kept=given,
        network=user.aligned,
        weights=split.weights,
        predicted=predicted
        | {
            AFTER: _with_shares(result, {each.name: each.updated for each in experts}, shares),
            LINEAR: linear(given, split.points.xy),
        },
    )


def _notes(
    frame: Frame,
    inliers: Frame,
    split: ValidationSplit,
    experts: Sequence[Expert],
    weights: Mapping[str, float],
) -> tuple[str, ...]:
    """Which points were left out, and which of the user's networks have no part in the result."""
    notes = []
    if left_out := len(frame.points) - len(inliers.points):
        notes.append(
            f"outliers: {left_out:,} of {len(frame.points):,} points left out, inconsistent with"
            " the others"
        )
    alone = _alone(experts)
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
