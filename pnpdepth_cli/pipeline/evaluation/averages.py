"""Means over frames, and how sure they are: the bootstrap, and exact and sampled permutations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.core.metrics import measures_of

LEVEL = 0.95
_CELLS = 1 << 21
"""Weights held at once, so that memory stays bounded for any number of frames."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FrameTable:
    """N frames, a row each: their M measures, or where pixels are pooled the sums behind them."""

    rows: Floats
    pooled: bool = False

    def means(self, weights: Floats) -> Floats:
        """(B, M) the means in which the frames count as the weights (B, N), of sum N, say."""
        return self.of_totals(weights @ self.rows)

    def mean(self) -> Floats:
        """(M,) the means over all frames."""
        mean: Floats = self.of_totals(self.rows.sum(axis=0))
        return mean

    def of_totals(self, totals: Floats) -> Floats:
        """(…, M) the means of N frames whose rows add up to (…, columns)."""
        if self.pooled:
            return np.asarray(measures_of(torch.from_numpy(totals)).numpy())
        return np.asarray(totals / len(self.rows))


def bootstrap(
    means: Callable[[Floats], Floats], frames: int, resamples: int, seed: int
) -> tuple[Floats, Floats]:
    """(M,), (M,): ends of the percentile interval of what `means` gives for resampled frames.

    means: from weights (B, N) to (B, M). Efron and Tibshirani 1993, chapter 13. Not a number where
    a frame's measure is none.
    """
    generator = np.random.default_rng(seed)
    shares = np.full(frames, 1 / frames)
    drawn = [
        means(generator.multinomial(frames, shares, size=size).astype(np.float64))
        for size in _batches(resamples, frames)
    ]
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(np.concatenate(drawn), [tail, 1 - tail], axis=0)
    return low, high


def sign_flip_p_values(
    difference: Callable[[Floats], Floats], frames: int, resamples: int, seed: int
) -> tuple[Floats, bool]:
    """(M,) two-sided p-values of paired frames: how often swapping some pairs differs as much.

    difference: from flips (B, N), 0 or 1, to the differences of means (B, M). Exact, and said so,
    where all 2^N swaps are at most `resamples`; else so many random ones, the observed counted in.
    """
    observed = np.abs(difference(np.zeros((1, frames))))
    exact = frames < 60 and 2**frames <= resamples
    generator = np.random.default_rng(seed)
    total = 2**frames if exact else resamples
    as_large = np.zeros(observed.shape[1])
    done = 0
    for size in _batches(total, frames):
        if exact:
            numbers = np.arange(done, done + size)
            flips = (numbers[:, None] >> np.arange(frames)) & 1
        else:
            flips = generator.integers(0, 2, size=(size, frames))
        # rounding must not make a swap of nothing look smaller than what was observed
        floor = observed * (1 - 1e-9)
        as_large += (np.abs(difference(flips.astype(np.float64))) >= floor).sum(axis=0)
        done += size
    p_values = as_large / total if exact else (as_large + 1) / (total + 1)
    return np.where(np.isfinite(observed[0]), p_values, np.nan), exact


def _batches(total: int, frames: int) -> Iterator[int]:
    size = max(1, _CELLS // frames)
    for start in range(0, total, size):
        yield min(size, total - start)
