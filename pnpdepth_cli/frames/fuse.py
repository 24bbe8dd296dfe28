"""The experts of the default method, and the one rule that fuses and checks them.

1. The user's networks predict, aligned with the points, z updated.
2. `compact` predicts with each one's depth as a prior, and without.
3. Linear interpolation predicts; and, where the image is in doubt, `compact` with a grey image.
4. Their weights predict the validation points best, close to prior weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.propagation import propagate_at
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Frame, is_dense
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.refined import Prediction
from pnpdepth_cli.frames.validation import MIN_POINTS, ValidationSplit, log_depth
from pnpdepth_cli.stages import LINEAR

Floats = NDArray[np.float64]

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
DOUBT, NO_GAIN = 2.0, 0.5
"""Standard errors by which the image lowers the error at the validation points. From the first it
is not doubted, below the second there is a warning. With 500 points, 25 even frames with their own
image have at least 0.7, but 2 of 18 odd ones less than 0.5; 8 of 9 with another image have at most
0.4."""
ENOUGH_FOR_DOUBT = 50
"""Fewer validation points do not tell an image that belongs to its points from another one."""
OWN_SCANNER = 0.75
"""Weight of a completion network on scan lines. Validation points cannot judge it: the lines that
they leave are gaps that its scanner does not leave. On even KITTI frames this changes its MAE by
−0.9 (pncnn) and −2.8 % (nconv)."""
FEW_POINTS = 50
"""With fewer points, updates of a network that takes them gain nothing. A point that contradicts
its neighbours may then be all that is seen of a small object."""
LEAST_PART = 0.01
"""A network with less weight has no part in the result, which is said."""


@dataclass(frozen=True, kw_only=True)
class Expert:
    """One prediction of the frame, by two sets of points."""

    name: str
    weight: float  # prior weight; with 0 it has no part
    dense: Callable[[], Tensor]
    """(H, W) metres, 0 = unknown: from all points, the residual not propagated."""
    at: Tensor  # (M,) metres, 0 = unknown: at the validation points, from the others
    aligned: Tensor  # (H, W) metres: a network's, from the others, before updates
    updated: Tensor  # (M,) metres: `at` before the residual is propagated
    prediction: Prediction | None = None  # from all points. None without a network
    network: OpenNetwork | None = None  # that predicts. None: linear interpolation
    user: OpenNetwork | None = None  # the user's network whose depth it is, or has as a prior
    of_scanner: bool = False  # whether it is a completion network of the user's, given scan lines


def predictions(
    networks: Sequence[OpenNetwork], split: ValidationSplit, judged: Prediction
) -> list[Expert]:
    """Returns the experts, the user's network first.

    Without a network that takes a prior, the networks are the experts, with equal prior weights.

    Args:
        networks: The networks, open, the user's first.
        split: The frame and its validation points.
        judged: Prediction of the network that judged the outliers.

    Raises:
        PnpDepthError: The user's network gives no depth.
    """
    # The user's networks predict.
    fusing, judge = _fusing(networks), judge_of(networks)
    own = list[Expert]()
    for each in networks:
        try:
            if each is not fusing:
                known = judged if each is judge else None
                own.append(_expert(each, split, each.member.name, known=known, user=each))
        except PnpDepthError:  # a further network that fails is left out
            if each is networks[0]:
                raise
    # Without a network that takes a prior, they are all.
    if fusing is None:
        return [replace(expert, weight=1 / len(own)) for expert in own]
    name = fusing.member.name
    # That network predicts without a prior.
    alone = _expert(fusing, split, name, known=judged if fusing is judge else None)
    # Each one's depth is its prior in turn; the prior weights follow what the depth explains.
    experts, with_prior = list[Expert](), list[Expert]()
    for expert in own:
        share = trust(expert, split, alone) / len(own)
        experts.append(replace(expert, weight=0.0 if expert.of_scanner else OWN * share))
        if share > 0:
            with_name = f"{name} with {expert.name}"
            informed = _expert(
                fusing, split, with_name, prior=expert, user=expert.user, updates=False
            )
            with_prior.append(replace(informed, weight=WITH_PRIOR * share))
    # The rest of the prior weights is that of the network without a prior.
    rest = 1 - sum(expert.weight for expert in (*experts, *with_prior))
    return [*experts, *with_prior, replace(alone, weight=rest), _interpolation(split)]


def trust(expert: Expert, split: ValidationSplit, alone: Expert) -> float:
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
    assert expert.prediction is not None
    if expert.network is not None and expert.network.member.takes_points:
        if not len(split.points):
            return 0.0
        ratio = split.error(expert.updated) / max(split.error(alone.at), 1e-9)
        return min(1.0, max(0.0, 2.0 - ratio))
    points = split.whole.points
    at = points.sample(expert.prediction.before).double()
    x, y = log_depth(at[at > 0]), log_depth(points.depth[at > 0].double())
    if len(x) < MIN_POINTS:
        return 0.0
    x, y, count = x - x.mean(), y - y.mean(), len(x)
    slope = (x @ y) / (x @ x).clamp_min(1e-12)
    left_out = (y - slope * x) / (1 - 1 / count - x.square() / (x @ x).clamp_min(1e-12))
    total = (y / (1 - 1 / count)).square().sum().clamp_min(1e-12)
    explained = float(1 - left_out.square().sum() / total) if slope > 0 else 0.0
    return min(1.0, max(0.0, (explained - USELESS) / (USEFUL - USELESS)))


def add_blind_expert(
    networks: Sequence[OpenNetwork], split: ValidationSplit, experts: list[Expert]
) -> tuple[list[Expert], tuple[str, ...]]:
    """Returns the experts, joined by one that sees a grey image where the image is in doubt.

    The second value is a warning where the image does not lower the error at validation points.
    """
    fusing = _fusing(networks)
    rgb, count = split.whole.rgb, len(split.points)
    if fusing is None or rgb is None or split.whole.one_view or count < ENOUGH_FOR_DOUBT:
        return experts, ()
    at = {each.name: each.at for each in experts}
    name = fusing.member.name
    of_linear = split.gain(at[name], at[LINEAR])
    if of_linear >= DOUBT:
        return experts, ()
    for each in networks:
        each.next_image()
    grey = torch.full_like(rgb, 0.5)
    blind = replace(split, whole=replace(split.whole, rgb=grey), kept=replace(split.kept, rgb=grey))
    expert = _expert(fusing, blind, f"{name} without the image", updates=False)
    experts = [*experts, replace(expert, weight=WITHOUT_IMAGE)]
    if (of_linear + split.gain(at[name], expert.at)) / 2 >= NO_GAIN:
        return experts, ()
    with_image = split.error(at[name])
    without = min(split.error(at[LINEAR]), split.error(expert.at))
    warning = (
        f"warning: the image does not lower the error: at {count:,} validation points it is"
        f" {with_image:.4f} with the image and {without:.4f} without it; see --registration"
    )
    return experts, (warning,)


def fit_weights(
    experts: Sequence[Expert], split: ValidationSplit, chosen: Tensor | None = None
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
    having = [expert for expert in experts if expert.weight > 0]
    prior = np.array([expert.weight for expert in having])
    prior /= prior.sum()
    found = prior
    points = torch.ones(len(split.points), dtype=torch.bool) if chosen is None else chosen
    if len(having) > 1 and bool(points.any()):
        at = torch.stack([expert.at for expert in having], dim=1)[points].double()
        centre = weighted_mean([(at[:, k], float(w)) for k, w in enumerate(prior)])[:, None]
        offsets = torch.where(at > 0, log_depth(at) - log_depth(centre), 0.0).numpy()
        residual = (
            log_depth(split.points.depth.double()[points]) - log_depth(centre[:, 0])
        ).numpy()
        found = _nearest_to_prior(offsets, residual, split.weights[points].double().numpy(), prior)
    by_name = dict.fromkeys((expert.name for expert in experts), 0.0)
    return by_name | {each.name: float(w) for each, w in zip(having, found, strict=True)}


def _nearest_to_prior(offsets: Floats, residual: Floats, weights: Floats, prior: Floats) -> Floats:
    """The weights (K,) of K experts.

    Args:
        offsets: (M, K) log predictions, relative to those with the prior weights.
        residual: (M,) log depths, relative to the same.
        weights: (M,) of the points.
        prior: (K,) prior weights.
    """
    from scipy.optimize import nnls

    scale = max(1.25 * float(np.average(np.abs(residual), weights=weights)), 1e-3)
    found = prior
    # Each pass weighs large residuals down, and solves for non-negative weights whose sum is 1.
    for _ in range(5):
        size = np.abs(residual - offsets @ found)
        root = np.sqrt(weights * np.minimum(1, scale / np.maximum(size, 1e-9)))
        ridge = np.sqrt(STRENGTH) * scale
        system = [
            offsets * root[:, None],
            ridge * np.eye(len(prior)),
            np.full((1, len(prior)), 1e4),
        ]
        found = nnls(
            np.concatenate(system), np.concatenate([residual * root, ridge * prior, [1e4]])
        )[0]
        found /= found.sum()
    return found


def scanner_shares(
    experts: Sequence[Expert], split: ValidationSplit, weights: Mapping[str, float]
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
    fit = [e for e in own if float((points.sample(e.dense()) - points.depth).abs().mean()) <= limit]
    return {each.name: OWN_SCANNER / len(fit) for each in fit}


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


def judge_of(networks: Sequence[OpenNetwork]) -> OpenNetwork:
    """Returns the network that weighs its points, else the user's."""
    return next(filter(weighs_points, networks), networks[0])


def _fusing(networks: Sequence[OpenNetwork]) -> OpenNetwork | None:
    """The network that takes another one's depth as a prior. None without one."""
    return next((each for each in networks if each.member.takes_prior), None)


def weighs_points(network: OpenNetwork) -> bool:
    """Returns whether a network weighs its points."""
    return network.member.network.definition.weighs_points


def predict(network: OpenNetwork, frame: Frame, *, updates: bool = True) -> Prediction:
    """Returns what one network gives for the frame, its residual not propagated.

    On even frames, updates of a network that takes the points gain 2 to 3 % with 500 points, 1 %
    with 100 and nothing with 20. They gain 1 % with a LiDAR's, where they take as long as
    everything else.

    Args:
        network: The network, open.
        frame: The frame.
        updates: Whether z is updated, where that gains anything.
    """
    gains = len(frame.points) >= FEW_POINTS and not is_dense(frame.points)
    return network.refine(frame, updates=updates and (gains or not network.member.takes_points))


def _expert(
    network: OpenNetwork,
    split: ValidationSplit,
    name: str,
    *,
    known: Prediction | None = None,
    prior: Expert | None = None,
    user: OpenNetwork | None = None,
    updates: bool = True,
) -> Expert:
    """The predictions of one network, without a prior weight yet.

    Args:
        network: The network that predicts, open.
        split: The frame and its validation points.
        name: Name of the expert.
        known: Prediction from all points, where it was computed already.
        prior: The expert whose depth is the network's prior.
        user: The user's network whose depth it is, or has as a prior.
        updates: Whether z is updated with all points, which takes as long as all else.
    """
    whole, kept, takes_points = split.whole, split.kept, network.member.takes_points
    # A prior is given with all points, and made from the others where the others are used.
    if prior is not None:
        assert prior.prediction is not None
        whole = replace(whole, prior=prior.prediction.before)
        kept = replace(kept, prior=prior.aligned)
    # The network predicts from all points.
    own = known or predict(network, whole, updates=updates)
    aligned = own.before
    # It predicts the validation points from the others.
    updated = at = torch.empty(0)
    if len(split.points):
        again = predict(network, kept, updates=not takes_points)
        aligned, updated = again.before, split.points.sample(again.after)
        at = propagate_at(
            again.after, kept.points, kept.rgb, split.points.xy, kind=split.propagation
        )
    return Expert(
        name=name,
        weight=0.0,
        dense=lambda: own.after,
        at=at,
        aligned=aligned,
        updated=updated,
        prediction=own,
        network=network,
        user=user,
        of_scanner=user is network and takes_points and split.has_scan_lines,
    )


def _interpolation(split: ValidationSplit) -> Expert:
    """Linear interpolation of the inliers."""
    at = none = torch.empty(0)
    if len(split.points):
        at = linear(split.kept.points, split.points.xy)
    # Its dense depth takes long on a LiDAR's points, and often has no weight.
    dense = partial(linear, split.whole.points)
    return Expert(name=LINEAR, weight=WITHOUT_IMAGE, dense=dense, at=at, aligned=none, updated=at)
