"""The weights of the experts: those that predict the validation points best, near prior weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.frames.experts import Expert, Experts, weighted_mean
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.validation import ValidatedFrame, log_of

STRENGTH = 60.0
"""Validation points that the prior weights count as. It was chosen with each of six sets left out
in turn (docs/notes/fusion.md)."""
OWN_SCANNER = 0.75
"""Weight of a completion network on scan lines. Validation points cannot judge it: the lines that
they leave are gaps that its scanner does not leave. On even KITTI frames this changes its MAE by
−0.9 (pncnn) and −2.8 % (nconv)."""
IMAGE_ON_LINES = 0.15
"""Least weight of an image network on scan lines, its aligned depth propagated. With simulated
networks of 4 and 9 % error on two KITTI frames, RMSE falls by 3.1 % and MAE by 1.2 to 1.5 %. With
0.25 it is 5 and 2 %, but exact lines of a depth camera lose 1 to 4 % indoors."""
ALL_ON_LINES = 1.5
"""Error of that depth at the validation points, over that of `compact`, up to which it has the
least weight. Simulated networks of 4 and 9 % error have 0.4 to 1.55, FastDepth 1.9 to 2.5."""
NONE_ON_LINES = 2.0
"""The same quotient, from which on it has no least weight."""


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
    prior = prior / prior.sum()
    found = prior
    points = torch.ones(len(split.points), dtype=torch.bool) if chosen is None else chosen
    if len(having) > 1 and bool(points.any()):
        # Log predictions and log depths, relative to the prediction with the prior weights.
        at = torch.stack([expert.at for expert in having], dim=1)[points].double()
        mean = weighted_mean([(at[:, k], float(w)) for k, w in enumerate(prior)])
        centre = log_of(mean)
        offsets = torch.where(at > 0, log_of(at) - centre[:, None], 0.0).numpy()
        residual = (log_of(split.points.depth.double()[points]) - centre).numpy()
        shares = split.weights[points].double().numpy()
        # Each pass weighs large residuals down, and solves for weights >= 0 whose sum is 1.
        scale = max(1.25 * float(np.average(np.abs(residual), weights=shares)), 1e-3)
        ridge = np.sqrt(STRENGTH) * scale
        sum_of_one = np.full((1, len(prior)), 1e4)
        for _ in range(5):
            size = np.abs(residual - offsets @ found)
            root = np.sqrt(shares * np.minimum(1, scale / np.maximum(size, 1e-9)))
            system = [offsets * root[:, None], ridge * np.eye(len(prior)), sum_of_one]
            right = [residual * root, ridge * prior, [1e4]]
            found = nnls(np.concatenate(system), np.concatenate(right))[0]
            found /= found.sum()
    by_name = dict.fromkeys((expert.name for expert in experts), 0.0)
    fitted = {expert.name: float(w) for expert, w in zip(having, found, strict=True)}
    return by_name | fitted


class Share(NamedTuple):
    """A part of the result that one network has by itself, beside the fused depth."""

    name: str
    part: float
    """0…1, its weight in the result."""
    dense: Tensor
    """(H, W) metres: its depth."""
    at: Tensor
    """(M,) metres: its depth at the validation points, from the others."""


def with_shares(fused: Tensor, shares: Sequence[tuple[Tensor, float]]) -> Tensor:
    """Returns the fused depth (…) with the depths (…) of single networks, by their parts."""
    rest = 1 - sum(part for _, part in shares)
    return weighted_mean([(fused, rest), *shares])


def shares_on_lines(
    experts: Experts, split: ValidatedFrame, inliers: Frame, weights: Mapping[str, float]
) -> list[Share]:
    """Returns the parts that single networks have in a frame of scan lines.

    Its validation points are whole lines beside others, where `compact` and interpolation are best.
    So they do not show what a completion network of that scanner is worth, nor an image network
    between the lines.

    Args:
        experts: The experts.
        split: The frame and its validation points.
        inliers: The frame without its outliers.
        weights: The weights in the fused depth, by name.
    """
    if not len(split.points):
        return []
    own = _shares_of_scanner(experts.every, split, weights)
    return own or _share_of_image(experts, split, inliers, weights)


def _shares_of_scanner(
    experts: Sequence[Expert], split: ValidatedFrame, weights: Mapping[str, float]
) -> list[Share]:
    """The parts of completion networks of the scanner.

    A network has one if its error at the points, which it was given, is at most the error of the
    experts' mean at the validation points.
    """
    own = [expert for expert in experts if expert.of_scanner]
    if not own:
        return []
    mean = weighted_mean([(expert.at, weights[expert.name]) for expert in experts])
    limit = split.error(mean)
    points = split.whole.points
    fit = [e for e in own if (points.sample(e.dense) - points.depth).abs().mean() <= limit]
    part = OWN_SCANNER / max(len(fit), 1)
    return [Share(expert.name, part, expert.dense, expert.updated) for expert in fit]


def _share_of_image(
    experts: Experts, split: ValidatedFrame, inliers: Frame, weights: Mapping[str, float]
) -> list[Share]:
    """The part of the user's image network, its aligned depth propagated; none if it has enough."""
    own = experts.own
    alone = experts.alone
    if alone is None or own.user is None or own.user.takes_points:
        return []
    kept = split.kept
    field = ResidualField(own.kept.aligned, kept.points, kept.rgb)
    at = field.depth(split.points.xy, kind=split.propagation)
    ratio = split.error(at) / max(split.error(alone.at), 1e-9)
    trusted = (NONE_ON_LINES - ratio) / (NONE_ON_LINES - ALL_ON_LINES)
    part = IMAGE_ON_LINES * min(1.0, max(0.0, trusted)) - weights[own.name]
    if part <= 0:
        return []
    whole = ResidualField(own.whole.aligned, inliers.points, inliers.rgb)
    return [Share(own.name, part, whole.depth(kind=split.propagation), at)]
