"""Whether a depth map with unknown pixels was resized by interpolation, by its numbers.

Interpolation mixes depth with 0, which stands for unknown, so depths run down to 0 beside unknown
pixels. At exactly half the size, a pixel is the mean of four, of which one to four are known, so
that neighbours have ratios such as 2.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_FEWEST_BESIDE = 100
"""Pixels beside unknown ones; fewer tell nothing."""
_RUN_DOWN = 0.15
"""Fraction of these pixels that are below half of a neighbour, from which a map was resized. It is
0.4 % at most in 36 maps of five sets, 10 % in the samples, and 22 to 80 % after a resize."""

# Neighbours of which one is twice the other; `_fraction_of_twice` says what maps have.
_NEAR_TWICE = 0.04
"""Difference of a log ratio from log 2, within which one of two neighbours is twice the other."""
_FEWEST_TWICE = 30
"""Pairs of such neighbours; any map may have fewer by chance."""
_LEAST_TWICE = 0.004
"""Fraction of all pairs that such pairs are at least, after a resize."""
_MORE_TWICE = 5.0
"""Times as many pairs as have a ratio a little below or above 2, at least, after a resize."""


def interpolation_warning(depth: NDArray[np.float32]) -> str | None:
    """Returns a warning if a map (H, W), 0 where unknown, was resized by interpolation, else None.

    A map whose pixels are all known, or nearly all, gives no warning.
    """
    # Known pixels with an unknown one among their eight neighbours.
    is_known = depth > 0
    window = np.ones((3, 3), np.uint8)
    has_only_known = cv2.erode(is_known.astype(np.uint8), window, borderValue=1) == 1
    is_beside = is_known & ~has_only_known
    count = int(np.count_nonzero(is_beside))
    if count < _FEWEST_BESIDE:
        return None
    # Depths that run down to 0 there.
    largest_neighbour = cv2.dilate(depth, window)[is_beside]
    is_low = depth[is_beside] < largest_neighbour / 2
    cause = "as of a map that was resized by interpolation, which mixes depth with unknown"
    way_out = "resize it by the nearest neighbour"
    if is_low.mean() >= _RUN_DOWN:
        return (
            f"warning: {is_low.mean():.0%} of {count:,} depths beside unknown pixels are below half"
            f" of a neighbour's, {cause}; {way_out}"
        )
    # Neighbours that are means of different numbers of known pixels.
    fraction = _fraction_of_twice(depth)
    if fraction is None:
        return None
    return (
        f"warning: {fraction:.1%} of neighbouring depths are one exactly twice the other, {cause};"
        f" {way_out}"
    )


def _fraction_of_twice(depth: NDArray[np.float32]) -> float | None:
    """The fraction of the pairs of neighbours, both known, in which one depth is twice the other.

    None where these pairs are so few that chance explains them. Depths of surfaces have the ratio 2
    no more often than a ratio a little below or above it. After a resize to half or a quarter, in
    30 maps of seven sets, 0.5 to 38 % of the pairs have the ratio 2. They are 6 to 500 times as
    many as those with a ratio a little off. Of maps that were not resized, 130 have 5 times as
    many, but in none of these they are more than 0.14 % of the pairs.

    Args:
        depth: (H, W), 0 where unknown.
    """
    # Neighbours in a row, then in a column.
    log_ratios = list[NDArray[np.float32]]()
    for first, second in ((depth[:, 1:], depth[:, :-1]), (depth[1:], depth[:-1])):
        are_known = (first > 0) & (second > 0)
        log_ratios.append(np.abs(np.log(first[are_known] / second[are_known])))
    off_twice = np.abs(np.concatenate(log_ratios) - np.log(np.float32(2)))
    twice = int(np.count_nonzero(off_twice < _NEAR_TWICE))
    # Chance: as many pairs have a ratio a little off 2. These are counted on both sides of it, in
    # windows that are together twice as wide, hence half of them.
    is_a_little_off = (off_twice > 2 * _NEAR_TWICE) & (off_twice < 4 * _NEAR_TWICE)
    by_chance = np.count_nonzero(is_a_little_off) / 2
    pair_count = len(off_twice)
    if twice < max(_FEWEST_TWICE, _LEAST_TWICE * pair_count, _MORE_TWICE * by_chance):
        return None
    return twice / pair_count
