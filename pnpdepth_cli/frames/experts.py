"""The experts of a frame: what predicts it from its points, and with which prior weight.

The prior weight is the weight in the fused depth before the validation points change it.

1. The user's networks predict, aligned with the points, z updated.
2. `compact` predicts with each one's depth as a prior, and without.
3. Linear interpolation predicts; and, where the image is in doubt, `compact` with a grey image.

All predict twice: from all points, and the validation points from the others.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.frames.frame import Frame, Prediction
from pnpdepth_cli.frames.open_network import MIRRORED_BELOW, OpenNetwork
from pnpdepth_cli.frames.strength import OutlierSearch, strength_of, trust_in_image, unexplained_by
from pnpdepth_cli.frames.validation import ValidatedFrame
from pnpdepth_cli.measures import LINEAR
from pnpdepth_cli.points import SparsePoints

# Prior weights were chosen on 7-Scenes, ICL-NUIM, NYU, RealSense, rendered rooms and streets with
# each set left out in turn (docs/notes/fusion.md). What a network is worth is in `strength`.
OF_NETWORK = 0.15
"""Prior weight of a network that explains the points, and is not strong."""
OF_STRONG_NETWORK = 0.5
"""Prior weight of a strong network, of strength 1 (`strength_of`)."""
LEAST_UNEXPLAINED = 0.02
"""Least part that a network leaves unexplained (`strength.unexplained_by`). Several networks share
the prior weights by its inverse square."""
HARMFUL = 1.05
"""Error at the validation points with updates of z, over that without, from which on updates that
the user states are not used."""
WITH_PRIOR = 0.45
"""Prior weight of `compact` with that network's depth as a prior. `compact` without a prior has
what all other prior weights leave of 1."""
WITHOUT_IMAGE = 0.05
"""Prior weight of every expert that leaves the image out."""
LEAST_WEIGHT = 1e-6
"""A sum of weights is at least this before it is divided by."""
DOUBT = 2.0
"""Standard errors by which the image lowers the error at the validation points, from which on no
expert that leaves the image out joins."""
NO_GAIN = 0.5
"""Standard errors by which the image lowers that error, below which there is a warning. With 500
points, 25 even frames with their own image have at least 0.7, but 2 of 18 odd ones less than 0.5;
8 of 9 with another image at most 0.4."""
ENOUGH_FOR_DOUBT = 50
"""Fewer validation points do not tell an image that belongs to its points from another one."""
LEAST_ERROR = 1e-9
"""Metres; errors at validation points are at least this before they are divided by."""


@dataclass(frozen=True, kw_only=True)
class Expert:
    """What predicts a frame from its points: linear interpolation, or a network."""

    name: str
    weight: float = 0.0
    """Prior weight: its weight in the fused depth before the validation points change it. With 0 it
    has no part in the fused depth."""
    at_validation: Tensor
    """(M,) metres, 0 = unknown: its depth at the M validation points, predicted from the other
    points, its residual at these propagated."""
    updated_at_validation: Tensor
    """(M,) metres, 0 = unknown: the same depth, the residual not propagated; of a network, always
    that of the updated z."""
    points: SparsePoints  # all points, those for validation too
    user: OpenNetwork | None = None
    """The user's network whose depth it has, or takes as its prior. None: neither."""
    of_scanner: bool = False
    """Whether it is a network of the user's that takes points, and these are scan lines."""

    @functools.cached_property
    def dense(self) -> Tensor:
        """(H, W) metres, 0 = unknown: from all points, the residual not propagated."""
        return linear(self.points)


@dataclass(frozen=True, kw_only=True)
class NetworkExpert(Expert):
    """A network that predicts the frame, perhaps with another network's depth as a prior."""

    from_all: Prediction  # from all points
    from_others: Prediction  # from the points that are not for validation
    frame: Frame | None = None  # what it is shown mirrored, too. None: it sees one frame
    mirrored: Tensor | None = None  # (H, W): its depth of the mirrored frame, turned back
    unexplained: float = 1.0
    """Part of the points' depth, mostly 0…1, that a network of the image alone leaves unexplained
    (`unexplained_by`); 1 for a network that takes points."""
    share_of_aligned: float = 0.0
    """0…1, weight in its depth of the aligned depth, before updates of z. The depth after them has
    the rest."""
    lacks_trust: bool = False  # whether z is not updated only because `trust_in_image` is 0
    harm: tuple[float, float] | None = None
    """Errors in metres at the validation points without and with updates of z, if these are not
    used because of them."""

    @property
    def strength(self) -> float:
        """0…1, how strong the network is on this frame, by `unexplained`."""
        return strength_of(self.unexplained)

    @functools.cached_property
    def dense(self) -> Tensor:
        """(H, W) metres, 0 = unknown: from all points, the residual not propagated.

        With `mirrored` it is the mean of the depths of both frames.
        """
        depth = _mix_with_aligned(self.from_all, self.share_of_aligned)
        if self.mirrored is None:
            return depth
        return weighted_mean([(depth, 1), (self.mirrored, 1)])


class Experts(NamedTuple):
    """The experts of a frame, and what stands out among them."""

    first_of_user: NetworkExpert
    """The user's first network."""
    without_prior: NetworkExpert | None
    """What the network that takes a prior predicts without one. None: no such network is fused with
    the user's."""
    every: list[Expert]
    """All experts, the user's networks first."""
    warnings: tuple[str, ...] = ()
    """Notes for a person, each of which begins with "warning"."""

    @property
    def of_users(self) -> list[NetworkExpert]:
        """The experts that are a network of the user's, none with another network's prior."""
        # An expert of another network with the user's depth as its prior has another name.
        return [
            expert
            for expert in self.every
            if isinstance(expert, NetworkExpert)
            and expert.user is not None
            and expert.user.name == expert.name
        ]

    def replaced(self, every: Sequence[Expert]) -> Experts:
        """Returns these experts after a step that changed some of them.

        Args:
            every: All experts, changed or not, in the order of `Experts.every`.
        """
        by_name = {expert.name: expert for expert in every if isinstance(expert, NetworkExpert)}
        without_prior = self.without_prior
        if without_prior is not None:
            without_prior = by_name[without_prior.name]
        return self._replace(
            first_of_user=by_name[self.first_of_user.name],
            without_prior=without_prior,
            every=list(every),
        )


def expert_of(
    network: OpenNetwork,
    split: ValidatedFrame,
    name: str,
    *,
    prediction: Prediction | None = None,
    prior: NetworkExpert | None = None,
    user: OpenNetwork | None = None,
    updates: bool = True,
    unexplained: float = 1.0,
) -> NetworkExpert:
    """Returns what a network predicts from all points, and from those not for validation.

    The prior weight of this expert, its weight in the fused depth before the validation points
    change it, is still 0.

    Args:
        network: The network, open.
        split: The frame and its validation points.
        name: Name of the expert.
        prediction: What the network predicts from all points. None: it is computed.
        prior: Expert whose aligned depth the network takes as its prior. None: it takes none.
        user: The user's network, whose depth the expert has, or takes as its prior. None: neither.
        updates: Whether z, the output of the cut layer, may be updated.
        unexplained: Part of the points' depth that the network leaves unexplained, as returned by
            `unexplained_by`; 1 for a network that takes points.
    """
    # The network predicts from all points; a prior is made from all points, too.
    whole = split.whole if prior is None else replace(split.whole, prior=prior.from_all.aligned)
    if prediction is None:
        prediction = network.refine(whole, updates=updates)
    # The stronger a network is, the more of its depth is that before updates of z, unless the user
    # states their number. Without updates the two depths are one.
    is_updated = network.settings.iterations > 0
    share_of_aligned = 0.0
    if is_updated and not network.always_updated:
        share_of_aligned = strength_of(unexplained)
    no_depth = split.points.depth[:0]  # (0,), until the validation points are predicted
    expert = NetworkExpert(
        name=name,
        at_validation=no_depth,
        updated_at_validation=no_depth,
        points=whole.points,
        from_all=prediction,
        from_others=prediction,  # until it predicts without the validation points
        user=user,
        frame=whole if network.takes_prior else None,
        of_scanner=user is network and network.takes_points and split.has_scan_lines,
        unexplained=unexplained,
        share_of_aligned=share_of_aligned,
    )
    if not len(split.points):
        return expert
    # It predicts the validation points from the others; a prior is made from the others, too.
    kept = split.kept if prior is None else replace(split.kept, prior=prior.from_others.aligned)
    return _with_validation(expert, network, split, kept, updates=updates)


def _with_validation(
    expert: NetworkExpert,
    network: OpenNetwork,
    split: ValidatedFrame,
    kept: Frame,
    *,
    updates: bool,
) -> NetworkExpert:
    """The expert with what its network predicts at the validation points.

    Args:
        expert: The expert, with its prediction from all points.
        network: Its network, open.
        split: The frame and its validation points, of which there are some.
        kept: The frame without these, with the expert's prior, if it has one.
        updates: Whether z may be updated.
    """
    share_of_aligned = expert.share_of_aligned
    # Updates of a network that takes points gain little and take as long as all else. So they are
    # spared here, unless the user states them.
    # With a share of 1 the updated depth has no part.
    is_stated = network.tuned or network.always_updated
    is_worth_it = share_of_aligned < 1 and (is_stated or not network.takes_points)
    prediction = network.refine(kept, updates=updates and is_worth_it)
    mixed = _mix_with_aligned(prediction, share_of_aligned)
    predicted = _at_validation_points(mixed, split)
    harm = None
    # Updates that the user states may do harm, such as at a layer near to the depth.
    if network.tuned and prediction.updates and share_of_aligned < 1:
        without = _at_validation_points(prediction.aligned, split)
        error_without = split.error(without)
        error_with = split.error(predicted)
        if error_with > HARMFUL * error_without:
            harm = (error_without, error_with)
            predicted = without
            share_of_aligned = 1.0
    return replace(
        expert,
        at_validation=predicted,
        updated_at_validation=split.points.sample(prediction.updated),
        from_others=prediction,
        share_of_aligned=share_of_aligned,
        harm=harm,
    )


def _at_validation_points(dense: Tensor, split: ValidatedFrame) -> Tensor:
    """(M,) metres, 0 = unknown: a depth at the validation points, its residual propagated.

    Args:
        dense: (H, W) metres, 0 = unknown: the depth.
        split: The frame and its validation points; the residual is that at the other points.
    """
    field = ResidualField(dense, split.kept.points, split.kept.rgb)
    return field.depth(split.points.xy, kind=split.propagation)


def expert_of_user(
    network: OpenNetwork, split: ValidatedFrame, search: OutlierSearch, *, needs_trust: bool = False
) -> NetworkExpert:
    """Returns what a user's network predicts, as an expert; z of a strong network is not updated.

    A network of the image alone has a strength 0…1. The strength is 1 if, with its depth, the
    points predict each other far better than with a constant depth (`strength_of`). Between 0 and 1
    its depth is a mean of the one before and the one after the updates. z is updated also of a
    strong network if the user states the number of updates.

    Args:
        network: The network, open.
        split: The frame and its validation points.
        search: The frame without outliers, and what the network that found them predicts.
        needs_trust: Whether a network has no part in the result if `trust_in_image` is 0, so that
            updates of its z would be in vain.
    """
    prediction = search.by(network)
    unexplained = 1.0
    may_update = True
    lacks_trust = False
    # What a network of the image alone leaves unexplained without updates decides on them.
    if not network.takes_points:
        if prediction is None:
            prediction = network.refine(split.whole, updates=network.always_updated)
        unexplained = unexplained_by(prediction.aligned, split, search)
        # Updates that the user states are made without trust, too.
        is_stated = network.always_updated or network.tuned
        if needs_trust and not is_stated:
            may_update = trust_in_image(prediction.aligned, split.whole.points) > 0
        # A strong network gains nothing by updates, but a stated number of them is made.
        can_gain = network.always_updated or strength_of(unexplained) < 1
        updates_are_missing = (
            can_gain and not prediction.updates and network.is_updated(split.whole)
        )
        lacks_trust = updates_are_missing and not may_update
        if updates_are_missing and may_update:
            prediction = network.refine(split.whole)
    expert = expert_of(
        network,
        split,
        network.name,
        prediction=prediction,
        user=network,
        updates=may_update,
        unexplained=unexplained,
    )
    return replace(expert, lacks_trust=lacks_trust)


def _mix_with_aligned(prediction: Prediction, share_of_aligned: float) -> Tensor:
    """(H, W) metres, 0 = unknown: the weighted mean of a network's aligned and its updated depth.

    The steps of the updates are large against the error of a strong network, which they make worse.

    Args:
        prediction: What the network gives.
        share_of_aligned: Weight 0…1 of the aligned depth; the updated one has the rest.
    """
    if not prediction.updates or share_of_aligned <= 0:
        return prediction.updated  # without updates both depths are one
    return weighted_mean(
        [(prediction.updated, 1 - share_of_aligned), (prediction.aligned, share_of_aligned)]
    )


def networks_alone(
    networks: Sequence[OpenNetwork], split: ValidatedFrame, search: OutlierSearch
) -> Experts:
    """Returns the predictions of the user's networks as the only experts, of equal prior weights.

    Args:
        networks: The networks, open.
        split: The frame and its validation points.
        search: The frame without outliers, and what the network that found them predicts.

    Raises:
        PnpDepthError: A network gives no depth.
    """
    of_users = [
        replace(expert_of_user(network, split, search), weight=1 / len(networks))
        for network in networks
    ]
    return Experts(first_of_user=of_users[0], without_prior=None, every=[*of_users])


def fused_experts(
    networks: Sequence[OpenNetwork],
    fusing: OpenNetwork,
    split: ValidatedFrame,
    search: OutlierSearch,
) -> Experts:
    """Returns the experts of a frame: what predicts it, each with a prior weight.

    They are the user's networks, a network that takes a prior with each one's depth and without,
    linear interpolation, and, where the image is in doubt, that network with a grey image.

    Args:
        networks: The networks, open, the user's first.
        fusing: The one of them that takes a prior.
        split: The frame and its validation points.
        search: The frame without outliers, and what the network that found them predicts.

    Raises:
        PnpDepthError: A network gives no depth.
    """
    # The user's networks predict.
    users = [network for network in networks if network is not fusing]
    of_users = [expert_of_user(network, split, search, needs_trust=True) for network in users]
    # The network that takes a prior predicts without one.
    without_prior = expert_of(fusing, split, fusing.name, prediction=search.by(fusing))
    # Each one's depth is its prior in turn. Several networks share the prior weights by the inverse
    # square of what their depth leaves unexplained.
    with_prior: list[NetworkExpert] = []
    merits = [max(expert.unexplained, LEAST_UNEXPLAINED) ** -2 for expert in of_users]
    for number, (user, expert) in enumerate(zip(users, of_users, strict=True)):
        share = trust(user, expert, split, without_prior) * merits[number] / sum(merits)
        weight = (OF_NETWORK + (OF_STRONG_NETWORK - OF_NETWORK) * expert.strength) * share
        # A network that takes points has no weight here on scan lines: `fuse.shares_on_lines` gives
        # it one beside the fused depth.
        of_users[number] = replace(expert, weight=0.0 if expert.of_scanner else weight)
        if share > 0:
            name = f"{fusing.name} with {expert.name}"
            prior_expert = expert_of(fusing, split, name, prior=expert, user=user, updates=False)
            with_prior.append(replace(prior_expert, weight=WITH_PRIOR * share))
    # What is left of the prior weights is that of the network without a prior.
    left = 1 - sum(expert.weight for expert in (*of_users, *with_prior))
    without_prior = replace(without_prior, weight=left)
    experts = Experts(
        first_of_user=of_users[0] if of_users else without_prior,
        without_prior=without_prior if of_users else None,
        every=[*of_users, *with_prior, without_prior, _interpolation(split)],
    )
    # Where the image does not help, what the network that takes a prior predicts without it joins.
    return _with_blind_expert(fusing, split, experts)


def _interpolation(split: ValidatedFrame) -> Expert:
    """Linear interpolation as an expert.

    Its dense depth takes long, so it is computed where it is first asked for (`Expert.dense`).
    """
    predicted = split.points.depth[:0]  # without validation points
    if len(split.points):
        predicted = linear(split.kept.points, split.points.xy)
    return Expert(
        name=LINEAR,
        weight=WITHOUT_IMAGE,
        at_validation=predicted,
        updated_at_validation=predicted,
        points=split.whole.points,
    )


def trust(
    network: OpenNetwork, expert: NetworkExpert, split: ValidatedFrame, without_prior: NetworkExpert
) -> float:
    """Returns 0…1, the fraction of its prior weights that a user's network gets.

    They are the weights of its own depth, and of the depth that has it as a prior, before the
    validation points change them.

    A network that takes the points has seen them. It has all of the prior weights if its error at
    the validation points, the residual not propagated, is that of `without_prior`, and none if it
    is twice that. Without validation points it has none. A network of the image alone has what
    `trust_in_image` says.

    Args:
        network: The network, open.
        expert: The network's own depth.
        split: The frame and its validation points.
        without_prior: What the network that takes a prior predicts without one.
    """
    if not network.takes_points:
        return trust_in_image(expert.from_all.aligned, split.whole.points)
    # A network that takes the points: by its error beside that of `without_prior`.
    if not len(split.points):
        return 0.0  # nothing that it has not seen tells its error
    error = split.error(expert.updated_at_validation)
    ratio = error / max(split.error(without_prior.at_validation), LEAST_ERROR)
    return min(1.0, max(0.0, 2.0 - ratio))  # 1 up to an equal error, 0 from twice that on


def _with_blind_expert(fusing: OpenNetwork, split: ValidatedFrame, experts: Experts) -> Experts:
    """The experts, joined by one that sees a grey image where the image is in doubt.

    The image is in doubt where `fusing` does not predict the validation points clearly better than
    linear interpolation does. There is a warning where the mean of its gains over
    interpolation and over the grey image is small.

    Args:
        fusing: The network that takes a prior, open.
        split: The frame and its validation points.
        experts: The experts, with those of `fusing` without a prior and of linear interpolation.
    """
    rgb = split.whole.rgb
    count = len(split.points)
    if rgb is None or split.whole.one_view or count < ENOUGH_FOR_DOUBT:
        return experts  # no image, one stated to be of the points' view, or too few points to tell
    by_name = {expert.name: expert.at_validation for expert in experts.every}
    with_image = by_name[fusing.name]
    interpolated = by_name[LINEAR]
    gain_over_linear = split.gain(with_image, interpolated)
    if gain_over_linear >= DOUBT:
        return experts
    # The image is in doubt: a grey one takes its place. What the network keeps of an image is
    # forgotten before and after.
    fusing.next_image()
    grey = torch.full_like(rgb, 0.5)
    without_image = replace(
        split, whole=replace(split.whole, rgb=grey), kept=replace(split.kept, rgb=grey)
    )
    name = f"{fusing.name} without the image"
    blind = expert_of(fusing, without_image, name, updates=False)
    fusing.next_image()
    every = [*experts.every, replace(blind, weight=WITHOUT_IMAGE, frame=None)]
    # The image helps if it beats interpolation and the grey image, in the mean of both gains.
    gain_over_grey = split.gain(with_image, blind.at_validation)
    if (gain_over_linear + gain_over_grey) / 2 >= NO_GAIN:
        return experts._replace(every=every)
    least_error = min(split.error(interpolated), split.error(blind.at_validation))
    warning = (
        f"warning: the image does not lower the error: at {count:,} validation points it is"
        f" {split.error(with_image):.4f} with the image and {least_error:.4f} without it; check"
        " the registration"
    )
    return experts._replace(every=every, warnings=(warning,))


def with_mirrored(fusing: OpenNetwork, experts: Experts, weights: Mapping[str, float]) -> Experts:
    """Returns the experts, those of `fusing` with their depth of the mirrored frame, too.

    The mean of both depths is better with few points, fewer than `MIRRORED_BELOW`. An expert
    without weight in the fused depth does not need it.

    Args:
        fusing: The network that takes a prior, open.
        experts: The experts.
        weights: Their weights in the fused depth, by name.
    """
    fusing.next_image()  # all these experts share what is computed for the mirrored image
    every: list[Expert] = []
    for expert in experts.every:
        if isinstance(expert, NetworkExpert) and weights[expert.name] > 0:
            frame = expert.frame
            if frame is not None and len(frame.points) < MIRRORED_BELOW:
                prediction = fusing.refine(frame.mirrored(), updates=frame.prior is None)
                depth = _mix_with_aligned(prediction, expert.share_of_aligned)
                expert = replace(expert, mirrored=depth.flip(-1))  # turned back
        every.append(expert)
    return experts.replaced(every)


def weighted_mean(depths: Sequence[tuple[Tensor, float]]) -> Tensor:
    """Returns the weighted geometric mean of depths, metres, of their shape; 0 is unknown.

    Args:
        depths: Depths in metres, all of one shape, and their weights, of which one is above 0. A
            depth has no weight where it is unknown (0).
    """
    weighted = [(depth, weight) for depth, weight in depths if weight > 0]
    if len(weighted) == 1:
        return weighted[0][0]  # itself, without rounding by logarithm and exponential
    logarithm = torch.zeros_like(weighted[0][0])
    total = torch.zeros_like(logarithm)
    for depth, weight in weighted:
        weight_if_known = (depth > 0) * weight
        logarithm += weight_if_known * depth.clamp_min(torch.finfo(depth.dtype).tiny).log()
        total += weight_if_known
    return torch.where(total > 0, (logarithm / total.clamp_min(LEAST_WEIGHT)).exp(), 0.0)
