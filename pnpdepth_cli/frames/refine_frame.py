"""How one frame is refined: the steps of every method, in their order, on one screen.

`fused` and `alone` have all steps; with `alone` the user's networks are the only experts. `paper`
is equation 3 alone, and leaves out what the paper does not have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.outliers import far_points
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.frames.experts import (
    Experts,
    fused_experts,
    networks_alone,
    weighted_mean,
    with_mirrored,
)
from pnpdepth_cli.frames.frame import Frame, Refined, Validation, is_dense
from pnpdepth_cli.frames.fuse import Share, fit_weights, shares_on_lines, with_shares
from pnpdepth_cli.frames.open_network import FEW_POINTS, OpenNetwork
from pnpdepth_cli.frames.strength import OutlierSearch, strength_of, unexplained_of
from pnpdepth_cli.frames.validation import FOLDS, ValidatedFrame, split_frame, whole_frame
from pnpdepth_cli.measures import AFTER, ALONE, BEFORE, LINEAR, PROPAGATED, UPDATED

LEAST_WEIGHT_IN_RESULT = 0.01
"""Weight in the result that a network's own depth and the depth with it as a prior have together;
with less, a note says that the network has no part in the result."""


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """Which steps a method has, besides the network's own."""

    leaves_outliers_out: bool = True
    """Whether points that contradict the others are left out."""
    validates: bool = True
    """Whether a fifth of the points are validation points, which are predicted from the others."""
    fuses: bool = True
    """Whether a network that takes a prior is fused with the others, where there is one."""
    propagation: str | None = None
    """How the residual is propagated; None: as the points say (`validation.whole_frame`)."""
    unused: tuple[str, ...] = ()
    """Names of the user's settings that have no effect if z is not updated, which a note says."""


def refine_frame(
    networks: Sequence[OpenNetwork],
    frame: Frame,
    pipeline: Pipeline,
    *,
    seed: int = 0,
    with_stages: bool = False,
) -> Refined:
    """Returns the frame refined by the steps of a method.

    Args:
        networks: The networks, open; those of the user come before any other.
        frame: The frame, its image moved to its points already.
        pipeline: The steps of the method.
        seed: Random seed of the validation points.
        with_stages: Whether the depth after each step is returned, too.

    Raises:
        PnpDepthError: A network gives no depth.
    """
    for network in networks:
        network.next_image()
    # Points that contradict their neighbours are outliers. They are found beside what one network,
    # the judge, predicts: one that weighs its points, so that a useless network of the user's does
    # not decide which points are used; without such a one, the user's first.
    judge = next((network for network in networks if network.weighs_points), networks[0])
    if pipeline.leaves_outliers_out:
        search = without_outliers(judge, frame, networks)
    else:
        search = OutlierSearch(judge, frame, judge.refine(frame))
    inliers = search.inliers
    # A fifth of the inliers are validation points, which every expert predicts from the others.
    split = whole_frame(inliers, pipeline.propagation)
    if pipeline.validates:
        split = split_frame(split, search.prediction.aligned, networks, seed=seed)
    # The experts predict: the networks, z updated; and `fusing`, a network that takes a dense depth
    # as a prior, with the depth of each.
    fusing = None
    if pipeline.fuses:
        fusing = next((network for network in networks if network.takes_prior), None)
    if fusing is None:
        experts = networks_alone(networks, split, search)
    else:
        experts = fused_experts(networks, fusing, split, search)
    # The weights that predict the validation points best, close to prior weights, fuse the depths.
    weights = fit_weights(experts.every, split)
    if fusing is not None:
        experts = with_mirrored(fusing, experts, weights)
    weighted = [expert for expert in experts.every if weights[expert.name] > 0]
    fused = weighted_mean([(expert.dense, weights[expert.name]) for expert in weighted])
    # Points far from the depth of a network that weighs them are outliers, too.
    if pipeline.leaves_outliers_out and judge.weighs_points and not is_dense(inliers.points):
        inliers = inliers.without(far_points(search.prediction.aligned, inliers.points))
    # The residual at the inliers is propagated to every pixel.
    propagated = _propagate(fused, inliers, split, search.field)
    depth = propagated
    # On scan lines, validation points do not show what some networks are worth: these have a weight
    # beside the fused depth.
    shares: list[Share] = []
    if pipeline.fuses and split.has_scan_lines:
        shares = shares_on_lines(experts, split, inliers, weights)
        depth = with_shares(propagated, [(share.dense, share.weight) for share in shares])
    steps = Steps(
        outlier_field=search.field,
        fused=fused,
        propagated=propagated,
        depth=depth,
        weights=weights,
        shares=shares,
    )
    refined = _refined(frame, inliers, experts, split, steps, pipeline)
    if with_stages:
        stages = _stages(experts, inliers, split, steps)
        refined = replace(refined, stages={name: stage.numpy() for name, stage in stages.items()})
    return refined


class Steps(NamedTuple):
    """What the steps of one frame gave; depths are (H, W) metres, 0 = unknown."""

    outlier_field: ResidualField | None
    """Residual field by which outliers were found. None: they were not sought."""
    fused: Tensor  # the weighted mean of the experts
    propagated: Tensor  # the same, its residual at the points propagated
    depth: Tensor  # the result: the mean of `propagated` and the depths of `shares`
    weights: Mapping[str, float]  # weights of the experts in `fused`, by name
    shares: list[Share]  # networks with a weight in `depth` beside the fused depth; mostly none

    @property
    def weights_in_depth(self) -> dict[str, float]:
        """The weights of all experts in the result; their sum is 1."""
        of_fused = 1 - sum(share.weight for share in self.shares)
        weights = {name: of_fused * weight for name, weight in self.weights.items()}
        for share in self.shares:
            weights[share.name] += share.weight
        return weights


def without_outliers(
    judge: OpenNetwork, frame: Frame, networks: Sequence[OpenNetwork] = ()
) -> OutlierSearch:
    """Returns the frame without its outliers, and what a network, the judge, gives for it.

    An outlier's residual, log measured − log depth that the judge predicts, differs clearly from
    the residuals of its neighbours. From `FEW_POINTS` points on, one whose depth alone contradicts
    its neighbours' is an outlier, too. A point that agrees with a strong network is none.

    z of a judge that takes the image alone is not updated here: how strong the network is tells
    whether it will be (`expert_of_user`).

    Args:
        judge: The network beside whose prediction outliers are told, open.
        frame: The frame with all its points.
        networks: All networks of the frame, open, for those that are strong.

    Raises:
        NoPointsError: No point lies where the network predicts.
    """
    # Points whose depth contradicts their neighbours' are suspected: outliers beside a constant
    # depth of 1 m.
    points = frame.points
    constant = ResidualField(torch.ones(points.size), points, frame.rgb)
    suspected = constant.outliers
    consistent = frame
    if bool(suspected.any()):
        consistent = replace(frame, points=points.select(~suspected))
    # The judge predicts from the others. A judge that weighs its points is given the outliers, too,
    # once they are known; so it predicts again, and this first time without updates.
    predicts_again = bool(suspected.any()) and judge.weighs_points
    updates = judge.takes_points and not predicts_again
    prediction = judge.refine(consistent, updates=updates)
    # Outliers beside its prediction.
    field = ResidualField(prediction.aligned, points, frame.rgb)
    outlying = field.outliers
    if len(points) >= FEW_POINTS:  # of fewer, a suspect may be all that is seen of a small object
        outlying = outlying | suspected
    if bool(outlying.any()) and not is_dense(points):
        outlying = outlying & outliers_beside_strong(networks, frame, constant)
    # What the judge gives for the frame without them; that is known if they are the suspects.
    inliers = frame.without(outlying)
    if predicts_again or not torch.equal(outlying, suspected):
        prediction = judge.refine(inliers, updates=judge.takes_points)
    return OutlierSearch(judge, inliers, prediction, field, constant)


def outliers_beside_strong(
    networks: Sequence[OpenNetwork], frame: Frame, constant: ResidualField
) -> Tensor:
    """Returns (N,) bool: which points are outliers beside the depth of every strong network.

    A strong network takes the image alone, and with its depth the points predict each other far
    better than with a constant one (strength 1 by `strength_of`). With few points it knows more of
    the scene than `compact` does. Where no network is strong, the mask is true at all points.

    Args:
        networks: The networks, open.
        frame: The frame with all its points.
        constant: Residual field of a constant depth at these points.
    """
    outlying = torch.ones(len(frame.points), dtype=torch.bool)
    for network in networks:
        if network.takes_points:
            continue  # it has seen the outliers
        aligned = network.refine(frame, updates=False).aligned
        field = ResidualField(aligned, frame.points, frame.rgb)
        if strength_of(unexplained_of(field, constant)) == 1:
            outlying &= field.outliers
    return outlying


def _propagate(
    depth: Tensor, frame: Frame, split: ValidatedFrame, field: ResidualField | None
) -> Tensor:
    """Depth (H, W) metres, 0 = unknown, corrected by its propagated residual at the points.

    The residual is log measured − log `depth`, and it is predicted at every pixel.

    Args:
        depth: (H, W) metres, 0 = unknown.
        frame: The frame without its outliers.
        split: The frame and its validation points, which says how the residual is propagated.
        field: Residual field that was computed before. It saves time where it is the field of
            `depth` at the frame's points, and is not used otherwise. None: there is none.
    """
    if field is None or not field.is_of(depth, frame.points):
        field = ResidualField(depth, frame.points, frame.rgb)
    return field.depth(kind=split.propagation)


def _refined(
    frame: Frame,
    inliers: Frame,
    experts: Experts,
    split: ValidatedFrame,
    steps: Steps,
    pipeline: Pipeline,
) -> Refined:
    """The refined frame, with what a person should know of it.

    Args:
        frame: The frame with all its points.
        inliers: The frame without its outliers.
        experts: The experts.
        split: The frame and its validation points.
        steps: What the steps gave.
        pipeline: The steps of the method.
    """
    prediction = experts.first_of_user.from_all  # of the user's first network
    notes = _notes(frame, inliers, experts, split, steps, pipeline)
    return Refined(
        before=prediction.aligned.numpy(),
        depth=steps.depth.numpy(),
        used=inliers.points,
        losses=prediction.losses,
        step=prediction.step,
        diverged=prediction.diverged,
        alignment=prediction.alignment,
        propagation=split.propagation,
        notes=tuple(notes),
        validation=_validation(experts, split, steps.shares),
        weights=steps.weights_in_depth,
        registration=frame.registration,
    )


def _notes(
    frame: Frame,
    inliers: Frame,
    experts: Experts,
    split: ValidatedFrame,
    steps: Steps,
    pipeline: Pipeline,
) -> list[str]:
    """What a person should know of the refined frame, a line each; warnings last.

    Args:
        frame: The frame with all its points.
        inliers: The frame without its outliers.
        experts: The experts.
        split: The frame and its validation points.
        steps: What the steps gave.
        pipeline: The steps of the method.
    """
    # The user's first network, and what its alignment told.
    first = experts.first_of_user
    notes = list(first.from_all.notes)
    # Of the image and the points.
    if frame.registration is not None:
        notes.append(
            f"image: moved to the pixel coordinates of the depth camera by {frame.registration}"
        )
    left_out = len(frame.points) - len(inliers.points)
    if left_out:
        notes.append(
            f"outliers: {left_out:,} of {len(frame.points):,} points left out, inconsistent with"
            " the others"
        )
    # Of the networks, and of the updates of the user's.
    notes += _notes_on_networks(experts, split, steps.weights_in_depth)
    if first.harm is not None:
        error_without, error_with = first.harm  # metres
        notes.append(
            f"{first.name}: these updates of z are not used, as they raise its error at"
            f" {len(split.points):,} validation points from {error_without:.4f} to {error_with:.4f}"
        )
    elif first.share_of_aligned > 0:
        notes.append(
            f"{first.name} is strong: with its depth the points predict each other far better than"
            f" without; {first.share_of_aligned:.0%} of it is taken before the updates of z"
        )
    if pipeline.unused and not first.from_all.updates:
        names = ", ".join(f"`{name}`" for name in pipeline.unused)
        notes.append(f"{names}: not used, as z of {first.name} is not updated")
    return [*notes, *experts.warnings]


def _stages(
    experts: Experts, frame: Frame, split: ValidatedFrame, steps: Steps
) -> dict[str, Tensor]:
    """Depths (H, W) metres, 0 = unknown, of the user's first network after each step, by stage.

    The depth of the network that takes a prior, predicted without one, is a stage, too.

    Args:
        experts: The experts.
        frame: The frame without its outliers.
        split: The frame and its validation points.
        steps: What the steps gave.
    """

    def propagated(dense: Tensor) -> Tensor:
        """A depth (H, W) metres, 0 = unknown, corrected by its propagated residual."""
        if dense is steps.fused:
            return steps.propagated  # computed already
        return _propagate(dense, frame, split, steps.outlier_field)

    first = experts.first_of_user
    stages = {BEFORE: first.from_all.aligned}
    # Updates without a part in the result are no stage, except those that do harm, so that a user
    # sees it.
    if first.from_all.updates and (first.share_of_aligned < 1 or first.harm is not None):
        stages[UPDATED] = first.from_all.updated
    # A completion network on scan lines has its weight in the result without propagation.
    if first.of_scanner:
        stages[PROPAGATED] = first.from_all.updated
    elif split.propagation != "none":
        stages[PROPAGATED] = propagated(first.dense)
    if experts.without_prior is not None:
        stages[ALONE] = propagated(experts.without_prior.dense)
    return stages


def _validation(
    experts: Experts, split: ValidatedFrame, shares: Sequence[Share]
) -> Validation | None:
    """The stages and the result at the validation points; None without such points.

    The fused depth at each fifth of them has weights that were fitted to the other four fifths.

    Args:
        experts: The experts.
        split: The frame and its validation points.
        shares: The shares of single networks in the result.
    """
    first = experts.first_of_user
    points = split.points
    if not len(points):
        return None
    # The fused depth at each fold of the points, a fifth of them.
    fold_of_point = torch.arange(len(points)) % FOLDS
    fused = torch.empty(len(points))
    for fold in range(FOLDS):
        weights = fit_weights(experts.every, split, fold_of_point != fold)
        mean = weighted_mean(
            [(expert.at_validation, weights[expert.name]) for expert in experts.every]
        )
        fused[fold_of_point == fold] = mean[fold_of_point == fold]
    # All points but those for validation, outliers too.
    others = split.kept.points
    if split.kept.outliers is not None:
        others = others.joined(split.kept.outliers)
    # The steps of the user's network, `compact` alone, the result and interpolation.
    predicted = {BEFORE: points.sample(first.from_others.aligned)}
    if first.from_others.updates:
        predicted[UPDATED] = first.updated_at_validation
    if first.of_scanner:
        predicted[PROPAGATED] = first.updated_at_validation
    elif split.propagation != "none":
        predicted[PROPAGATED] = first.at_validation
    if experts.without_prior is not None:
        predicted[ALONE] = experts.without_prior.at_validation
    predicted[AFTER] = with_shares(fused, [(share.at_validation, share.weight) for share in shares])
    predicted[LINEAR] = linear(others, points.xy)
    return Validation(
        points=points,
        kept=others,
        network=first.from_others.aligned,
        weights=split.weights,
        predicted=predicted,
    )


def _notes_on_networks(
    experts: Experts, split: ValidatedFrame, weights: Mapping[str, float]
) -> list[str]:
    """Which of the user's networks have no part in the result or are not updated, and why.

    Args:
        experts: The experts.
        split: The frame and its validation points.
        weights: The weights of all experts in the result, by name.
    """
    notes: list[str] = []
    without_prior = experts.without_prior
    for network in experts.of_users:
        if network.lacks_trust:
            notes.append(
                f"z of {network.name} is not updated: its aligned depth explains too little of the"
                " points for updates to reach the result; `iterations` updates it all the same"
            )
        # The weight of its own depth, and of the depth that has it as a prior.
        experts_of_user = [expert for expert in experts.every if expert.user is network.user]
        if sum(weights[expert.name] for expert in experts_of_user) >= LEAST_WEIGHT_IN_RESULT:
            continue
        why = "its depth does not help to predict the points from each other"
        if len(split.points) and without_prior is not None:
            why = (
                f"at {len(split.points):,} validation points its error is"
                f" {split.error(network.at_validation):.4f}, that of {without_prior.name}"
                f" {split.error(without_prior.at_validation):.4f}"
            )
        notes.append(f"{network.name} has no part in the result: {why}")
    return notes
