"""How sure means over clusters of frames are: the bootstrap, permutations, and Holm's correction.

scipy.stats offers a bootstrap and permutations of samples, but no studentised interval, which is
what small numbers of skewed errors need, and none of nonlinear functions of pooled sums. Tests
compare with it where both apply.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from pnpdepth_cli.pipeline.evaluation.averages import Floats

LEVEL = 0.95
_STEP = 1e-5
"""Of the numerical derivative, relative to the totals of a cluster; its error is near 1e-10."""
_CELLS = 1 << 21
"""Weights held at once, so that memory stays bounded for any number of clusters."""


def studentised_interval(
    statistic: Callable[[Tensor], Tensor], totals: Floats, resamples: int, seed: int
) -> tuple[Floats, Floats]:
    """Returns (M,), (M,): the ends of the bootstrap-t interval of statistic(totals.sum(0)).

    Efron and Tibshirani 1993, section 12.5, with standard errors linearised in the totals
    (infinitesimal jackknife). NaN where the statistic is NaN.

    Args:
        statistic: From totals (…, C) to (…, M); differentiable, and unchanged where the totals are
            multiplied.
        totals: (G, C) of each cluster; clusters are resampled whole.
        resamples: How many bootstrap samples are drawn.
        seed: Of the drawing.
    """
    clusters = len(totals)
    columns = torch.from_numpy(totals)
    generator = np.random.default_rng(seed)
    fractions = np.full(clusters, 1 / clusters)
    value, error = (row[0] for row in _linearised(statistic, np.ones((1, clusters)), columns))
    ratios = []
    for size in _batches(resamples, clusters):
        weights = generator.multinomial(clusters, fractions, size=size).astype(np.float64)
        values, errors = _linearised(statistic, weights, columns)
        with np.errstate(divide="ignore", invalid="ignore"):
            # a resample without variance says nothing of the ratio's distribution
            ratios.append(np.where(errors > 1e-9 * error, (values - value) / errors, np.nan))
    tail = (1 - LEVEL) / 2
    all_ratios = np.concatenate(ratios)
    none = np.isnan(all_ratios).all(axis=0)  # all clusters are alike: nothing varies
    all_ratios[:, none] = 0.0
    low_ratio, high_ratio = np.nanquantile(all_ratios, [tail, 1 - tail], axis=0)
    return value - high_ratio * error, value - low_ratio * error


def _linearised(
    statistic: Callable[[Tensor], Tensor], weights: Floats, totals: Tensor
) -> tuple[Floats, Floats]:
    """(B, M) the statistic where clusters count as weights (B, G), and (B, M) standard errors."""
    counts = torch.from_numpy(weights)
    resampled = counts @ totals
    values = statistic(resampled)
    # central differences: a backward pass would carry the NaN of one measure into the others
    steps = torch.diag(_STEP * totals.abs().mean(dim=0).clamp_min(1e-300))
    ahead, behind = (statistic(resampled[:, None] + sign * steps) for sign in (1, -1))
    slopes = ((ahead - behind) / (2 * steps.diagonal()[:, None])).transpose(-1, -2)
    variances = [
        (counts * (slopes[:, measure] @ totals.T).square()).sum(dim=-1)
        for measure in range(values.shape[-1])
    ]
    errors = torch.stack(variances, dim=-1).nan_to_num(0.0).sqrt()
    return values.numpy(), errors.numpy()


def sign_flip_p_values(
    difference: Callable[[Floats], Floats], clusters: int, resamples: int, seed: int
) -> tuple[Floats, bool]:
    """Returns (M,) two-sided p-values of paired runs, and whether they are exact.

    The p-value is the fraction of swaps of the two runs, cluster by cluster, after which the means
    differ at least as much as observed (Good 2005, chapter 3). All 2^G swaps are tried if they are
    at most `resamples`; else so many random ones, with the observed one counted in.

    Args:
        difference: From flips (B, G), 0 or 1, to differences of means (B, M).
        clusters: G; clusters are swapped whole.
        resamples: How many swaps are tried at most.
        seed: Of the random swaps.
    """
    observed = np.abs(difference(np.zeros((1, clusters))))
    exact = clusters < 60 and 2**clusters <= resamples
    generator = np.random.default_rng(seed)
    total = 2**clusters if exact else resamples
    # rounding must not make an equal difference look smaller than the observed one
    threshold = observed * (1 - 1e-9)
    as_large = np.zeros(observed.shape[1])
    done = 0
    for size in _batches(total, clusters):
        if exact:
            numbers = np.arange(done, done + size)
            flips = (numbers[:, None] >> np.arange(clusters)) & 1
        else:
            flips = generator.integers(0, 2, size=(size, clusters))
        as_large += (np.abs(difference(flips.astype(np.float64))) >= threshold).sum(axis=0)
        done += size
    p_values = as_large / total if exact else (as_large + 1) / (total + 1)
    return np.where(np.isfinite(observed[0]), p_values, np.nan), exact


def holm(p_values: Floats) -> Floats:
    """Returns (M,) p-values adjusted for testing M hypotheses (Holm 1979); NaN stays NaN.

    scipy.stats adjusts only for the false discovery rate.
    """
    adjusted = np.full(len(p_values), math.nan)
    order = [index for index in np.argsort(p_values) if np.isfinite(p_values[index])]
    largest = 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * float(p_values[index])))
        adjusted[index] = largest
    return adjusted


def _batches(total: int, clusters: int) -> Iterator[int]:
    size = max(1, _CELLS // clusters)
    for start in range(0, total, size):
        yield min(size, total - start)
