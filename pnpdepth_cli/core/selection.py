"""Which of several depths, or which mean of a few, is nearest to points that none of them saw.

Of candidates scored on few points the best one is best partly by luck, and a mean of two good ones
is mostly better than either (stacked generalisation, Wolpert 1992; Breiman 1996). So beside every
candidate some means of the best few are looked at, with round weights: fitted ones would fit the
luck as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

AMONG = 4
"""So many of the best candidates are mixed."""
SHARES = (0.25, 0.5, 0.75)
"""Weights of the first of two."""


@dataclass(frozen=True, kw_only=True)
class Blend:
    """Candidates by number, their weights with a sum of 1, and the error of their weighted mean."""

    members: tuple[int, ...]
    weights: tuple[float, ...]
    error: float


def held_out_error(predicted: Tensor, depth: Tensor, believed: Tensor) -> Tensor:
    """Mean |predicted − depth| (...,) in metres over points (..., M), each as much as believed.

    A point without prediction (0) counts as far off as the prediction of depth 0 is.
    """
    return ((predicted - depth).abs() * believed).sum(dim=-1) / believed.sum()


def best_blend(predicted: Tensor, depth: Tensor, believed: Tensor) -> Blend:
    """The candidate or the mean of a few with the lowest error; never above the best candidate's.

    predicted: (C, M) metres of C candidates at M held-out points of this depth (M,).
    believed: (M,) 0…1, the weight of each point.
    """
    errors = held_out_error(predicted, depth, believed)
    order = [int(i) for i in errors.argsort(stable=True)[:AMONG]]
    tried: list[tuple[tuple[int, ...], tuple[float, ...]]] = [((one,), (1.0,)) for one in order]
    for pair in combinations(order, 2):
        tried += [(pair, (share, 1 - share)) for share in SHARES]
    for count in range(3, len(order) + 1):
        tried += [(some, (1 / count,) * count) for some in combinations(order, count)]
    blends = []
    for members, weights in tried:
        mean = (torch.tensor(weights)[:, None] * predicted[list(members)]).sum(dim=0)
        error = float(held_out_error(mean, depth, believed))
        blends.append(Blend(members=members, weights=weights, error=error))
    return min(blends, key=lambda blend: blend.error)
