"""The experts of a frame: what predicts it from its points, and with which prior weight.

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
from pnpdepth_cli.frames.strength import Judged, strength_of, trust_in_image, unexplained_by
from pnpdepth_cli.frames.validation import ValidatedFrame
from pnpdepth_cli.measures import LINEAR
from pnpdepth_cli.points import SparsePoints

# Prior weights were chosen on 7-Scenes, ICL-NUIM, NYU, RealSense, rendered rooms and streets with
# each set left out in turn (docs/notes/fusion.md). What a network is worth is in `strength`.
OWN = 0.15
"""Prior weight of a network that explains the points."""
OWN_STRONG = 0.5
"""The same of a strong network."""
LEAST_UNEXPLAINED = 0.02
"""Least part that a network leaves unexplained (`strength.unexplained_by`). Several networks share
the prior weights by its inverse square."""
HARMFUL = 1.05
"""Error at the validation points with updates of z, over that without, from which on updates that
the user states are not used."""
WITH_PRIOR = 0.45
"""Prior weight of `compact` with that network's depth as a prior. Without one it has the rest."""
WITHOUT_IMAGE = 0.05
"""Prior weight of every expert that leaves the image out."""
DOUBT = 2.0
"""Standard errors by which the image lowers the error at the validation points, from which on no
expert that leaves the image out joins."""
NO_GAIN = 0.5
"""The same, below which there is a warning. With 500 points, 25 even frames with their own image
have at least 0.7, but 2 of 18 odd ones less than 0.5; 8 of 9 with another image at most 0.4."""
ENOUGH_FOR_DOUBT = 50
"""Fewer validation points do not tell an image that belongs to its points from another one."""


@dataclass(frozen=True, kw_only=True)
class Expert:
    """What predicts a frame from its points: linear interpolation, or a network."""

    name: str
    weight: float = 0.0  # prior weight; with 0 it has no part
    at: Tensor  # (M,) metres, 0 = unknown: at the validation points, from the others
    updated: Tensor  # (M,) the same, the residual not propagated
    points: SparsePoints  # all points
    user: OpenNetwork | None = None  # the user's network whose depth it is, or has as a prior
    of_scanner: bool = False  # whether it is a completion network of the user's, given scan lines

    @functools.cached_property
    def dense(self) -> Tensor:
        """(H, W) metres, 0 = unknown: from all points, the residual not propagated."""
        return linear(self.points)


@dataclass(frozen=True, kw_only=True)
class NetworkExpert(Expert):
    """A network that predicts the frame, perhaps with another network's depth as a prior."""

    whole: Prediction  # from all points
    kept: Prediction  # from the others; the same as `whole` without validation
    frame: Frame | None = None  # what it is shown mirrored, too. None: it sees one frame
    mirrored: Tensor | None = None  # (H, W): its depth of the mirrored frame, turned back
    unexplained: float = 1.0  # what a network that takes the image alone leaves: `unexplained_by`
    not_updated: float = 0.0  # 0…1, the part that the aligned depth has beside the updated one
    untrusted: bool = False  # whether z is not updated only because of missing trust
    harm: tuple[float, float] | None = None
    """Errors in metres at the validation points without and with updates of z, if these are not
    used because of them."""

    @property
    def strength(self) -> float:
        """0…1, how strong the network is."""
        return strength_of(self.unexplained)

    @functools.cached_property
    def dense(self) -> Tensor:
        """(H, W) metres, 0 = unknown: from all points, the residual not propagated."""
        if self.mirrored is None:
            return _mix_with_aligned(self.whole, self.not_updated)
        return weighted_mean([(self.whole.updated, 1), (self.mirrored, 1)])


class Experts(NamedTuple):
    """The experts of a frame, and what stands out among them."""

    own: NetworkExpert
    """The user's first network."""
    alone: NetworkExpert | None
    """The network that takes a prior, without one. None: there is none beside the user's."""
    every: list[Expert]
    """All of them, the user's networks first."""
    warnings: tuple[str, ...] = ()

    @property
    def of_users(self) -> list[NetworkExpert]:
        """The user's networks, each with its own depth."""
        return [
            expert
            for expert in self.every
            if isinstance(expert, NetworkExpert)
            and expert.user is not None
            and expert.user.name == expert.name
        ]

    def replaced(self, changed: Sequence[Expert]) -> Experts:
        """Returns these experts after a step that changed some of them, all in the same order."""
        by_name = {expert.name: expert for expert in changed if isinstance(expert, NetworkExpert)}
        alone = None if self.alone is None else by_name[self.alone.name]
        return self._replace(own=by_name[self.own.name], alone=alone, every=list(changed))


def expert_of(
    network: OpenNetwork,
    split: ValidatedFrame,
    name: str,
    *,
    known: Prediction | None = None,
    prior: NetworkExpert | None = None,
    user: OpenNetwork | None = None,
    updates: bool = True,
    unexplained: float = 1.0,
) -> NetworkExpert:
    """Returns the predictions of one network, without a prior weight yet.

    Args:
        network: The network, open.
        split: The frame and its validation points.
        name: Name of the expert.
        known: Prediction from all points, if there is one already.
        prior: Expert whose depth the network is given.
        user: The user's network whose depth it is, or has as a prior.
        updates: Whether z may be updated.
        unexplained: What the network leaves unexplained, see `unexplained_by`.
    """
    whole = split.whole
    kept = split.kept
    # A prior is given with all points, and made from the others where the others are used.
    if prior is not None:
        whole = replace(whole, prior=prior.whole.aligned)
        kept = replace(kept, prior=prior.kept.aligned)
    # The network predicts from all points, and the validation points from the others.
    of_whole = known or network.refine(whole, updates=updates)
    of_kept = of_whole
    is_updated = network.settings.iterations > 0  # a depth map is not: it has no z
    not_updated = strength_of(unexplained) if is_updated and not network.always_updated else 0.0
    at = updated = split.points.depth
    harm = None
    if len(split.points):
        again = network.tuned or network.always_updated or not network.takes_points
        of_kept = network.refine(kept, updates=updates and again and not_updated < 1)
        at = _at_validation_points(_mix_with_aligned(of_kept, not_updated), split, kept)
        updated = split.points.sample(of_kept.updated)
        # Updates that the user states may do harm, such as at a layer near to the depth.
        if network.tuned and of_kept.updates and not_updated < 1:
            without = _at_validation_points(of_kept.aligned, split, kept)
            error_without = split.error(without)
            error_with = split.error(at)
            if error_with > HARMFUL * error_without:
                harm = (error_without, error_with)
                at = without
                not_updated = 1.0
    return NetworkExpert(
        name=name,
        at=at,
        updated=updated,
        points=whole.points,
        whole=of_whole,
        kept=of_kept,
        user=user,
        frame=whole if network.takes_prior else None,
        of_scanner=user is network and network.takes_points and split.has_scan_lines,
        unexplained=unexplained,
        not_updated=not_updated,
        harm=harm,
    )


def _at_validation_points(dense: Tensor, split: ValidatedFrame, kept: Frame) -> Tensor:
    """(M,) a depth (H, W) at the validation points, its residual at the others propagated."""
    field = ResidualField(dense, kept.points, kept.rgb)
    return field.depth(split.points.xy, kind=split.propagation)


def expert_of_user(
    network: OpenNetwork, split: ValidatedFrame, judged: Judged, *, needs_trust: bool = False
) -> NetworkExpert:
    """Returns the expert of a user's network, z updated as far as the network is not strong.

    Args:
        network: The network, open.
        split: The frame and its validation points.
        judged: How its outliers were told.
        needs_trust: Whether only what `trust` trusts gets into the result.
    """
    whole = judged.by(network)
    unexplained = 1.0
    updates = True
    untrusted = False
    # What its depth without updates leaves unexplained decides whether z is updated.
    if not network.takes_points:
        whole = whole or network.refine(split.whole, updates=network.always_updated)
        unexplained = unexplained_by(whole.aligned, split, judged)
        # Without trust, which is in the aligned depth, updates would not reach the result.
        stated = network.always_updated or network.tuned
        if needs_trust and not stated:
            updates = trust_in_image(whole.aligned, split.whole.points) > 0
        gains = network.always_updated or strength_of(unexplained) < 1
        wanted = gains and not whole.updates and network.is_updated(split.whole)
        untrusted = wanted and not updates
        if wanted and updates:
            whole = network.refine(split.whole)
    expert = expert_of(
        network,
        split,
        network.name,
        known=whole,
        user=network,
        updates=updates,
        unexplained=unexplained,
    )
    return replace(expert, untrusted=untrusted)


def _mix_with_aligned(prediction: Prediction, not_updated: float) -> Tensor:
    """The mean (H, W) of updated and aligned depth, the latter of which has this part.

    The steps of the updates are large against the error of a strong network, which they make worse.
    """
    if not prediction.updates or not_updated <= 0:
        return prediction.updated
    return weighted_mean([(prediction.updated, 1 - not_updated), (prediction.aligned, not_updated)])


def networks_alone(
    networks: Sequence[OpenNetwork], split: ValidatedFrame, judged: Judged
) -> Experts:
    """Returns the user's networks as the experts, with equal prior weights.

    Args:
        networks: The networks, open.
        split: The frame and its validation points.
        judged: How its outliers were told.

    Raises:
        PnpDepthError: A network gives no depth.
    """
    own = [
        replace(expert_of_user(network, split, judged), weight=1 / len(networks))
        for network in networks
    ]
    return Experts(own=own[0], alone=None, every=[*own])


def fused_experts(
    networks: Sequence[OpenNetwork],
    fusing: OpenNetwork,
    split: ValidatedFrame,
    judged: Judged,
) -> Experts:
    """Returns the user's networks and what a network that takes a prior makes of them.

    Args:
        networks: The networks, open, the user's first.
        fusing: The one of them that takes a prior.
        split: The frame and its validation points.
        judged: How its outliers were told.

    Raises:
        PnpDepthError: A network gives no depth.
    """
    # The user's networks predict.
    users = [network for network in networks if network is not fusing]
    own = [expert_of_user(network, split, judged, needs_trust=True) for network in users]
    # The network that takes a prior predicts without one.
    alone = expert_of(fusing, split, fusing.name, known=judged.by(fusing))
    # Each one's depth is its prior in turn; the prior weights follow what the depth explains.
    with_prior: list[NetworkExpert] = []
    merits = [max(expert.unexplained, LEAST_UNEXPLAINED) ** -2 for expert in own]
    for number, (user, expert) in enumerate(zip(users, own, strict=True)):
        share = trust(user, expert, split, alone) * merits[number] / sum(merits)
        weight = (OWN + (OWN_STRONG - OWN) * expert.strength) * share
        own[number] = replace(expert, weight=0.0 if expert.of_scanner else weight)
        if share > 0:
            name = f"{fusing.name} with {expert.name}"
            both = expert_of(fusing, split, name, prior=expert, user=user, updates=False)
            with_prior.append(replace(both, weight=WITH_PRIOR * share))
    # The rest of the prior weights is that of the network without a prior.
    rest = 1 - sum(expert.weight for expert in (*own, *with_prior))
    alone = replace(alone, weight=rest)
    # Linear interpolation predicts; its dense depth, which takes long, only where it has a part.
    at = split.points.depth
    if len(split.points):
        at = linear(split.kept.points, split.points.xy)
    interpolation = Expert(
        name=LINEAR, weight=WITHOUT_IMAGE, at=at, updated=at, points=split.whole.points
    )
    experts = Experts(
        own=own[0] if own else alone,
        alone=alone if own else None,
        every=[*own, *with_prior, alone, interpolation],
    )
    # Where the image does not help, an expert that does not see it joins.
    return _with_blind_expert(fusing, split, experts)


def trust(
    network: OpenNetwork, expert: NetworkExpert, split: ValidatedFrame, alone: NetworkExpert
) -> float:
    """Returns 0…1, the part of its prior weights that a network gets, by what it explains.

    A network that takes the points has seen them. It has all of the prior weights if its error at
    the validation points is that of `alone`, and none if it is twice that. Another one has what
    `trust_in_image` says.

    Args:
        network: The network, open.
        expert: The network's own depth.
        split: The frame and its validation points.
        alone: The network that takes a prior, without one.
    """
    if not network.takes_points:
        return trust_in_image(expert.whole.aligned, split.whole.points)
    # A network that takes the points: by its error beside that of `alone`.
    if not len(split.points):
        return 0.0
    ratio = split.error(expert.updated) / max(split.error(alone.at), 1e-9)
    return min(1.0, max(0.0, 2.0 - ratio))


def _with_blind_expert(fusing: OpenNetwork, split: ValidatedFrame, experts: Experts) -> Experts:
    """The experts, joined by one that sees a grey image where the image is in doubt.

    There is a warning where the image does not lower the error at validation points.
    """
    rgb = split.whole.rgb
    count = len(split.points)
    if rgb is None or split.whole.one_view or count < ENOUGH_FOR_DOUBT:
        return experts
    by_name = {expert.name: expert.at for expert in experts.every}
    at = by_name[fusing.name]
    interpolated = by_name[LINEAR]
    of_linear = split.gain(at, interpolated)
    if of_linear >= DOUBT:
        return experts
    # The image is in doubt: a grey one takes its place.
    fusing.next_image()
    grey = torch.full_like(rgb, 0.5)
    blind = replace(split, whole=replace(split.whole, rgb=grey), kept=replace(split.kept, rgb=grey))
    expert = expert_of(fusing, blind, f"{fusing.name} without the image", updates=False)
    fusing.next_image()
    every = [*experts.every, replace(expert, weight=WITHOUT_IMAGE, frame=None)]
    # It helps nothing if the grey one does as well.
    if (of_linear + split.gain(at, expert.at)) / 2 >= NO_GAIN:
        return experts._replace(every=every)
    without = min(split.error(interpolated), split.error(expert.at))
    warning = (
        f"warning: the image does not lower the error: at {count:,} validation points it is"
        f" {split.error(at):.4f} with the image and {without:.4f} without it; check"
        " the registration"
    )
    return experts._replace(every=every, warnings=(warning,))


def with_mirrored(fusing: OpenNetwork, experts: Experts, weights: Mapping[str, float]) -> Experts:
    """Returns the experts; of few points, those of the network that takes a prior see two frames.

    The second is the mirrored frame. An expert without weight does not need it.
    """
    fusing.next_image()  # all these experts share what is computed for the mirrored image
    every: list[Expert] = []
    for expert in experts.every:
        if isinstance(expert, NetworkExpert) and weights[expert.name] > 0:
            frame = expert.frame
            if frame is not None and len(frame.points) < MIRRORED_BELOW:
                turned = fusing.refine(frame.mirrored(), updates=frame.prior is None)
                expert = replace(expert, mirrored=turned.updated.flip(-1))
        every.append(expert)
    return experts.replaced(every)


def weighted_mean(depths: Sequence[tuple[Tensor, float]]) -> Tensor:
    """Returns the weighted geometric mean (…) of depths (…) in metres; 0 is unknown.

    Args:
        depths: Depths of one shape and their weights. A depth has no weight where it is unknown.
    """
    depths = [(depth, weight) for depth, weight in depths if weight > 0]
    if len(depths) == 1:
        return depths[0][0]
    logarithm = torch.zeros_like(depths[0][0])
    total = torch.zeros_like(logarithm)
    for depth, weight in depths:
        known = (depth > 0) * weight
        logarithm += known * depth.clamp_min(torch.finfo(depth.dtype).tiny).log()
        total += known
    return torch.where(total > 0, (logarithm / total.clamp_min(1e-6)).exp(), 0.0)
