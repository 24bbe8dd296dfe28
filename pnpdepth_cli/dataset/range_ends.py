"""Both ends of the range of depths: what is one and the same extreme value is no surface.

Unknown depth, beams without return, the sky and clips have one value for many, at the far end or at
the near one. One rule holds for both: depths of the near end are those of the far end of 1/depth.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.depth import metres

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FEW = 10
"""Numbers; fewer decide nothing."""
_FEW_VALUES = 20
"""Different numbers; fewer are of a drawing."""
_FAR = 1000.0
"""Times the median depth; no point of an image is farther."""

# How many have an extreme value that is no surface.
_SAME = 0.005
"""Fraction of the numbers that no surface shares."""
_LEAST_SAME = 3
"""Numbers that these are at least."""
_EQUAL = 1e-5
"""Relative difference of numbers that were computed from one."""
_NOISY = 0.02
"""Relative difference of numbers that noise was added to."""

# How far it is from all others.
_BEYOND = 10.0
"""Times the 98th percentile of the others, which edges of the sky may exceed."""
_BEYOND_MOST = 8.0
"""Times the 90th percentile of the others, where all at the end are exactly the same."""
_ABOVE = 1.5
"""Times the largest of the others."""
_FAR_M = 40.0
"""Beyond it, surfaces are rare."""
_NEAR_M = 0.12
"""Nearer, surfaces are rare."""

# An extreme value that is not far from all others.
_SPIKE = 3.0
"""Times as many numbers as have any other value."""
_LEAST_SPIKE = 10
"""Numbers that these are at least."""
_NEXT = 10
"""Different values beside an extreme one, of which one may be as frequent."""


class _End(NamedTuple):
    """What lies at one end of a range of numbers, which are depths or 1/depths."""

    is_no_surface: Mask  # (N,) which numbers are of no surface; none of them if the end is one
    value: float  # the extreme number; 0 if the end is a surface
    reach: float  # number that 98 % of the others do not exceed; 0 if it is a surface


def far_values(depth: NDArray[np.floating], unit: str = "m") -> tuple[Mask, list[str]]:
    """Returns which of the known depths (N,) are no depth, and lines for a person.

    Args:
        depth: The known depths, above 0, in `unit`.
        unit: Name of the unit, for the lines.
    """
    values = np.asarray(depth, np.float64)
    is_no_depth = np.zeros(len(values), bool)
    lines = list[str]()
    # One value for many, at either end.
    far = far_end(values)
    near = near_end(values)
    for end, what, reach in (
        (far, "of the sky or a far plane", f"at most {metres(far.reach)}"),
        (near, "of no surface", f"at least {metres(near.reach)}"),
    ):
        if end.is_no_surface.any():
            is_no_depth |= end.is_no_surface
            lines.append(
                f"{np.count_nonzero(end.is_no_surface):,} of {len(values):,} depths are {what}, at"
                f" {metres(end.value)} {unit}, where 98 % of the others are {reach} {unit}; taken"
                " as unknown"
            )
    if is_no_depth.any():
        return is_no_depth, lines
    # Single values far beyond all others.
    median = float(np.median(values)) if len(values) >= _FEW else math.inf
    is_no_depth = values > _FAR * median
    if is_no_depth.any():
        return is_no_depth, [
            f"dropped {np.count_nonzero(is_no_depth):,} of {len(values):,} points more than"
            f" {_FAR:,.0f} times as far as the median of {metres(median)} {unit}; the farthest was"
            f" at {metres(float(values.max(initial=0)))} {unit}"
        ]
    return is_no_depth, _clip_lines(values, unit)


def far_end(depth: Floats) -> _End:
    """Returns which of depths (N,) above 0 are of the sky or a far plane, and its depth."""
    return _upper_end(depth, _FAR_M)


def near_end(depth: Floats) -> _End:
    """Returns which of depths (N,) above 0 are one small number that stands for unknown."""
    surface = _End(np.zeros(len(depth), bool), 0.0, 0.0)
    if not len(depth) or float(depth.min()) > _NEAR_M:
        return surface
    with np.errstate(divide="ignore"):
        end = _upper_end(1 / depth, 1 / _NEAR_M)
    if not end.is_no_surface.any() or len(np.unique(depth)) < _FEW_VALUES:
        return surface
    return _End(end.is_no_surface, 1 / end.value, 1 / end.reach)


def repeated_ends(numbers: NDArray[np.float32]) -> list[tuple[float, int]]:
    """Returns extreme values that many of the numbers (N,) are exactly, and how many are.

    The numbers are a network's, of any meaning and sign. What it computes for a surface has no one
    value, and if it is stored in steps, a step at the end holds no more than those before it. So
    one value for many at either end is the sky, a clip, a far plane, or stands for unknown. The
    values from the smallest up come first, then those from the largest down.
    """
    repeated = list[tuple[float, int]]()
    if not len(numbers):
        return repeated
    # Most maps have no such value, which is told without sorting them.
    least_count = max(_LEAST_SPIKE, _SAME * len(numbers))
    at_smallest = np.count_nonzero(numbers == numbers.min())
    at_largest = np.count_nonzero(numbers == numbers.max())
    if max(at_smallest, at_largest) < least_count:
        return repeated
    distinct, counts = np.unique(numbers, return_counts=True)
    for step in (1, -1):  # from the smallest up, from the largest down
        inwards = distinct[::step]
        counts_inwards = counts[::step]
        place = 0
        # Behind one such value there may be another: unknown as -1, and a clip.
        while len(distinct) - place > _FEW_VALUES and counts_inwards[place] >= least_count:
            # The second largest of the next counts, as one value may be as frequent.
            usual = np.sort(counts_inwards[place + 1 : place + 1 + _NEXT])[-2]
            if counts_inwards[place] < _SPIKE * usual:
                break
            repeated.append((float(inwards[place]), int(counts_inwards[place])))
            place += 1
    return repeated


def _upper_end(numbers: Floats, rare: float) -> _End:
    """What lies at the upper end of numbers (N,): a surface, or one value for many that is none.

    Args:
        numbers: Depths, or 1/depths.
        rare: Number beyond which surfaces are rare. Numbers beyond it that are exactly the same are
            no surface even where they are not far above all others.
    """
    surface = _End(np.zeros(len(numbers), bool), 0.0, 0.0)
    if len(numbers) < _FEW:
        return surface
    # Many are nearly the largest.
    largest = float(numbers.max())
    least_count = max(_LEAST_SAME, _SAME * len(numbers))
    is_alike = numbers >= largest * (1 - _NOISY)
    if np.count_nonzero(is_alike) < least_count:
        return surface
    others = _usual_numbers(numbers, is_alike, least_count)
    if not others.size:
        return surface
    # Far beyond the others, also with the mixtures that a renderer makes at edges of the sky: these
    # are above the geometric mean of the two.
    reach = float(np.quantile(others, 0.98))
    if largest >= _BEYOND * reach:
        return _End(numbers > math.sqrt(largest * reach), largest, reach)
    # Exactly the same, and beyond the others.
    is_same = numbers >= largest * (1 - _EQUAL)
    different = numbers[~is_same]
    if np.count_nonzero(is_same) < least_count or not different.size or largest < rare:
        return surface
    if largest >= _ABOVE * float(different.max()):
        return _End(is_same, largest, reach)
    reach_of_most = float(np.quantile(different, 0.9))
    if largest >= _BEYOND_MOST * reach_of_most:
        is_far = numbers > math.sqrt(largest * reach_of_most)
        return _End(is_far, largest, float(np.quantile(numbers[~is_far], 0.98)))
    return surface


def _usual_numbers(numbers: Floats, is_alike: Mask, least_count: float) -> Floats:
    """The numbers (M,) that are not at the end, and have no value that many share either.

    Shared values are left in where there are many of them or few different values, as in a drawing,
    and where most of the numbers have one.

    Args:
        numbers: (N,) all numbers.
        is_alike: (N,) which are at the end, of nearly one value.
        least_count: How many have a value that many share, at least.
    """
    others = numbers[~is_alike]
    distinct, index_of_value, counts = np.unique(
        numbers.astype(np.float32), return_inverse=True, return_counts=True
    )
    is_shared = counts >= least_count
    if len(distinct) < _FEW_VALUES or np.count_nonzero(is_shared) > _FEW:
        return others
    unshared = numbers[~(is_alike | is_shared[index_of_value])]
    if not unshared.size or unshared.size < len(others) / 2:
        return others
    return unshared


def _clip_lines(depth: Floats, unit: str) -> list[str]:
    """Warnings if far more depths have the largest or the smallest value than any other.

    A drawing, of few values, gives none.

    Args:
        depth: (N,) known depths.
        unit: Name of their unit.
    """
    distinct, counts = np.unique(depth.astype(np.float32), return_counts=True)
    if len(distinct) < _FEW_VALUES:
        return []
    lines = list[str]()
    for place, name in ((-1, "largest"), (0, "smallest")):
        most_frequent = float(np.delete(counts, place).max())
        least_count = max(_LEAST_SPIKE, _SAME * len(depth), _SPIKE * most_frequent)
        if counts[place] >= least_count:
            lines.append(
                f"warning: {counts[place] / len(depth):.1%} of the depths have the {name} one,"
                f" {float(distinct[place]):.6g} {unit} exactly, as of a clip, a sensor's range or a"
                " far plane; they count as depth, unless a mask rules them out"
            )
    return lines
