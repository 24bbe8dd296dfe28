"""Which of several depths, or which mean of a few, is nearest to points that none of them saw.

Of candidates scored on few points the best one is best partly by luck, and a mean of two good ones
is mostly better than either (stacked generalisation, Wolpert 1992; Breiman 1996). So means of the
best few are looked at as well, with round weights, and whatever is not the usual way has to be
better than it by more than chance: by the standard error of the mean difference over the points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

AMONG = 4
"""So many of the best candidates are mixed."""
SHARES = (0.25, 0.5, 0.75)
"""Weights of the first of two."""
CAUTION = 1.0
"""Standard errors by which another than the usual way has to be better."""
_ROUNDING = 1e-6


@dataclass(frozen=True)
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


def best_blend(
    predicted: Tensor,
    depth: Tensor,
    believed: Tensor,
    *,
    usual: int,
    simple: Sequence[int] = (),
) -> Blend:
    """The candidate, or mean of a few, that is best beyond chance at points it did not see.

    predicted: (C, M) metres of C candidates at M held-out points of this depth (M,).
    believed: (M,) 0…1, the weight of each point. usual: the candidate to take where no other is
    better by more than chance. simple: what is returned is never worse than any of these.
    """
    errors = held_out_error(predicted, depth, believed)
    bound = min((float(errors[one]) for one in simple), default=math.inf)
    usual_errors = (predicted[usual] - depth).abs()
    blends = []
    for members, weights in _means(errors, usual):
        mean = (torch.tensor(weights)[:, None] * predicted[list(members)]).sum(dim=0)
        error = float(held_out_error(mean, depth, believed))
        doubt = _standard_error((mean - depth).abs() - usual_errors, believed)
        if error <= bound * (1 + _ROUNDING):
            blends.append((error + CAUTION * doubt, Blend(members, weights, error)))
    return min(blends, key=lambda one: one[0])[1]


def _means(errors: Tensor, usual: int) -> Iterator[tuple[tuple[int, ...], tuple[float, ...]]]:
    """Members and weights of what is looked at, every candidate alone among them."""
    yield from (((one,), (1.0,)) for one in range(len(errors)))
    order = [int(i) for i in errors.argsort(stable=True)[:AMONG]]
    mixed = order if usual in order else [*order, usual]
    for pair in combinations(mixed, 2):
        yield from ((pair, (share, 1 - share)) for share in SHARES)
    for count in range(3, len(order) + 1):
        yield from ((some, (1 / count,) * count) for some in combinations(order, count))


def _standard_error(difference: Tensor, believed: Tensor) -> float:
    """Of the weighted mean of differences (M,)."""
    share = believed / believed.sum()
    mean = (share * difference).sum()
    return float((share.square() * (difference - mean).square()).sum().sqrt())
