"""How sure means over clusters of frames are: the bootstrap, permutations, and Holm's correction.

Permutations are those of scipy.stats. Its bootstrap has no studentised interval, which few values
of skewed errors need, and it adjusts p-values only for the false discovery rate; both are here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from pnpdepth_cli.core.metrics import measures_of

Floats = NDArray[np.float64]

LEVEL = 0.95
_STEP = 1e-5
"""Of the numerical derivative, relative to the totals of a cluster; its error is near 1e-10."""
_CELLS = 1 << 21
"""Weights held at once, so that memory stays bounded for any number of clusters."""


@dataclass(frozen=True, kw_only=True)
class FrameTable:
    """The scores of N frames, from which the means of any weighting of the frames follow."""

    rows: Floats
    """(N, M) measures of each frame; where pixels are pooled, (N, len(SUMS)) sums over pixels."""
    pooled: bool = False
    """True if the mean is over the pixels of all frames."""
    kept: tuple[int, ...] | None = None
    """Of a pooled table: which of core.metrics.MEASURES the means are; None for all."""

    def mean(self) -> Floats:
        """Returns (M,) the means over all frames."""
        totals = self.cluster_totals(np.zeros(len(self.rows), np.int64))[0]
        return np.asarray(self.means_of(torch.from_numpy(totals)).numpy())

    def cluster_totals(self, clusters: NDArray[np.int64]) -> Floats:
        """Returns (G, C) the sums of the rows of each cluster, and in the last column its frames.

        Args:
            clusters: (N,) the cluster of each frame, from 0 to G − 1.
        """
        rows = np.column_stack([self.rows, np.ones(len(self.rows))])
        totals = np.zeros((int(clusters.max()) + 1, rows.shape[1]))
        np.add.at(totals, clusters, rows)
        return totals

    def means_of(self, totals: Tensor) -> Tensor:
        """Returns (…, M) the means of frames whose `cluster_totals` add up to (…, C)."""
        if not self.pooled:
            return totals[..., :-1] / totals[..., -1:]
        means = measures_of(totals[..., :-1])
        return means if self.kept is None else means[..., list(self.kept)]


def known_together(known: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.bool_], list[int]]]:
    """Yields (N,) frames and the measures that exactly these frames have.

    Args:
        known: (N, M) whether a frame has a measure.
    """
    patterns, pattern_of = np.unique(known, axis=1, return_inverse=True)
    for number, frames in enumerate(patterns.T):
        yield frames, np.flatnonzero(pattern_of.ravel() == number).tolist()


def clusters_among(ids: NDArray[np.int64], frames: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Returns the clusters of some of the frames, numbered from 0 without a gap."""
    return np.unique(ids[frames], return_inverse=True)[1].astype(np.int64)


def studentised_interval(
    statistic: Callable[[Tensor], Tensor], totals: Floats, resamples: int, seed: int
) -> tuple[Floats, Floats]:
    """Returns (M,), (M,): the ends of the 95 % interval of statistic(totals.sum(0)).

    Each end is that of the bootstrap-t (Efron and Tibshirani 1993, section 12.5) or of Student's t,
    whichever is farther out: the first follows the skewness of the errors, the second the error of
    a standard error from few clusters. Standard errors are linearised in the totals (infinitesimal
    jackknife). NaN where the statistic is NaN.

    Args:
        statistic: From totals (…, C) to (…, M); differentiable, and unchanged where the totals are
            multiplied.
        totals: (G, C) of each cluster; clusters are resampled whole.
        resamples: How many bootstrap samples are drawn.
        seed: Of the drawing.
    """
    clusters = len(totals)
    moments = _Moments(statistic, totals)
    generator = np.random.default_rng(seed)
    value, error = (row[0] for row in moments.linearised(np.ones((1, clusters))))
    ratios = []
    for size in _batches(resamples, clusters):
        drawn = generator.integers(0, clusters, (size, clusters), dtype=np.int32)
        values, errors = moments.linearised(_counts(drawn))
        with np.errstate(divide="ignore", invalid="ignore"):
            # a resample without variance says nothing of the ratio's distribution
            ratios.append(np.where(errors > 1e-6 * error, (values - value) / errors, np.nan))
    tail = (1 - LEVEL) / 2
    all_ratios = np.concatenate(ratios)
    none = np.isnan(all_ratios).all(axis=0)  # all clusters are alike: nothing varies
    all_ratios[:, none] = 0.0
    low_ratio, high_ratio = np.nanquantile(all_ratios, [tail, 1 - tail], axis=0)
    student = stats.t.ppf(1 - tail, clusters - 1) * math.sqrt(clusters / (clusters - 1))
    low, high = np.minimum(low_ratio, -student), np.maximum(high_ratio, student)
    return value - high * error, value - low * error


class _Moments:
    """The statistic and its standard error, from first and second moments of the clusters."""

    def __init__(self, statistic: Callable[[Tensor], Tensor], totals: Floats) -> None:
        self._statistic = statistic
        self._totals = totals
        # centred, so that little cancels in the second moments
        self._centred = totals - totals.mean(axis=0)
        columns = totals.shape[1]
        self._upper = np.triu_indices(columns)
        self._products = self._centred[:, self._upper[0]] * self._centred[:, self._upper[1]]
        # central differences: a backward pass would carry the NaN of one measure into the others
        steps = _STEP * torch.from_numpy(totals).abs().mean(dim=0).clamp_min(1e-300)
        self._steps = torch.diag(steps.nan_to_num(1.0))

    def linearised(self, counts: Floats) -> tuple[Floats, Floats]:
        """Returns (B, M) the statistic where clusters count as (B, G), and (B, M) its errors."""
        resampled = torch.from_numpy(counts @ self._totals)
        values = self._statistic(resampled)
        ahead, behind = (
            self._statistic(resampled[:, None] + sign * self._steps) for sign in (1, -1)
        )
        slopes = ((ahead - behind) / (2 * self._steps.diagonal()[:, None])).transpose(-1, -2)
        variances = torch.einsum(
            "bmc,bcd,bmd->bm", slopes, torch.from_numpy(self._covariances(counts)), slopes
        )
        return values.numpy(), variances.clamp_min(0).sqrt().numpy()

    def _covariances(self, counts: Floats) -> Floats:
        """(B, C, C) sums over the clusters of products of totals, centred in each resample."""
        rows, columns = self._upper
        sums = counts @ self._centred
        centred = counts @ self._products - sums[:, rows] * sums[:, columns] / len(self._totals)
        covariances = np.empty((len(counts), sums.shape[1], sums.shape[1]))
        covariances[:, rows, columns] = centred
        covariances[:, columns, rows] = centred
        # a column with NaN is of a measure that is NaN; it must not reach the other measures
        return np.nan_to_num(covariances, nan=0.0)


def _counts(drawn: NDArray[np.int32]) -> Floats:
    """(B, G) how often each of G clusters is among (B, G) drawn ones."""
    batch, clusters = drawn.shape
    drawn += np.arange(0, batch * clusters, clusters, dtype=np.int32)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=batch * clusters)
    return counts.reshape(batch, clusters).astype(np.float64)


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
    return np.where(np.isfinite(observed), np.ravel(result.pvalue), np.nan), exact


def holm(p_values: Floats) -> Floats:
    """Returns (M,) p-values adjusted for testing M hypotheses (Holm 1979); NaN stays NaN."""
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
