"""Which of several candidates, or which mean of a few, is nearest to held-out points.

Of candidates scored on few points, the best one is best partly by chance, and a mean of two good
ones is mostly better than either (stacked generalisation, Wolpert 1992; Breiman 1996). So
arithmetic and geometric means of the best few compete as well, with round weights. Anything but
the default candidate has to be better than it by more than chance: by the standard error of the
mean difference over the points.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

BLENDED = 4
"""Number of the best candidates that are blended."""
PAIR_WEIGHTS = (0.25, 0.5, 0.75)
"""Weights of the first of two."""
CAUTION = 1.5
"""Standard errors by which anything but the default has to be better. 1 to 2 were alike on the even
frames of ICL-NUIM, 7-Scenes and KITTI, 0 was worse."""
ENOUGH_FOR_BOUND = 60
"""From so many held-out points on, the result is never worse than a baseline there."""
SLACK = 2.0
"""Standard errors by which it may be worse with fewer points. On even frames with 20 points 1 cost
3 % of the MAE, and a strict bound up to 20 % on single frames."""
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Blend:
    """A weighted mean of candidates."""

    members: tuple[int, ...]
    """Numbers of the candidates."""
    weights: tuple[float, ...]
    """Their weights, with a sum of 1."""
    geometric: bool
    """Whether the mean is that of log depth."""
    error: float
    """Mean absolute error of the weighted mean, metres."""


def weighted_mean(depths: Tensor, weights: Sequence[float], *, geometric: bool) -> Tensor:
    """Returns the weighted mean (…) of depths (C, …) where they are known; 0 where none is.

    Args:
        depths: Metres of C candidates; not positive is unknown.
        weights: C weights above 0.
        geometric: Whether it is the mean of log depth.
    """
    if len(weights) == 1:
        return depths[0]
    weight = torch.tensor(weights, dtype=depths.dtype).reshape(-1, *[1] * (depths.ndim - 1))
    known = depths > 0
    if bool(known.all()):
        mean = ((depths.log() if geometric else depths) * weight).sum(dim=0) / weight.sum()
        return mean.exp() if geometric else mean
    weight = torch.where(known, weight, 0.0)
    values = torch.where(known, depths, 1.0)
    total = weight.sum(dim=0)
    mean = ((values.log() if geometric else values) * weight).sum(dim=0) / total
    return torch.where(total > 0, mean.exp() if geometric else mean, 0.0)


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
    baselines: Collection[int] = (),
    bounds: Collection[int] = (),
) -> Blend:
    """Returns the candidate, or mean of a few, that is best beyond chance at held-out points.

    Args:
        predicted: (C, M) metres of C candidates at M held-out points.
        depth: (M,) metres, measured.
        weights: (M,) 0…1 of each point.
        default: Row of the candidate to take unless another is better by CAUTION standard errors.
        baselines: Rows of `predicted` whose error bounds the result's. Of fewer points than
            ENOUGH_FOR_BOUND the result may be SLACK standard errors above it.
        bounds: Those of them that are never blended. One is taken if nothing else keeps the bound.
    """
    errors = held_out_error(predicted, depth, weights)
    best = min(baselines, key=lambda one: float(errors[one]), default=None)
    limit = math.inf if best is None else float(errors[best]) * (1 + _ROUNDING)
    strict = best is None or len(depth) >= ENOUGH_FOR_BOUND
    default_errors = (predicted[default] - depth).abs()
    competing = [one for one in range(len(errors)) if one not in bounds]
    blends = []
    for members, parts, geometric in _means(errors, competing, default):
        mean = weighted_mean(predicted[list(members)], parts, geometric=geometric)
        error = float(held_out_error(mean, depth, weights))
        off = (mean - depth).abs()
        margin = _standard_error(off - default_errors, weights)
        slack = 0.0
        if best is not None and not strict:
            slack = SLACK * _standard_error(off - (predicted[best] - depth).abs(), weights)
        if error <= limit + slack:
            blends.append((error + CAUTION * margin, Blend(members, parts, geometric, error)))
    if best is not None and not blends:
        return Blend((best,), (1.0,), False, float(errors[best]))
    return min(blends, key=lambda one: one[0])[1]


def _means(
    errors: Tensor, competing: Sequence[int], default: int
) -> Iterator[tuple[tuple[int, ...], tuple[float, ...], bool]]:
    """Members, weights and kind of all blends, every candidate alone among them."""
    yield from (((one,), (1.0,), False) for one in competing)
    order = sorted(competing, key=lambda one: float(errors[one]))[:BLENDED]
    paired = order if default in order else [*order, default]
    for geometric in (True, False):
        for pair in combinations(paired, 2):
            yield from ((pair, (weight, 1 - weight), geometric) for weight in PAIR_WEIGHTS)
        for count in range(3, len(order) + 1):
            yield from (
                (some, (1 / count,) * count, geometric) for some in combinations(order, count)
            )


def _standard_error(difference: Tensor, weights: Tensor) -> float:
    """Of the weighted mean of differences (M,)."""
    fraction = weights / weights.sum()
    mean = (fraction * difference).sum()
    return float((fraction.square() * (difference - mean).square()).sum().sqrt())
