"""Which of several candidates, or which mean of a few, is nearest to held-out points.

Of candidates scored on few points, the best one is best partly by chance, and a mean of two good
ones is mostly better than either (stacked generalisation, Wolpert 1992; Breiman 1996). So means of
the best few compete as well, with round weights. Anything but the default candidate has to be
better than it by more than chance: by the standard error of the mean difference over the points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

BLENDED = 4
"""Number of the best candidates that are blended."""
PAIR_WEIGHTS = (0.25, 0.5, 0.75)
"""Weights of the first of two."""
CAUTION = 1.0
"""Standard errors by which anything but the default has to be better."""
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Blend:
    """A weighted mean of candidates."""

    members: tuple[int, ...]
    """Numbers of the candidates."""
    weights: tuple[float, ...]
    """Their weights, with a sum of 1."""
    error: float
    """Mean absolute error of the weighted mean, metres."""


def held_out_error(predicted: Tensor, depth: Tensor, weights: Tensor) -> Tensor:
    """Returns the weighted mean absolute error (...,) in metres.

    A point without prediction (0) counts as far off as a depth of 0 is.

    Args:
        predicted: (..., M) metres at M held-out points.
        depth: (M,) metres, measured.
        weights: (M,) 0…1 of each point.
    """
    return ((predicted - depth).abs() * weights).sum(dim=-1) / weights.sum()


def best_blend(
    predicted: Tensor,
    depth: Tensor,
    weights: Tensor,
    *,
    default: int,
    baselines: Sequence[int] = (),
) -> Blend:
    """Returns the candidate, or mean of a few, that is best beyond chance at held-out points.

    Args:
        predicted: (C, M) metres of C candidates at M held-out points.
        depth: (M,) metres, measured.
        weights: (M,) 0…1 of each point.
        default: The candidate to take where no other is better by more than chance.
        baselines: Candidates that the result is never worse than.
    """
    errors = held_out_error(predicted, depth, weights)
    bound = min((float(errors[one]) for one in baselines), default=math.inf)
    default_errors = (predicted[default] - depth).abs()
    blends = []
    for members, parts in _means(errors, default):
        mean = (torch.tensor(parts)[:, None] * predicted[list(members)]).sum(dim=0)
        error = float(held_out_error(mean, depth, weights))
        margin = _standard_error((mean - depth).abs() - default_errors, weights)
        if error <= bound * (1 + _ROUNDING):
            blends.append((error + CAUTION * margin, Blend(members, parts, error)))
    return min(blends, key=lambda one: one[0])[1]


def _means(errors: Tensor, default: int) -> Iterator[tuple[tuple[int, ...], tuple[float, ...]]]:
    """Members and weights of all blends that compete, every candidate alone among them."""
    yield from (((one,), (1.0,)) for one in range(len(errors)))
    order = [int(i) for i in errors.argsort(stable=True)[:BLENDED]]
    paired = order if default in order else [*order, default]
    for pair in combinations(paired, 2):
        yield from ((pair, (weight, 1 - weight)) for weight in PAIR_WEIGHTS)
    for count in range(3, len(order) + 1):
        yield from ((some, (1 / count,) * count) for some in combinations(order, count))


def _standard_error(difference: Tensor, weights: Tensor) -> float:
    """Of the weighted mean of differences (M,)."""
    fraction = weights / weights.sum()
    mean = (fraction * difference).sum()
    return float((fraction.square() * (difference - mean).square()).sum().sqrt())
