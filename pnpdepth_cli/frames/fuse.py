"""The networks of the default method, refined with the points and fused.

1. Points that are inconsistent with their neighbours are set aside as outliers.
2. Every network's output is aligned with the points, and z is updated (`core.refine`).
3. A network that takes a prior, such as `compact`, is given each other network's aligned depth.
4. The depths are fused: a weighted geometric mean with fixed weights.

`frames.default` propagates the residual and checks the result at hidden points.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from pnpdepth_cli.completion.outliers import outliers
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Frame, Refined, is_dense
from pnpdepth_cli.frames.opened import OpenNetwork
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

FEW_POINTS = 50
"""With fewer points networks that take them are not updated, as it gains nothing, and their depth
without a prior is fused too: a prior aligned with so few points is uncertain."""
IMAGE_WEIGHT = 0.15
"""Weight of a network that takes the image alone, where another one takes the points."""
UNINFORMATIVE = 0.9
"""A network that takes the image alone has no say beside one that takes the points if, aligned, its
error at the points exceeds this fraction of that of their median depth. On even frames a network of
noise has 0.88 to 1.3 times that error with 20 points, FastDepth 0.7 or less in most frames."""
PRIOR_WEIGHT = 0.47
"""Share of the depths with a prior, where those without are fused too.

Chosen with three networks on 39 runs of 15 even frames of 7-Scenes, ICL-NUIM and KITTI.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Member:
    """A network of the default method."""

    network: Network
    layer: str  # layer to cut at
    settings: Settings  # how its output is aligned and z is updated

    @property
    def takes_points(self) -> bool:
        """Whether sparse depth is an input."""
        return "sparse" in self.network.definition.input_kind

    @property
    def takes_prior(self) -> bool:
        """Whether another network's depth is an input."""
        return self.network.definition.takes_prior


@dataclass(frozen=True, kw_only=True)
class Fused:
    """A frame refined by all networks and fused; the residual is not propagated."""

    alone: Mapping[Member, Refined]
    """What the networks give without another one's prior, the user's first."""
    before: Tensor  # (H, W) metres, 0 = unknown: fused before the updates of z
    after: Tensor  # (H, W) metres, 0 = unknown: fused after the updates of z
    weighed: Tensor | None
    """(H, W) metres, 0 = unknown: of the networks that weigh their points, before the updates."""

    @property
    def user(self) -> Refined:
        """What the user's network gives."""
        return next(iter(self.alone.values()))


class Fusion:
    """The networks of the default method, open from frame to frame, as a context manager.

    Args:
        members: The networks, the user's first.
    """

    def __init__(self, members: Sequence[Member]) -> None:
        self.members = tuple(members)
        self._opened = {member: OpenNetwork(member.network, member.layer) for member in members}
        self._stack = ExitStack()

    def __enter__(self) -> Fusion:
        for opened in self._opened.values():
            self._stack.enter_context(opened)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def completing(self) -> list[Member]:
        """Networks that take points and no prior, beside one that takes theirs as a prior."""
        if not any(member.takes_prior for member in self.members):
            return []
        return [m for m in self.members if m.takes_points and not m.takes_prior]

    def next_image(self) -> None:
        """Forgets what was computed for the last image."""
        for opened in self._opened.values():
            opened.next_image()

    def without_outliers(self, frame: Frame) -> tuple[Frame, Refined]:
        """Returns the frame with its outliers set aside, and what the user's network gives for it.

        Outliers are inconsistent with their neighbours beside what the user's network predicts from
        the other points. Of many points, those inconsistent with the points alone are outliers too;
        of a few, such a point may be all that is seen of a small object.

        Raises:
            PnpDepthError: The user's network gives no depth.
        """
        points, user = frame.points, self.members[0]
        suspected = outliers(torch.ones(points.size), points, frame.rgb)
        any_suspected = bool(suspected.any())
        consistent = frame.with_points(points.select(~suspected)) if any_suspected else frame
        # A network that weighs its points is given the outliers too, but not before they are known.
        again = any_suspected and user.network.definition.weighs_points
        refined = self._refined(user, consistent, updates=not again)
        outlying = outliers(torch.from_numpy(refined.before), points, frame.rgb)
        if len(points) >= FEW_POINTS:
            outlying = outlying | suspected
        inliers = frame.without(outlying)
        if again or not torch.equal(outlying, suspected):
            refined = self._refined(user, inliers)
        return inliers, refined

    def fuse(
        self,
        frame: Frame,
        *,
        user: Refined | None = None,
        rejected: Collection[Member] = (),
        updates: bool = True,
    ) -> Fused:
        """Returns the frame refined by all networks and fused.

        A further network that fails on the frame is left out.

        Args:
            frame: The frame, its outliers set aside.
            user: What the user's network gives for it, if that is known.
            rejected: Networks whose depth serves as no prior.
            updates: Whether z is updated.

        Raises:
            PnpDepthError: The user's network gives no depth.
        """
        first, *others = self.members
        if user is None:
            user = self._refined(first, frame, updates=updates)
        tried = partial(self._tried, updates=updates)
        alone = {first: user} | tried([m for m in others if not m.takes_prior], frame)
        guides = [m for m in alone if m not in rejected and _guides(m, alone[m])]
        if not guides or len(frame.points) < FEW_POINTS:
            alone |= tried([m for m in others if m.takes_prior], frame)
        guided = list[tuple[Member, Refined]]()
        for guide in guides:
            with_prior = replace(frame, prior=torch.from_numpy(alone[guide].before))
            takers = [m for m in self.members if m.takes_prior]
            guided += tried(takers, with_prior).items()
        parts = _weighted(alone, [refined for _, refined in guided])
        weighed = [
            (torch.from_numpy(refined.before), 1.0)
            for member, refined in (*alone.items(), *guided)
            if member.network.definition.weighs_points
        ]
        return Fused(
            alone=alone,
            before=weighted_mean([(torch.from_numpy(part.before), w) for part, w in parts]),
            after=weighted_mean([(torch.from_numpy(part.after), w) for part, w in parts]),
            weighed=weighted_mean(weighed) if weighed else None,
        )

    def refine_alone(self, member: Member, frame: Frame) -> Refined:
        """Returns the frame refined by one network without a prior and without updates of z."""
        return self._refined(member, frame, updates=False)

    def _tried(
        self, members: Sequence[Member], frame: Frame, *, updates: bool
    ) -> dict[Member, Refined]:
        """The frame refined by each of the networks, without those that fail."""
        refined: dict[Member, Refined] = {}
        for member in members:
            with suppress(PnpDepthError):
                refined[member] = self._refined(member, frame, updates=updates)
        return refined

    def _refined(self, member: Member, frame: Frame, *, updates: bool = True) -> Refined:
        settings = member.settings
        if not updates or (member.takes_points and not _updates_gain(frame.points)):
            settings = replace(settings, iterations=0)
        return self._opened[member].refine(frame, settings)


def weighted_mean(depths: Sequence[tuple[Tensor, float]]) -> Tensor:
    """Returns the weighted geometric mean (…) of depths (…) in metres; 0 is unknown.

    Args:
        depths: Depths of one shape and their weights. A depth has no weight where it is unknown.
    """
    if len(depths) == 1:
        return depths[0][0]
    logarithm = torch.zeros_like(depths[0][0])
    total = torch.zeros_like(logarithm)
    for depth, weight in depths:
        known = (depth > 0) * weight
        logarithm += known * depth.clamp_min(torch.finfo(depth.dtype).tiny).log()
        total += known
    return torch.where(total > 0, (logarithm / total.clamp_min(1e-6)).exp(), 0.0)


def _weighted(
    alone: Mapping[Member, Refined], guided: Sequence[Refined]
) -> list[tuple[Refined, float]]:
    """The depths to fuse, with weights whose sum is 1.

    A network that takes the points but no prior has its say as a prior. Where none takes a prior,
    all networks have the same weight.
    """
    unguided = [refined for member, refined in alone.items() if member.takes_prior]
    if not unguided and not guided:
        return [(refined, 1 / len(alone)) for refined in alone.values()]
    of_image = [
        refined
        for member, refined in alone.items()
        if not member.takes_points and _guides(member, refined)
    ]
    share = min(IMAGE_WEIGHT * len(of_image), 0.5)
    with_prior = PRIOR_WEIGHT if unguided and guided else float(bool(guided))
    groups = (
        (of_image, share),
        (unguided, (1 - share) * (1 - with_prior)),
        (guided, (1 - share) * with_prior),
    )
    return [(refined, weight / len(group)) for group, weight in groups for refined in group]


def _guides(member: Member, refined: Refined) -> bool:
    """Whether a network's depth is worth something to one that takes the points and a prior."""
    if member.takes_prior:
        return False
    log_depth = refined.used.depth.log()
    at_points = refined.used.sample(torch.from_numpy(refined.before)).clamp_min(1e-6).log()

    def error(predicted: Tensor) -> float:
        return float((predicted - log_depth).abs().clamp_max(1.0).mean())

    return member.takes_points or error(at_points) <= UNINFORMATIVE * error(log_depth.median())


def _updates_gain(points: SparsePoints) -> bool:
    """Whether updates of z lower the error of a network that takes the points already.

    On even frames they gain 2 to 3 % with 500 points, 1 % with 100 and nothing with 20. With a
    LiDAR's points they gain 1 % and take as long as everything else.
    """
    return len(points) >= FEW_POINTS and not is_dense(points)
