"""How sure means over frames are: independent clusters, intervals, permutations, Holm's correction.

Errors of neighbouring frames of a video are alike, so whole clusters of frames are left out or
swapped. The bootstraps of scipy.stats cover too little with few clusters of skewed errors; the
coverage of the intervals here is in docs/notes/statistics.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.tables import count_of

Floats = NDArray[np.float64]

LEVEL = 0.95
MIN_CLUSTERS = 5
"""Fewer give no interval: with lognormal errors (σ 0.5) even a corrected one misses too often."""
BLOCK_BIAS = 0.1
"""Fraction of the variance of a mean that blocks of a single sequence may miss."""
_WIDEST = 2.5
"""Most that the correction for skewness widens a side of an interval: beyond, few clusters give
ever wider intervals that hold the true mean no more often (docs/notes/statistics.md)."""
MAX_BLOCKS = 10
"""Most blocks of a single sequence. Few long blocks stay independent also where the correlation is
not that of a first-order autoregression, at a small loss of power (Ibragimov and Müller 2010)."""

_CELLS = 1 << 21
"""Numbers held at once, so that memory stays bounded for any number of clusters."""


@dataclass(frozen=True, kw_only=True)
class Clusters:
    """A partition of the frames into clusters that count as independent."""

    ids: NDArray[np.int64]
    """(N,) the cluster of each frame, from 0 to count − 1."""
    unit: str
    """What a cluster is, in the plural."""

    @property
    def count(self) -> int:
        """How many clusters there are."""
        return int(self.ids.max()) + 1

    def describe(self) -> str:
        """Returns text such as `12 groups of frames`."""
        noun, space, of = self.unit.partition(" ")
        return count_of(self.count, noun.removesuffix("s")) + space + of

    def notes(self) -> list[str]:
        """Returns that frames are not independent, unless each of them is a cluster."""
        if self.count == len(self.ids):
            return []
        return [
            f"frames of one sequence are not independent: {len(self.ids):,} frames count as"
            f" {self.describe()}"
        ]


def find_clusters(groups: Sequence[str], series: Floats) -> Clusters:
    """Returns the groups; for a single group with correlated errors, blocks of it.

    Args:
        groups: The sequence of each of N frames.
        series: (N, M) what is averaged, in the order of the frames.
    """
    number = {name: index for index, name in enumerate(dict.fromkeys(groups))}
    frames = len(groups)
    if 1 < len(number) < frames:
        return Clusters(ids=np.array([number[own] for own in groups]), unit="groups of frames")
    length = block_length(series) if len(number) == 1 else 1
    if length == 1:
        return Clusters(ids=np.arange(frames), unit="frames")
    blocks = max(1, min(MAX_BLOCKS, frames // length))
    return Clusters(
        ids=np.arange(frames) * blocks // frames,
        unit=f"blocks of about {round(frames / blocks):,} consecutive frames of one sequence,"
        " as their errors are correlated",
    )


def block_length(series: Floats) -> int:
    """Returns the length of blocks whose means are nearly independent; 1 if frames already are.

    Take blocks of length L of a first-order autoregression with lag-1 correlation ρ. For large L
    they understate the variance of the mean by the fraction 2ρ/(1 − ρ²)/L. L keeps that fraction at
    BLOCK_BIAS. ρ is the median over the columns without NaN, corrected for its bias (Kendall 1954).
    A correlation below its standard error counts as none.

    Args:
        series: (N, M) in order of time.
    """
    frames = len(series)
    if frames < MIN_CLUSTERS:
        return 1
    centred = series - series.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        lag_one = (centred[1:] * centred[:-1]).sum(axis=0) / (centred**2).sum(axis=0)
    known = lag_one[np.isfinite(lag_one)]
    correlation = float(np.median(known)) if len(known) else 0.0
    if correlation <= 1 / math.sqrt(frames):
        return 1
    correlation = min(correlation + (1 + 3 * correlation) / frames, 0.99)
    return min(frames, math.ceil(2 * correlation / (1 - correlation**2) / BLOCK_BIAS))


def _cluster_sums(values: Floats, clusters: Clusters) -> Floats:
    """(G, 2, M) the sum of (N, M) values in each cluster, and how many frames have one."""
    known = np.isfinite(values)
    sums = np.zeros((clusters.count, 2, values.shape[1]))
    np.add.at(sums, clusters.ids, np.stack([np.where(known, values, 0.0), known], axis=1))
    return sums


def _mean(sums: Floats) -> Floats:
    """(…, M) the means of sums and counts (…, 2, M); NaN where no frame has a value."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(sums[..., 0, :] / sums[..., 1, :])


def gain(before: Floats, after: Floats, better: Floats) -> Floats:
    """Returns (…, M) the change in per cent of `before`; NaN where that is no number.

    Args:
        before: (…, M)
        after: (…, M)
        better: (M,) `Measure.sign`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.where(before == after, 0.0, 100 * better * (after - before) / np.abs(before))
    return np.where(np.isfinite(change) & (better != 0), change, math.nan)


def interval(
    statistic: Callable[..., Floats], runs: Sequence[Floats], clusters: Clusters
) -> tuple[Floats, Floats]:
    """Returns (M,), (M,): the ends of the 95 % interval of statistic(*means of the runs).

    The jackknife leaves out one cluster after the other; its pseudo-values are a sample whose mean
    is the statistic. Each end is that of Student's t, or of t corrected for the skewness of the
    sample (Hall 1992), whichever is farther out. NaN for a measure that fewer than MIN_CLUSTERS
    clusters have.

    Args:
        statistic: Function from means (…, M) of each run to (…, M).
        runs: (N, M) each, of the same frames and measures; NaN where a frame lacks a measure.
        clusters: Clusters of the frames.
    """
    from scipy.special import stdtrit

    sums = [_cluster_sums(values, clusters) for values in runs]
    value = statistic(*(_mean(each.sum(axis=0)) for each in sums))
    without = statistic(*(_mean(each.sum(axis=0) - each) for each in sums))
    # a cluster without the measure is no observation of it
    has = np.all([each[:, 1] > 0 for each in sums], axis=0)
    count = has.sum(axis=0).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        # the pseudo-values' deviations from their mean, and standard error and skewness of it
        pseudo = np.where(has, count * value - (count - 1) * without, 0.0)
        deviation = np.where(has, pseudo - pseudo.sum(axis=0) / count, 0.0)
        variance, third = ((deviation**power).sum(axis=0) / count for power in (2, 3))
        error = np.sqrt(variance / (count - 1))
        skew = third / variance**1.5 * np.sqrt(count - 1) / (count - 2)
        error = np.where(count >= MIN_CLUSTERS, error, math.nan)
        skew = np.where(error > 1e-8 * np.maximum(np.abs(value), 1.0), skew, 0.0)
    reach = stdtrit(np.maximum(count - 1, 1), (1 + LEVEL) / 2)  # quantile of Student's t
    below, above = (
        np.clip(end, reach, _WIDEST * reach)
        for end in (_correct_for_skewness(reach, skew), -_correct_for_skewness(-reach, skew))
    )
    return value - below * error, value + above * error


def _correct_for_skewness(t: Floats, skew: Floats) -> Floats:
    """The values that t has in samples of this skewness over √n (Hall 1992, equation 5)."""
    slight = np.abs(skew) < 1e-6
    skew = np.where(slight, 1.0, skew)
    return np.where(slight, t, 3 / skew * (np.cbrt(1 + skew * (t - skew / 6)) - 1))


def swap_p_values(
    first: Floats, other: Floats, clusters: Clusters, permutations: int, seed: int
) -> tuple[Floats, bool]:
    """Returns (M,) two-sided p-values of paired runs, and whether they are exact.

    The p-value is the fraction of swaps of the two runs, cluster by cluster, after which the means
    differ at least as much as observed (Good 2005, chapter 3). All 2^G swaps are tried if they are
    at most `permutations`; else so many random ones, with the observed one counted in.
    scipy.stats.permutation_test takes 15 times as long for 2,000 clusters.

    Args:
        first: (N, M), NaN where a frame lacks a measure.
        other: (N, M) of the same frames, NaN in the same places.
        clusters: Clusters of the frames.
        permutations: The most swaps that are tried.
        seed: Random seed of the swaps.
    """
    # a swap changes the sign of what its cluster adds to the difference of the means
    sums, known = _cluster_sums(other - first, clusters).transpose(1, 0, 2)
    count = len(sums)
    exact = count <= math.log2(permutations)
    tried = 2**count if exact else permutations
    # rounding must not make an equal difference look smaller than the observed one
    least = np.abs(sums.sum(axis=0)) * (1 - 1e-9)
    generator = np.random.default_rng(seed)
    as_much = np.zeros(len(least))
    at_once = max(1, _CELLS // count)
    for start in range(0, tried, at_once):
        numbers = np.arange(start, min(tried, start + at_once))
        if exact:  # the bits of a number say which clusters are swapped
            swapped = numbers[:, None] >> np.arange(count) & 1
        else:
            swapped = generator.integers(0, 2, (len(numbers), count))
        as_much += (np.abs((1.0 - 2 * swapped) @ sums) >= least).sum(axis=0)
    p_values = as_much / tried if exact else (as_much + 1) / (tried + 1)
    has_values = (known.sum(axis=0) > 0) & (count > 1)
    return np.where(has_values, p_values, math.nan), exact


def holm(p_values: Floats) -> Floats:
    """Returns p-values adjusted for testing all of these hypotheses (Holm 1979); NaN stays NaN."""
    values = p_values.ravel()
    order = np.argsort(values)
    order = order[np.isfinite(values[order])]
    adjusted = np.full(len(values), math.nan)
    steps = values[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted.reshape(p_values.shape)
