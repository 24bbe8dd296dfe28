"""Two depths of the same pixels: how their order and their ratio agree."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_MOST = 20_000
"""Pairs that are compared at least, where there are as many; always fewer than twice this."""
_QUANTILES = (0.16, 0.5, 0.84)
"""Quantiles at which normal values are a standard deviation below the mean, at it, and above."""
FEWEST_PAIRS = 10
"""Fewer pairs decide nothing."""
_CLEAR = 0.5
"""Rank correlation, of either sign, from which the order of two depths is clear."""
_STANDARD_ERRORS = 4.0
"""Standard errors of a rank correlation above which chance does not explain it."""
OTHER_UNIT = math.log(1.5)
"""Log ratio that noise does not explain."""
TIGHT = 0.25
"""Spread of the log ratio of depths that differ by a unit, at most."""
_EXACT = TIGHT / 5
"""Spread below which a factor explains everything, so that the order need not be seen."""


class Agreement(NamedTuple):
    """How two depths of the same pixels agree."""

    pairs: int
    """Number of pixels that both know."""
    rank: float
    """Spearman's rank correlation, −1…1; 0 of values without order."""
    ratio: float
    """Median of first / second; NaN without pairs."""
    spread: float
    """Half of the range that holds the middle 68 % of log(first / second); NaN without pairs."""

    @property
    def is_reversed(self) -> bool:
        """Whether larger values of one are nearer in the other, as of depth and disparity."""
        return is_reversed(self.rank, self.pairs)

    @property
    def is_ordered(self) -> bool:
        """Whether larger values of one are farther in the other, as of two depths."""
        return is_reversed(-self.rank, self.pairs)

    @property
    def is_unit(self) -> bool:
        """Whether a factor, far from 1, explains the difference of the two, as of another unit."""
        # Of few pairs the ratio says nothing, and near 1 it is noise.
        if self.pairs < FEWEST_PAIRS or abs(math.log(self.ratio)) <= OTHER_UNIT:
            return False
        # Two depths that differ by a unit have one order; of a wall the order is noise, but then
        # the ratio is the same everywhere.
        is_alike = self.rank >= _CLEAR or self.spread < _EXACT
        return is_alike and self.spread <= TIGHT


def compare_depths(first: NDArray[np.floating], second: NDArray[np.floating]) -> Agreement:
    """Returns the rank correlation of two depths, and the median and spread of their ratio.

    Without pixels that both know, the rank correlation is 0, and median and spread are NaN.

    Args:
        first: Depths of any shape, not above 0 where unknown.
        second: The others, of the same shape and pixels.
    """
    both = (first > 0) & (second > 0)
    pairs = np.stack([first[both], second[both]]).astype(np.float64)  # (2, N)
    count = pairs.shape[1]
    if not count:
        return Agreement(pairs=0, rank=0.0, ratio=math.nan, spread=math.nan)
    # Of many pairs every second, third and so on, by the step of the slice.
    compared = pairs[:, :: max(1, count // _MOST)]
    log_ratio = np.log(compared[0]) - np.log(compared[1])
    low, middle, high = np.quantile(log_ratio, _QUANTILES).tolist()
    rank = rank_correlation(compared[0], compared[1])
    return Agreement(pairs=count, rank=rank, ratio=math.exp(middle), spread=(high - low) / 2)


def rank_correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Returns Spearman's rank correlation of finite numbers (N,), 0 of numbers without order."""
    ranks = np.stack([_ranks(first), _ranks(second)])
    ranks -= ranks.mean(axis=1, keepdims=True)
    norms = float(np.linalg.norm(ranks[0]) * np.linalg.norm(ranks[1]))
    return float(ranks[0] @ ranks[1]) / norms if norms > 0 else 0.0


def is_reversed(rank: float, pairs: int) -> bool:
    """Returns whether a rank correlation, −1…1, of some pairs is clearly below 0, not by chance."""
    # Without any order the standard error is 1 / √(pairs − 1).
    standard_errors = -rank * math.sqrt(max(pairs - 1, 0))
    return rank < -_CLEAR and standard_errors > _STANDARD_ERRORS


def _ranks(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """The rank (N,) of each value (N,) from 1, which is the mean rank for equal values.

    As scipy.stats.rankdata gives them, whose import takes as long as all other imports of SciPy.
    """
    _, number, count = np.unique(values, return_inverse=True, return_counts=True)
    # Equal values have the ranks up to their cumulative count; the mean is in the middle of these.
    mean_rank = np.cumsum(count) - (count - 1) / 2
    return np.asarray(mean_rank[number], np.float64)
