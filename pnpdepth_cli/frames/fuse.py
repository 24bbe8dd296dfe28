"""The weights of the experts: those that predict the validation points best, near prior weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.frames.experts import Expert, weighted_mean
from pnpdepth_cli.frames.validation import ValidatedFrame, log_of

STRENGTH = 60.0
"""Validation points that the prior weights count as. It was chosen with each of six sets left out
in turn (docs/notes/fusion.md)."""
OWN_SCANNER = 0.75
"""Weight of a completion network on scan lines. Validation points cannot judge it: the lines that
they leave are gaps that its scanner does not leave. On even KITTI frames this changes its MAE by
−0.9 (pncnn) and −2.8 % (nconv)."""


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


def scanner_shares(
    experts: Sequence[Expert], split: ValidatedFrame, weights: Mapping[str, float]
) -> dict[str, float]:
    """Returns the weights of completion networks of the scanner, by name.

    A network has a weight if its error at the points, which it was given, is at most the error of
    the experts' mean at the validation points.
    """
    own = [expert for expert in experts if expert.of_scanner and len(split.points)]
    if not own:
        return {}
    mean = weighted_mean([(expert.at, weights[expert.name]) for expert in experts])
    limit = split.error(mean)
    points = split.whole.points
    errors = {
        expert.name: float((points.sample(expert.dense) - points.depth).abs().mean())
        for expert in own
    }
    fit = [name for name, error in errors.items() if error <= limit]
    return {name: OWN_SCANNER / len(fit) for name in fit}
