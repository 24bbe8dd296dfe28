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
from numpy.typing import NDArray
from scipy import stats
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
        self._steps = torch.diag(
            _STEP * torch.from_numpy(totals).abs().mean(dim=0).clamp_min(1e-300)
        )

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
        return values.numpy(), variances.nan_to_num(0.0).clamp_min(0).sqrt().numpy()

    def _covariances(self, counts: Floats) -> Floats:
        """(B, C, C) sums over the clusters of products of totals, centred in each resample."""
        rows, columns = self._upper
        sums = counts @ self._centred
        centred = counts @ self._products - sums[:, rows] * sums[:, columns] / len(self._totals)
        covariances = np.empty((len(counts), sums.shape[1], sums.shape[1]))
        covariances[:, rows, columns] = centred
        covariances[:, columns, rows] = centred
        return covariances


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
