"""How sure means over frames are: independent clusters, intervals, permutations, Holm's correction.

Errors of neighbouring frames of a video are alike, so whole clusters of frames are left out or
swapped. The bootstraps of scipy.stats cover too little with few clusters of skewed errors; the
coverage of the intervals here is in docs/notes/statistics.md. A frame that lacks a measure, which
is then NaN, is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.shared.tables import count_of

Floats = NDArray[np.float64]

LEVEL = 0.95
"""Probability with which an interval holds the mean."""
MIN_CLUSTERS = 5
"""Fewer give no interval: with lognormal errors (σ 0.5) even a corrected one misses too often."""
BLOCK_BIAS = 0.1
"""Fraction of the variance of a mean that blocks of a single sequence may miss."""
_EQUAL = 1e-9
"""Relative difference of values that are equal but for rounding."""
_LARGEST_CORRELATION = 0.99
"""Most that a correlation is corrected to, so that a block has a length."""
_LEAST_SPREAD = 1e-8
"""Standard error relative to the statistic, or to 1, below which the pseudo-values are equal."""
_LEAST_SKEW = 1e-6
"""Skewness below which its correction, which divides by it, is Student's t."""
_WIDEST = 2.5
"""Most that the correction for skewness widens a side of an interval: beyond, few clusters give
ever wider intervals that hold the true mean no more often (docs/notes/statistics.md)."""
MAX_BLOCKS = 10
"""Most blocks of a single sequence. Few long blocks stay independent also where the correlation is
not that of a first-order autoregression, at a small loss of power (Ibragimov and Müller 2010)."""

PERMUTATIONS = 10_000
"""Most swaps of two runs that are tried."""


@dataclass(frozen=True, kw_only=True)
class Clusters:
    """A partition of the frames into clusters, which count as independent of each other."""

    ids: NDArray[np.int64]
    """(N,) the cluster of each frame, from 0 to count − 1."""
    text: str
    """What they are, such as `12 groups of frames`."""

    @property
    def count(self) -> int:
        """How many clusters there are."""
        return int(self.ids.max()) + 1

    def to_json(self) -> dict[str, object]:
        """Returns what JSON files have of it."""
        return {"count": self.count, "text": self.text}

    def notes(self) -> list[str]:
        """Returns a line that frames are not independent; none if each of them is a cluster."""
        if self.count == len(self.ids):
            return []
        return [
            "frames of one sequence are not independent:"
            f" {len(self.ids):,} frames count as {self.text}"
        ]


def find_clusters(groups: Sequence[str], series: Floats) -> Clusters:
    """Returns sets of frames that count as independent: the groups, blocks of one, or each frame.

    Groups are clusters if there are several, and fewer than frames. A single group is one sequence:
    if its errors are correlated, its blocks of consecutive frames are clusters.

    Args:
        groups: The sequence of each of N frames.
        series: (N, M) what is averaged, in the order of the frames; NaN where a frame has none.
    """
    group_ids = {name: index for index, name in enumerate(dict.fromkeys(groups))}
    frames = len(groups)
    if 1 < len(group_ids) < frames:
        ids = np.array([group_ids[name] for name in groups])
        return Clusters(ids=ids, text=f"{len(group_ids):,} groups of frames")
    length = block_length(series) if len(group_ids) == 1 else 1
    if length == 1:
        return Clusters(ids=np.arange(frames), text=count_of(frames, "frame"))
    blocks = max(1, min(MAX_BLOCKS, frames // length))
    return Clusters(
        ids=np.arange(frames) * blocks // frames,  # lengths differ by one frame at most
        text=f"{count_of(blocks, 'block')} of about {round(frames / blocks):,} consecutive frames"
        " of one sequence, as their errors are correlated",
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
    # The lag-1 correlation of each column; a column that is equal in every frame has none.
    centred = series - series.mean(axis=0)
    rounding = _EQUAL * np.abs(series).max(axis=0)
    centred[:, np.abs(centred).max(axis=0) <= rounding] = math.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        lag_one = (centred[1:] * centred[:-1]).sum(axis=0) / (centred**2).sum(axis=0)
    correlations = lag_one[np.isfinite(lag_one)]
    correlation = float(np.median(correlations)) if len(correlations) else 0.0
    standard_error = 1 / math.sqrt(frames)
    if correlation <= standard_error:
        return 1
    # Kendall's correction, and the length that follows.
    correlation = min(correlation + (1 + 3 * correlation) / frames, _LARGEST_CORRELATION)
    return min(frames, math.ceil(2 * correlation / (1 - correlation**2) / BLOCK_BIAS))


def _sums(values: Sequence[Floats], clusters: Clusters) -> tuple[Floats, Floats]:
    """The sums of each run in each cluster, and the number of frames that they are over.

    Frames that not all runs have are left out, and so are clusters of nothing else.

    Args:
        values: (N,) of each of R runs, NaN where a frame has none.
        clusters: Clusters of the N frames.

    Returns:
        (R, G) sums and (G,) numbers of frames, of the G clusters that are left.
    """
    in_all_runs = np.isfinite(values).all(axis=0)
    ids = np.unique(clusters.ids[in_all_runs], return_inverse=True)[1]  # from 0 without a gap
    counts = np.bincount(ids).astype(np.float64)
    sums = [np.bincount(ids, run[in_all_runs], len(counts)) for run in values]
    return np.array(sums), counts


def gain(before: Floats | float, after: Floats | float, sign: int) -> Floats:
    """Returns the change in per cent of `before`, positive if better; NaN where it is no number.

    Args:
        before: (…) means.
        after: (…) means.
        sign: 1 if higher is better, −1 if lower is, 0 if neither: `Measure.sign`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.divide(np.subtract(after, before), np.abs(before))
    change = np.where(np.equal(before, after), 0.0, 100 * sign * relative)  # 0 to 0 is no change
    return np.where(np.isfinite(change) & (sign != 0), change, math.nan)


def interval(
    statistic: Callable[..., Floats], values: Sequence[Floats], clusters: Clusters
) -> tuple[float, float]:
    """Returns the ends, low and high, of the 95 % interval of statistic(*means of the runs).

    The jackknife leaves out one cluster after the other; its pseudo-values are a sample whose mean
    is the statistic. Each end is that of Student's t, or of t corrected for the skewness of the
    sample (Hall 1992, equation 5), whichever is farther out. NaN for fewer than MIN_CLUSTERS.

    Args:
        statistic: Function of one mean a run. The means are numbers, or arrays (G,) of which it
            returns the statistic element by element.
        values: (N,) values of each run, of the same frames, NaN where a frame has none.
        clusters: Clusters of the frames.
    """
    from scipy import stats

    sums, counts = _sums(values, clusters)
    size = len(counts)
    totals = sums.sum(axis=1)
    frames = counts.sum()
    if size < MIN_CLUSTERS:
        return math.nan, math.nan
    # The statistic of all frames, without each cluster, and its pseudo-values.
    value = float(statistic(*(totals / frames)))
    without_one = statistic(*((totals[:, None] - sums) / (frames - counts)))
    pseudo_values = size * value - (size - 1) * without_one
    # Their standard error, and the skewness of their mean. Values that are equal but for rounding
    # have none.
    standard_error = float(stats.sem(pseudo_values))
    skew = 0.0
    if standard_error > _LEAST_SPREAD * max(abs(value), 1.0):
        skew = float(stats.skew(pseudo_values, bias=False)) / math.sqrt(size)
    # Each end is value − t · standard error. By Student's distribution, t is `reach` at the low end
    # and −`reach` at the high one.
    reach = float(stats.t.ppf((1 + LEVEL) / 2, size - 1))
    t = np.array([reach, -reach])
    if abs(skew) >= _LEAST_SKEW:
        t = 3 / skew * (np.cbrt(1 + skew * (t - skew / 6)) - 1)
    # Corrected, neither end comes nearer than `reach`, or moves out beyond _WIDEST times that.
    below, above = np.clip([t[0], -t[1]], reach, _WIDEST * reach).tolist()
    return value - below * standard_error, value + above * standard_error


def swap_p_value(first: Floats, other: Floats, clusters: Clusters) -> float:
    """Returns the two-sided p-value of two paired runs (N,); NaN for less than two clusters.

    It is the fraction of swaps of the two runs, cluster by cluster, after which the means differ at
    least as much as observed (Good 2005, chapter 3). All 2^G swaps of G clusters are tried if they
    are at most PERMUTATIONS; else so many random ones, with the observed one counted in.

    Args:
        first: (N,) values of one run, NaN where a frame has none.
        other: (N,) values of the other run in the same frames.
        clusters: Clusters of the frames.
    """
    from scipy import stats

    # a swap changes the sign of what its cluster adds to the difference of the means
    (changes,), counts = _sums([other - first], clusters)
    if len(counts) < 2:
        return math.nan
    test = stats.permutation_test(
        [changes],
        np.sum,
        permutation_type="samples",
        vectorized=True,
        n_resamples=PERMUTATIONS,
        batch=1000,  # so that memory stays bounded
        random_state=np.random.default_rng(0),
    )
    return float(test.pvalue)


def holm(p_values: Floats) -> Floats:
    """Returns p-values adjusted for testing all of these hypotheses (Holm 1979); NaN stays NaN.

    Args:
        p_values: (…) p-values; those that are NaN are no tests and do not count.
    """
    values = p_values.ravel()
    rising = np.argsort(values)
    rising = rising[np.isfinite(values[rising])]
    # The least of n is multiplied by n, the next by n − 1, …; none becomes less than one before.
    multiplied = values[rising] * np.arange(len(rising), 0, -1)
    adjusted = np.full(len(values), math.nan)
    adjusted[rising] = np.minimum(np.maximum.accumulate(multiplied), 1.0)
    return adjusted.reshape(p_values.shape)
