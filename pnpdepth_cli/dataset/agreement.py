"""Two depths of one frame: how their order and their ratio agree, and what follows.

Of a unit or a scale that is wrong, the ratio of the two is the same everywhere. Of a kind that is
wrong, such as disparity, their order is reversed. A median alone tells neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.formats import Reading

_MOST = 20_000  # pairs that are compared; more tell no more
_FEWEST = 10  # pairs; fewer decide nothing
_CLEAR = 0.5  # rank correlation, of either sign, from which the order of two depths is clear
_STANDARD_ERRORS = 4.0  # of the rank correlation, by which chance does not explain it
_OTHER_UNIT = math.log(1.5)  # of the ratio, which noise does not explain
_OTHER_FIT = math.log(3.0)  # of the ratio of a prediction, which a network's own scale explains
_TIGHT = 0.25  # spread of the log ratio of depths that differ by a unit
_SCALES = (1000.0, 256.0, 5000.0, 100.0, 10.0, 1.0, 4000.0, 6553.5, 39.3701, 3.28084)
"""Numbers per metre in use. Millimetres, KITTI, TUM, cm, dm, m, 0.25 mm, Replica, inches, feet."""
_ROUNDED = 0.05  # log ratio to the nearest of these, which is then meant
_ROUNDED_FIT = 0.15  # the same of the depth of a network, which is biased


class Agreement(NamedTuple):
    """How two depths of the same pixels agree."""

    pairs: int
    """Number of pairs that both know."""
    rank: float
    """Spearman's rank correlation, −1…1; 0 of values without order."""
    ratio: float
    """Median of first / second; NaN without pairs."""
    spread: float
    """Half of the range that holds the middle 68 % of the log ratio."""

    @property
    def is_reversed(self) -> bool:
        """Whether larger values of one are nearer in the other, as of depth and disparity."""
        return self._is_certain and self.rank < -_CLEAR

    @property
    def is_ordered(self) -> bool:
        """Whether larger values of one are farther in the other, as of two depths."""
        return self._is_certain and self.rank > _CLEAR

    @property
    def _is_certain(self) -> bool:
        """Whether chance does not explain the rank correlation."""
        return abs(self.rank) * math.sqrt(max(self.pairs - 1, 0)) > _STANDARD_ERRORS

    @property
    def is_unit(self) -> bool:
        """Whether a factor, far from 1, explains the difference of the two."""
        off = self.pairs >= _FEWEST and abs(math.log(self.ratio)) > _OTHER_UNIT
        # of a wall, the order is noise
        ordered = self.rank >= _CLEAR or self.spread < _TIGHT / 5
        return off and self.spread <= _TIGHT and ordered


def compare_depths(first: NDArray[np.floating], second: NDArray[np.floating]) -> Agreement:
    """Returns the rank correlation of two depths, and the median and spread of their ratio.

    Args:
        first: Depths of any shape, not above 0 where unknown.
        second: The others, of the same shape and pixels.
    """
    both = (first > 0) & (second > 0)
    values = np.stack([first[both], second[both]]).astype(np.float64)
    count = values.shape[1]
    if not count:
        return Agreement(0, 0.0, math.nan, math.nan)
    values = values[:, :: max(1, count // _MOST)]
    log_ratio = np.log(values[0]) - np.log(values[1])
    low, middle, high = np.quantile(log_ratio, (0.16, 0.5, 0.84)).tolist()
    ranks = np.stack([_ranks(each) for each in values])
    ranks -= ranks.mean(axis=1, keepdims=True)
    length = float(np.linalg.norm(ranks[0]) * np.linalg.norm(ranks[1]))
    rank = float(ranks[0] @ ranks[1]) / length if length > 0 else 0.0
    return Agreement(count, rank, math.exp(middle), (high - low) / 2)


def _ranks(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """The ranks (N,) of values (N,) from 1, the mean rank for equal ones.

    As scipy.stats.rankdata gives them, whose import takes as long as all other imports of SciPy.
    """
    _, number, count = np.unique(values, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(count) - (count - 1) / 2
    return np.asarray(mean_rank[number], np.float64)


def check_order(what: str, first: NDArray[np.floating], second: NDArray[np.floating]) -> str | None:
    """Returns what reads a depth whose order is reversed in another one of the frame, else None.

    Args:
        what: Both depths, as a sentence begins.
        first: The depth that may be disparity, not above 0 where unknown.
        second: The other depth in metres.
    """
    found = compare_depths(first, second)
    if not found.is_reversed:
        return None
    inverse = np.divide(1.0, second, out=np.zeros(second.shape), where=second > 0)
    product = compare_depths(first, inverse)  # first · second
    fact = (
        f"{what} have opposite orders (rank correlation {found.rank:.2f} of {found.pairs:,}"
        " pixels): larger values are nearer in one of them, as of disparity and 1/depth"
    )
    if product.spread > _TIGHT:
        return f"{fact}; their product is not constant, so that no baseline · focal length fits"
    kind = f"disparity:{product.ratio:.4g}"
    if abs(math.log(product.ratio)) < _ROUNDED:
        kind = "inverse"
    return (
        f"{fact}. Their product is {product.ratio:.4g} (median), so --sparse-kind {kind} reads the"
        f" sparse depth if that is it, and --gt-kind {kind} of eval, or gt_kind of a list, the"
        " ground truth"
    )


def unit_warning(
    what: str, found: Agreement, readings: Mapping[str, Reading | None], *, fitted: bool = False
) -> str | None:
    """Returns a warning if depths are a multiple of the ground truth.

    Where the ratio is the same everywhere, a unit is wrong, and the option that removes it is
    named. Where it varies, no quotient explains it, and none is advised.

    Args:
        what: The depths, in the plural.
        found: Agreement of the depths with the ground truth.
        readings: How the depths were read, then the ground truth, by the option of the scale.
        fitted: Whether the depths are those of a network, whose scale may be its own.

    Raises:
        InputError: There is such a multiple, and one of the scales was assumed.
    """
    if found.pairs < _FEWEST:
        return None
    times = (
        f"{what} are {found.ratio:.4g} times the ground truth (median of {found.pairs:,} pixels)"
    )
    if not found.is_unit:
        if abs(math.log(found.ratio)) <= (_OTHER_FIT if fitted else _OTHER_UNIT):
            return None
        way_out = "; --scale-by fits each image" if fitted else ""
        return (
            f"warning: {times}, but the ratio varies by a factor of {math.exp(found.spread):.2g}"
            f" over the image, so that no unit or scale explains it{way_out}"
        )
    # A scale of integers, of which the file itself is sure or not, by which the ratio becomes 1.
    within = _ROUNDED_FIT if fitted else _ROUNDED
    sides = zip(readings.items(), (found.ratio, 1 / found.ratio), strict=True)
    stored = [(option, read, by) for (option, read), by in sides if read is not None]
    integer = [side for side in stored if side[1].scale is not None]
    unstated = [side for side in integer if "(from the file)" not in side[1].source]
    advice = " or ".join(
        f"{option} {_common((read.scale or 1) * by, within):.6g} (now {read.scale or 1:g})"
        for option, read, by in unstated or integer or stored
    )
    fact = (
        f"{times}, and the ratio is the same everywhere (within a factor of"
        f" {math.exp(found.spread):.2f}), so a scale is probably wrong; {advice} would"
        " remove it"
    )
    if assumed := [f"{option} {read.scale:g}" for option, read, _ in integer if read.assumed]:
        raise InputError(f"{fact}, {' '.join(assumed)} keeps it")
    return f"warning: {fact}"


def _common(scale: float, within: float) -> float:
    """The scale in use that is meant by one that was estimated; else that one."""
    nearest = min(_SCALES, key=lambda each: abs(math.log(each / scale)))
    return nearest if abs(math.log(nearest / scale)) < within else scale
