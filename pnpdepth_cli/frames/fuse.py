"""The experts of the default method, and the one rule that fuses and checks them.

1. The user's networks predict, aligned with the points, z updated.
2. `compact` predicts with each one's depth as a prior, and without.
3. Linear interpolation predicts; and, where the image is in doubt, `compact` with a grey image.
4. Their weights predict the validation points best, close to prior weights.

All predict twice: from all points, and the validation points from the others.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.completion.folds import spatial_folds
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.outliers import inlier_weights
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.frames.frame import Frame, Prediction, ValidationPoints, is_dense
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.scan_pattern import scan_pattern
from pnpdepth_cli.stages import LINEAR

# Prior weights and the strength were chosen on 7-Scenes, ICL-NUIM, NYU, RealSense, rendered rooms
# and streets with each set left out in turn (docs/notes/fusion.md).
OWN, WITH_PRIOR, WITHOUT_IMAGE = 0.15, 0.45, 0.05
"""Prior weights: of a network that explains the points, of `compact` with its depth as a prior, and
of every expert that leaves the image out. `compact` without a prior has the rest."""
USELESS, USEFUL = 0.25, 0.75
"""Fractions of the variance of log depth that a network explains at points that its alignment was
not fitted to. Up to the first it has no prior weight, from the second all of it. A network of
random weights has less than 0.25 in 86 % of the runs with 20 points, 97 % with more."""
STRENGTH = 60.0
"""Validation points that the prior weights count as."""
FOLDS = 5
"""One of so many folds of the points is for validation. By convention; not tuned."""
MIN_POINTS = 5
"""With fewer points none is for validation: a fold would have less than one."""
MOST_VALIDATION_POINTS = 1000
"""Of more validation points, so many at random are predicted. It bounds the time of a LiDAR's."""
DOUBT, NO_GAIN = 2.0, 0.5
"""Standard errors by which the image lowers the error at the validation points. From the first on,
no expert that leaves the image out joins; below the second there is a warning. With 500 points, 25
even frames with their own image have at least 0.7, but 2 of 18 odd ones less than 0.5; 8 of 9 with
another image have at most 0.4."""
ENOUGH_FOR_DOUBT = 50
"""Fewer validation points do not tell an image that belongs to its points from another one."""
OWN_SCANNER = 0.75
"""Weight of a completion network on scan lines. Validation points cannot judge it: the lines that
they leave are gaps that its scanner does not leave. On even KITTI frames this changes its MAE by
−0.9 (pncnn) and −2.8 % (nconv)."""
FEW_POINTS = 50
"""With fewer points, updates of a network that takes them gain nothing: on even frames 2 to 3 %
with 500 points, 1 % with 100, nothing with 20. A point that contradicts its neighbours may then be
all that is seen of a small object."""
MIRRORED_BELOW = 200
"""With fewer points, the network that takes a prior is not updated, but sees the mirrored frame
too, in the same time (docs/notes/fusion.md)."""
LEAST_PART = 0.01
"""A network with less weight has no part in the result, which is said."""


@dataclass(frozen=True, kw_only=True)
class ValidatedFrame(ValidationPoints):
    """A frame with all its inliers, and without its validation points."""

    whole: Frame
    kept: Frame

    @functools.cached_property
    def has_scan_lines(self) -> bool:
        """Whether the points are those of a scanner."""
        points = self.whole.points
        return scan_pattern(points.xy, points.size) is not None

    @property
    def propagation(self) -> str:
        """How the residual at the points is propagated, a name in `choices.PROPAGATIONS`.

        It is "local" for scan lines: on even KITTI frames its MAE is 1.9 % and its RMSE 1.7 % below
        those of "gp". With points at random pixels, "gp" is 0 to 28 % below "local".
        """
        return "local" if self.has_scan_lines else "gp"

    def gain(self, at: Tensor, other: Tensor) -> float:
        """Returns by how many standard errors one prediction (M,) is better than another.

        In log depth; negative where it is worse.
        """
        truth, share = _log(self.points.depth), self.weights / self.weights.sum()
        gain = (_log(other) - truth).abs() - (_log(at) - truth).abs()
        mean = (share * gain).sum()
        error = (share.square() * (gain - mean).square()).sum().sqrt()
        return float(mean / error.clamp_min(1e-12))


def split_frame(frame: Frame, judged: Tensor, seed: int) -> ValidatedFrame:
    """Returns the frame with and without its validation points; a frame of few points has none.

    Args:
        frame: The frame without its outliers.
        judged: (H, W) metres, a prediction beside which neighbours should agree. Outliers among the
            validation points would decide the weights.
        seed: Random seed of the validation points.
    """
    points = frame.points
    chosen = torch.zeros(len(points), dtype=torch.bool)
    if len(points) >= MIN_POINTS:
        chosen = spatial_folds(points, FOLDS, seed=seed) == 0
    if not bool(chosen.any()) or bool(chosen.all()):
        none = points.select(slice(0))
        return ValidatedFrame(whole=frame, kept=frame, points=none, weights=none.depth)
    # Of many validation points some are drawn; all of them are kept from the experts.
    (numbers,) = chosen.nonzero(as_tuple=True)
    drawn = torch.randperm(len(numbers), generator=torch.Generator().manual_seed(seed))
    validation = points.select(numbers[drawn[:MOST_VALIDATION_POINTS]])
    # Each counts as much as it is consistent with its neighbours.
    at = validation.sample(judged)
    residual = validation.depth.double().log() - at.clamp_min(1e-6).double().log()
    weights = torch.where(at > 0, inlier_weights(validation, residual), 0.0).float()
    weights = weights if bool(weights.any()) else torch.ones_like(weights)
    kept = replace(frame, points=points.select(~chosen))
    return ValidatedFrame(whole=frame, kept=kept, points=validation, weights=weights)


@dataclass(frozen=True, kw_only=True)
class Expert:
    """One prediction of the frame, by two sets of points."""

    name: str
    weight: float = 0.0  # prior weight; with 0 it has no part
    at: Tensor  # (M,) metres, 0 = unknown: at the validation points, from the others
    updated: Tensor  # (M,) the same, the residual not propagated
    whole: Prediction | None = None  # from all points. None: linear interpolation
    kept: Prediction | None = None  # from the others; the same as `whole` without validation
    user: OpenNetwork | None = None  # the user's network whose depth it is, or has as a prior
    frame: Frame | None = None  # what was given to a network that takes a prior
    mirrored: Tensor | None = None  # (H, W): its depth of the mirrored frame, turned back
    of_scanner: bool = False  # whether it is a completion network of the user's, given scan lines

    def dense(self, split: ValidatedFrame) -> Tensor:
        """Returns (H, W) metres, 0 = unknown: from all points, the residual not propagated."""
        if self.whole is None:
            return linear(split.whole.points)
        depth = self.whole.after
        return depth if self.mirrored is None else weighted_mean([(depth, 1), (self.mirrored, 1)])


def predictions(
    networks: Sequence[OpenNetwork], split: ValidatedFrame, known: Mapping[OpenNetwork, Prediction]
) -> list[Expert]:
    """Returns the experts, the user's network first.

    Without a network that takes a prior, the networks are the experts, with equal prior weights.

    Args:
        networks: The networks, open, the user's first.
        split: The frame and its validation points.
        known: What networks gave for all points already.

    Raises:
        PnpDepthError: A network gives no depth.
    """
    # The user's networks predict.
    fusing = fusing_network(networks)
    users = [each for each in networks if each is not fusing]
    own = [_expert(each, split, each.name, known=known.get(each), user=each) for each in users]
    # Without a network that takes a prior, they are all.
    if fusing is None:
        return [replace(expert, weight=1 / len(own)) for expert in own]
    # That network predicts without a prior.
    alone = _expert(fusing, split, fusing.name, known=known.get(fusing))
    # Each one's depth is its prior in turn; the prior weights follow what the depth explains.
    with_prior = list[Expert]()
    for number, (user, expert) in enumerate(zip(users, own, strict=True)):
        share = trust(user, expert, split, alone) / len(own)
        own[number] = replace(expert, weight=0.0 if expert.of_scanner else OWN * share)
        if share > 0:
            name = f"{fusing.name} with {expert.name}"
            both = _expert(fusing, split, name, prior=expert, user=user, updates=False)
            with_prior.append(replace(both, weight=WITH_PRIOR * share))
    # The rest of the prior weights is that of the network without a prior.
    rest = 1 - sum(expert.weight for expert in (*own, *with_prior))
    # Linear interpolation predicts; its dense depth, which takes long, only where it has a part.
    at = linear(split.kept.points, split.points.xy) if len(split.points) else split.points.depth
    interpolation = Expert(name=LINEAR, weight=WITHOUT_IMAGE, at=at, updated=at)
    return [*own, *with_prior, replace(alone, weight=rest), interpolation]


def trust(network: OpenNetwork, expert: Expert, split: ValidatedFrame, alone: Expert) -> float:
    """Returns 0…1, the part of its prior weights that a network gets, by what it explains.

    The aligned depth of a network that takes the image alone explains a fraction of the variance of
    log depth. The fraction is 1 − PRESS / SS, by a line through the other points (Allen, "The
    relationship between variable selection and data augmentation and a method for prediction",
    1974).

    A network that takes the points has seen them. It has all of the prior weights if its error at
    the validation points is that of `alone`, and none if it is twice that.

    Args:
        expert: The network's own depth.
        split: The frame and its validation points.
        alone: The network that takes a prior, without one.
    """
    if network.takes_points:
        if not len(split.points):
            return 0.0
        ratio = split.error(expert.updated) / max(split.error(alone.at), 1e-9)
        return min(1.0, max(0.0, 2.0 - ratio))
    assert expert.whole is not None
    points = split.whole.points
    at = points.sample(expert.whole.before).double()
    x, y = _log(at[at > 0]), _log(points.depth[at > 0].double())
    if len(x) < MIN_POINTS:
        return 0.0
    x, y, count = x - x.mean(), y - y.mean(), len(x)
    slope = (x @ y) / (x @ x).clamp_min(1e-12)
    left_out = (y - slope * x) / (1 - 1 / count - x.square() / (x @ x).clamp_min(1e-12))
    total = (y / (1 - 1 / count)).square().sum().clamp_min(1e-12)
    explained = float(1 - left_out.square().sum() / total) if slope > 0 else 0.0
    return min(1.0, max(0.0, (explained - USELESS) / (USEFUL - USELESS)))


def add_blind_expert(
    networks: Sequence[OpenNetwork], split: ValidatedFrame, experts: list[Expert]
) -> tuple[list[Expert], tuple[str, ...]]:
    """Returns the experts, joined by one that sees a grey image where the image is in doubt.

    The second value is a warning where the image does not lower the error at validation points.
    """
    fusing, rgb, count = fusing_network(networks), split.whole.rgb, len(split.points)
    if fusing is None or rgb is None or split.whole.one_view or count < ENOUGH_FOR_DOUBT:
        return experts, ()
    by_name = {each.name: each.at for each in experts}
    at, interpolated = by_name[fusing.name], by_name[LINEAR]
    of_linear = split.gain(at, interpolated)
    if of_linear >= DOUBT:
        return experts, ()
    # The image is in doubt: a grey one takes its place.
    for each in networks:
        each.next_image()
    grey = torch.full_like(rgb, 0.5)
    blind = replace(split, whole=replace(split.whole, rgb=grey), kept=replace(split.kept, rgb=grey))
    expert = _expert(fusing, blind, f"{fusing.name} without the image", updates=False)
    experts = [*experts, replace(expert, weight=WITHOUT_IMAGE, frame=None)]
    # It helps nothing if the grey one does as well.
    if (of_linear + split.gain(at, expert.at)) / 2 >= NO_GAIN:
        return experts, ()
    without = min(split.error(interpolated), split.error(expert.at))
    warning = (
        f"warning: the image does not lower the error: at {count:,} validation points it is"
        f" {split.error(at):.4f} with the image and {without:.4f} without it; check"
        " the registration"
    )
    return experts, (warning,)


def fit_weights(
    experts: Sequence[Expert], split: ValidatedFrame, chosen: Tensor | None = None
) -> dict[str, float]:
    """Returns the weights of the experts by name, >= 0, their sum 1.

    They minimise the residuals of log depth at the validation points by Huber's loss, plus
    `STRENGTH` times the squared distance from the prior weights. An expert without prior weight has
    none. Where an expert predicts nothing, the others' mean stands for it.

    Args:
        experts: The experts.
        split: The frame and its validation points.
        chosen: (M,) bool, the validation points to fit. None: all.
    """
    from scipy.optimize import nnls

    having = [expert for expert in experts if expert.weight > 0]
    prior = np.array([expert.weight for expert in having])
    found = prior = prior / prior.sum()
    points = torch.ones(len(split.points), dtype=torch.bool) if chosen is None else chosen
    if len(having) > 1 and bool(points.any()):
        # Log predictions and log depths, relative to the prediction with the prior weights.
        at = torch.stack([expert.at for expert in having], dim=1)[points].double()
        centre = weighted_mean([(at[:, k], float(w)) for k, w in enumerate(prior)])[:, None]
        relative = torch.where(at > 0, _log(at) - _log(centre), 0.0)
        truth = _log(split.points.depth.double()[points]) - _log(centre[:, 0])
        offsets, residual, shares = (
            each.numpy() for each in (relative, truth, split.weights[points].double())
        )
        # Each pass weighs large residuals down, and solves for weights >= 0 whose sum is 1.
        scale = max(1.25 * float(np.average(np.abs(residual), weights=shares)), 1e-3)
        ridge = np.sqrt(STRENGTH) * scale
        for _ in range(5):
            size = np.abs(residual - offsets @ found)
            root = np.sqrt(shares * np.minimum(1, scale / np.maximum(size, 1e-9)))
            sum_of_one = np.full((1, len(prior)), 1e4)
            system = [offsets * root[:, None], ridge * np.eye(len(prior)), sum_of_one]
            right = [residual * root, ridge * prior, [1e4]]
            found = nnls(np.concatenate(system), np.concatenate(right))[0]
            found /= found.sum()
    by_name = dict.fromkeys((expert.name for expert in experts), 0.0)
    return by_name | {each.name: float(w) for each, w in zip(having, found, strict=True)}


def with_mirrored(
    networks: Sequence[OpenNetwork], experts: list[Expert], weights: Mapping[str, float]
) -> list[Expert]:
    """Returns the experts; of few points, those of the network that takes a prior see two frames.

    The second is the mirrored frame. An expert without weight does not need it.
    """
    fusing = fusing_network(networks)
    if fusing is None:
        return experts
    fusing.next_image()  # both experts share what is computed for the mirrored image
    both = list[Expert]()
    for expert in experts:
        frame = expert.frame
        if frame is not None and len(frame.points) < MIRRORED_BELOW and weights[expert.name] > 0:
            turned = predict(fusing, frame.mirrored(), updates=False).after.flip(-1)
            expert = replace(expert, mirrored=turned)
        both.append(expert)
    return both


def scanner_shares(
    experts: Sequence[Expert], split: ValidatedFrame, weights: Mapping[str, float]
) -> dict[str, float]:
    """Returns the weights of completion networks of the scanner, by name.

    A network has a weight if its error at the points, which it was given, is at most the error of
    the experts' mean at the validation points.
    """
    own = [each for each in experts if each.of_scanner and len(split.points)]
    if not own:
        return {}
    limit = split.error(weighted_mean([(each.at, weights[each.name]) for each in experts]))
    points = split.whole.points
    error = {e.name: (points.sample(e.dense(split)) - points.depth).abs().mean() for e in own}
    fit = [name for name in error if float(error[name]) <= limit]
    return {name: OWN_SCANNER / len(fit) for name in fit}


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


def predict(network: OpenNetwork, frame: Frame, *, updates: bool = True) -> Prediction:
    """Returns what one network gives for the frame, its residual not propagated.

    Args:
        network: The network, open.
        frame: The frame.
        updates: Whether z is updated, where that gains anything. With a LiDAR's points, updates of
            a network that takes them gain 1 % and take as long as everything else.
    """
    fewest = MIRRORED_BELOW if network.takes_prior else FEW_POINTS
    gains = len(frame.points) >= fewest and not is_dense(frame.points)
    return network.refine(frame, updates=updates and (gains or not network.takes_points))


def _expert(
    network: OpenNetwork,
    split: ValidatedFrame,
    name: str,
    *,
    known: Prediction | None = None,
    prior: Expert | None = None,
    user: OpenNetwork | None = None,
    updates: bool = True,
) -> Expert:
    """The predictions of one network, without a prior weight yet; see `Expert` for the arguments.

    `known` is its prediction from all points, if there is one. `prior` is whose depth it is given.
    """
    whole, kept, takes_points = split.whole, split.kept, network.takes_points
    # A prior is given with all points, and made from the others where the others are used.
    if prior is not None and prior.whole is not None and prior.kept is not None:
        whole = replace(whole, prior=prior.whole.before)
        kept = replace(kept, prior=prior.kept.before)
    # The network predicts from all points, and the validation points from the others.
    own = again = known or predict(network, whole, updates=updates)
    at = updated = split.points.depth
    if len(split.points):
        again = predict(network, kept, updates=not takes_points)
        xy, kind = split.points.xy, split.propagation
        at = propagate(again.after, kept.points, kept.rgb, xy, kind=kind)
        updated = split.points.sample(again.after)
    return Expert(
        name=name,
        at=at,
        updated=updated,
        whole=own,
        kept=again,
        user=user,
        frame=whole if network.takes_prior else None,
        of_scanner=user is network and takes_points and split.has_scan_lines,
    )


def fusing_network(networks: Sequence[OpenNetwork]) -> OpenNetwork | None:
    """Returns the network that takes another one's depth as a prior; None without one."""
    return next((each for each in networks if each.takes_prior), None)


def _log(depth: Tensor) -> Tensor:
    """The logarithm of depth in metres; unknown depth is that of a micrometre."""
    return depth.clamp_min(1e-6).log()
