"""How sure means over clusters of frames are: the bootstrap, permutations, and Holm's correction.

Permutations are those of scipy.stats. Its bootstrap has no studentised interval, which few values
of skewed errors need (coverage in docs/guides/evaluation.md), so that one is here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats

from pnpdepth_cli.commands.evaluation.dependence import MIN_CLUSTERS
from pnpdepth_cli.core.metrics import MEASURES, measures_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEVEL = 0.95
_STEP = 1e-5
"""Of the numerical derivative, relative to the sums; its error is near 1e-10."""
_CELLS = 1 << 21
"""Numbers held at once, so that memory stays bounded for any number of clusters."""


@dataclass(frozen=True, kw_only=True)
class FrameTable:
    """The scores of N frames as sums, from which the means of any weighting of them follow."""

    rows: Floats
    """(N, M, K): K summands of each of M measures."""
    mean_of: Callable[[Floats], Floats]
    """From sums (…, M, K) to means (…, M); unchanged where the sums are multiplied."""

    @classmethod
    def of_frames(cls, values: Floats) -> FrameTable:
        """Every frame counts alike; (N, M) with NaN where a frame lacks a measure."""
        known = np.isfinite(values)
        rows = np.stack([np.where(known, values, 0.0), known.astype(np.float64)], axis=-1)
        return cls(rows=rows, mean_of=_ratio)

    @classmethod
    def of_pixels(cls, sums: Floats, keys: Sequence[str]) -> FrameTable:
        """Every pixel counts alike; (N, len(SUMS)), and the measures of MEASURES that are meant."""
        kept = [number for number, measure in enumerate(MEASURES) if measure.key in keys]

        def mean_of(rows: Floats) -> Floats:
            values = measures_of(torch.from_numpy(rows)).numpy()[..., kept]
            return np.asarray(np.diagonal(values, axis1=-2, axis2=-1))

        rows = np.repeat(sums[:, None], len(kept), axis=1)
        return cls(rows=rows, mean_of=mean_of)

    def mean(self) -> Floats:
        """Returns (M,) the means over all frames; NaN for a measure that none has."""
        return self.mean_of(self.rows.sum(axis=0))

    def cluster_totals(self, clusters: Ints) -> Floats:
        """Returns (G, M, K) the sums of each cluster; clusters are (N,) from 0 to G − 1."""
        totals = np.zeros((int(clusters.max()) + 1, *self.rows.shape[1:]))
        np.add.at(totals, clusters, self.rows)
        return totals


def _ratio(sums: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(sums[..., 0] / sums[..., 1])


def mean_interval(
    table: FrameTable, clusters: Ints, resamples: int, seed: int
) -> tuple[Floats, Floats]:
    """Returns (M,), (M,): the ends of the 95 % interval of the table's means."""
    return studentised_interval(table.mean_of, table.cluster_totals(clusters), resamples, seed)


def gain(before: Floats, after: Floats, better: Floats) -> Floats:
    """Returns the change in per cent of `before`; NaN where that is no number.

    Args:
        before: (…, M)
        after: (…, M)
        better: (M,) 1 for measures of which higher is better, else −1.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.where(before == after, 0.0, 100 * better * (after - before) / np.abs(before))
    return np.where(np.isfinite(change), change, math.nan)


def gain_interval(
    first: FrameTable,
    other: FrameTable,
    better: Floats,
    clusters: Ints,
    resamples: int,
    seed: int,
) -> tuple[Floats, Floats]:
    """Returns (M,), (M,): the ends of the 95 % interval of `gain` of paired tables."""
    parts = first.rows.shape[-1]
    totals = np.concatenate([t.cluster_totals(clusters) for t in (first, other)], axis=-1)
    return studentised_interval(
        lambda sums: gain(
            first.mean_of(sums[..., :parts]), other.mean_of(sums[..., parts:]), better
        ),
        totals,
        resamples,
        seed,
    )


def studentised_interval(
    statistic: Callable[[Floats], Floats], totals: Floats, resamples: int, seed: int
) -> tuple[Floats, Floats]:
    """Returns (M,), (M,): the ends of the 95 % interval of statistic(totals.sum(0)).

    Each end is that of the bootstrap-t (Efron and Tibshirani 1993, section 12.5) or of Student's t,
    whichever is farther out: the first follows the skewness of the errors, the second the error of
    a standard error from few clusters. Standard errors are linearised in the totals (infinitesimal
    jackknife). NaN for a measure that fewer than MIN_CLUSTERS clusters have.

    Args:
        statistic: From sums (…, M, K) to (…, M), each measure of its own K sums; differentiable,
            and unchanged where the sums are multiplied.
        totals: (G, M, K) of each cluster; clusters are resampled whole.
        resamples: How many bootstrap samples are drawn.
        seed: Of the drawing.
    """
    clusters, measures, parts = totals.shape
    held = (totals != 0).any(axis=-1).sum(axis=0)
    if clusters < MIN_CLUSTERS:
        return np.full(measures, math.nan), np.full(measures, math.nan)
    flat, by_measure = totals.reshape(clusters, -1), totals.transpose(1, 2, 0)
    steps = np.maximum(_STEP * np.abs(totals).sum(axis=0), 1e-300)
    one_each = np.eye(parts)[:, None] * steps  # (K, M, K)

    def linearised(counts: Floats) -> tuple[Floats, Floats]:
        """(B, M) the statistic where clusters count as (B, G), and (B, M) its standard errors."""
        sums = (counts @ flat).reshape(-1, measures, parts)
        ahead, behind = (statistic(sums[:, None] + sign * one_each) for sign in (1, -1))
        slopes = (ahead - behind) / (2 * steps.T)  # (B, K, M)
        with np.errstate(invalid="ignore"):
            influence = slopes.transpose(2, 0, 1) @ by_measure  # (M, B, G)
            return statistic(sums), np.sqrt(np.einsum("bg,mbg->bm", counts, influence**2))

    generator = np.random.default_rng(seed)
    value, error = (row[0] for row in linearised(np.ones((1, clusters))))
    rounding = 1e-9 * np.maximum(np.abs(value), 1.0)
    error = np.where(error > rounding, error, 0.0)
    size = max(1, _CELLS // max(clusters * measures, measures * parts * parts))
    ratios = []
    for start in range(0, resamples, size):
        drawn = generator.integers(
            0, clusters, (min(size, resamples - start), clusters), dtype=np.int32
        )
        values, errors = linearised(_counts(drawn))
        with np.errstate(divide="ignore", invalid="ignore"):
            # a resample without variance says nothing of the ratio's distribution
            ratios.append(np.where(errors > 1e-6 * error, (values - value) / errors, math.nan))
    all_ratios = np.concatenate(ratios)
    all_ratios[:, np.isnan(all_ratios).all(axis=0)] = 0.0
    tail = (1 - LEVEL) / 2
    low, high = np.nanquantile(all_ratios, [tail, 1 - tail], axis=0)
    dof = np.maximum(held - 1, 1)
    student = stats.t.ppf(1 - tail, dof) * np.sqrt((dof + 1) / dof)
    error = np.where(held >= MIN_CLUSTERS, error, math.nan)
    return value - np.maximum(high, student) * error, value - np.minimum(low, -student) * error


def _counts(drawn: NDArray[np.int32]) -> Floats:
    """(B, G) how often each of G clusters is among (B, G) drawn ones."""
    batch, clusters = drawn.shape
    offset = np.arange(0, batch * clusters, clusters, dtype=np.int64)[:, None]
    counts = np.bincount((drawn + offset).ravel(), minlength=batch * clusters)
    return counts.reshape(batch, clusters).astype(np.float64)


def swap_p_values(
    first: FrameTable, other: FrameTable, clusters: Ints, resamples: int, seed: int
) -> tuple[Floats, bool]:
    """Returns `sign_flip_p_values` of the means of paired tables."""
    a, b = (table.cluster_totals(clusters) for table in (first, other))
    moves, shape = (b - a).reshape(len(a), -1), a.shape[1:]

    def difference(flips: Floats) -> Floats:
        moved = (flips @ moves).reshape(-1, *shape)
        return other.mean_of(b.sum(axis=0) - moved) - first.mean_of(a.sum(axis=0) + moved)

    return sign_flip_p_values(difference, len(a), resamples, seed)


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
    observed = np.abs(difference(np.zeros((1, clusters)))[0])

    def differs_as_much(flips: Floats, _: Floats, axis: int) -> Floats:
        # rounding must not make an equal difference look smaller than the observed one
        as_much = np.abs(difference(np.atleast_2d(flips))) >= observed * (1 - 1e-9)
        return np.asarray(as_much, np.float64)

    exact = clusters < 60 and 2**clusters <= resamples
    if clusters < 2:
        return np.full(len(observed), math.nan), exact
    result = stats.permutation_test(
        (np.zeros(clusters), np.ones(clusters)),
        differs_as_much,
        permutation_type="samples",
        vectorized=True,
        n_resamples=np.inf if exact else resamples,
        batch=max(1, _CELLS // clusters),
        alternative="greater",
        axis=-1,
        random_state=np.random.default_rng(seed),
    )
    return np.where(np.isfinite(observed), np.ravel(result.pvalue), math.nan), exact


def holm(p_values: Floats) -> Floats:
    """Returns (M,) p-values adjusted for testing M hypotheses (Holm 1979); NaN stays NaN."""
    order = np.argsort(p_values)
    order = order[np.isfinite(p_values[order])]
    adjusted = np.full(len(p_values), math.nan)
    steps = p_values[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted
