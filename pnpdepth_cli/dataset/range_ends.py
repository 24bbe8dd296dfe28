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
_SAME = 0.005
"""Of the numbers, that no surface shares."""
_LEAST_SAME = 3
"""How many these are at least."""
_EQUAL = 1e-5
"""Relative difference of numbers that were computed from one."""
_NOISY = 0.02
"""Relative difference of numbers that noise was added to."""
_BEYOND = 10.0
"""Times the 98th percentile of the rest, which edges of the sky may exceed."""
_BEYOND_MOST = 8.0
"""Times the 90th percentile of the rest, where all are exactly the same."""
_ABOVE = 1.5
"""Times the largest of the rest."""
_FAR_M = 40.0
"""Beyond it, surfaces are rare."""
_NEAR_M = 0.12
"""Nearer, surfaces are rare."""
_SPIKE = 3.0
"""Times as many as have any other value."""
_LEAST_SPIKE = 10
"""How many these are at least."""
_NEXT = 10
"""Distinct values beside an extreme one, of which one may have as many."""
_VALUES = 20
"""Distinct values; fewer are of a drawing."""
_FAR = 1000.0
"""Times the median depth; no point of an image is farther."""


class _End(NamedTuple):
    """What lies at the end of a range; numbers are depths, or 1/depths."""

    is_none: Mask  # (N,)
    value: float  # the extreme one
    rest: float  # 98th percentile of the others


def far_values(depth: NDArray[np.floating], unit: str = "m") -> tuple[Mask, list[str]]:
    """Returns which of the known depths (N,) are no depth, and lines for a person."""
    values = np.asarray(depth, np.float64)
    none = np.zeros(len(values), bool)
    lines = list[str]()
    # One value for many, at either end.
    far = far_end(values)
    near = near_end(values)
    for found, what, most in (
        (far, "of the sky or a far plane", f"at most {metres(far.rest)}"),
        (near, "of no surface", f"at least {metres(near.rest)}"),
    ):
        if found.is_none.any():
            none |= found.is_none
            lines.append(
                f"{np.count_nonzero(found.is_none):,} of {len(values):,} depths are {what}, at"
                f" {metres(found.value)} {unit}, where 98 % of the others are {most} {unit}; taken"
                " as unknown"
            )
    if none.any():
        return none, lines
    # Single values far beyond all others.
    median = float(np.median(values)) if len(values) >= _FEW else math.inf
    none = values > _FAR * median
    if none.any():
        return none, [
            f"dropped {np.count_nonzero(none):,} of {len(values):,} points more than {_FAR:,.0f}"
            f" times as far as the median of {metres(median)} {unit}; the farthest was at"
            f" {metres(float(values.max(initial=0)))} {unit}"
        ]
    return none, _clip_lines(values, unit)


def far_end(values: Floats) -> _End:
    """Returns which of depths (N,) above 0 are of the sky or a far plane, and its depth."""
    return _end(values, _FAR_M)


def near_end(values: Floats) -> _End:
    """Returns which of depths (N,) above 0 stand for an unknown one, and its value."""
    none = _End(np.zeros(len(values), bool), 0.0, 0.0)
    if not len(values) or float(values.min()) > _NEAR_M:
        return none
    with np.errstate(divide="ignore"):
        end = _end(1 / values, 1 / _NEAR_M)
    if not end.is_none.any() or len(np.unique(values)) < _VALUES:
        return none
    return _End(end.is_none, 1 / end.value, 1 / end.rest)


def repeated_ends(values: NDArray[np.float32]) -> list[tuple[float, int]]:
    """Returns extreme values that many of the numbers (N,) are exactly, and how many are.

    The numbers are a network's, of any meaning and sign. What it computes for a surface has no one
    value, and if it is stored in steps, a step at the end holds no more than those before it. So
    one value for many at either end is the sky, a clip, a far plane, or stands for unknown.
    """
    found = list[tuple[float, int]]()
    enough = max(_LEAST_SPIKE, _SAME * len(values))
    if not len(values) or enough > max(
        np.count_nonzero(values == values.min()), np.count_nonzero(values == values.max())
    ):
        return found
    distinct, counts = np.unique(values, return_counts=True)
    for step in (1, -1):  # from the smallest up, from the largest down
        inwards = distinct[::step]
        counts_inwards = counts[::step]
        at = 0
        # Behind one such value there may be another: unknown as -1, and a clip.
        while len(distinct) - at > _VALUES and counts_inwards[at] >= enough:
            usual = np.sort(counts_inwards[at + 1 : at + 1 + _NEXT])[-2]
            if counts_inwards[at] < _SPIKE * usual:
                break
            found.append((float(inwards[at]), int(counts_inwards[at])))
            at += 1
    return found


def _end(values: Floats, beyond: float) -> _End:
    """What is at the upper end of numbers (N,).

    Args:
        values: The numbers.
        beyond: Number beyond which one that many share is no surface's.
    """
    none = _End(np.zeros(len(values), bool), 0.0, 0.0)
    if len(values) < _FEW:
        return none
    # Many are nearly the largest.
    largest = float(values.max())
    enough = max(_LEAST_SAME, _SAME * len(values))
    alike = values >= largest * (1 - _NOISY)
    if np.count_nonzero(alike) < enough:
        return none
    # The others, but for further values that many share.
    distinct, place, counts = np.unique(
        values.astype(np.float32), return_inverse=True, return_counts=True
    )
    others = values[~alike]
    rest = others
    if len(distinct) >= _VALUES and np.count_nonzero(counts >= enough) <= _FEW:
        rest = values[~(alike | (counts[place] >= enough))]
    # Most are of few values, as of a drawing.
    if rest.size < len(others) / 2 or not rest.size:
        rest = others
    if not rest.size:
        return none
    # Far beyond the others, also with the mixtures that a renderer makes at edges of the sky.
    most = float(np.quantile(rest, 0.98))
    if largest >= _BEYOND * most:
        return _End(values > math.sqrt(largest * most), largest, most)
    # Exactly the same, and beyond the others.
    same = values >= largest * (1 - _EQUAL)
    rest = values[~same]
    if np.count_nonzero(same) < enough or not rest.size or largest < beyond:
        return none
    if largest >= _ABOVE * float(rest.max()):
        return _End(same, largest, most)
    usual = float(np.quantile(rest, 0.9))
    if largest >= _BEYOND_MOST * usual:
        return _End(values > math.sqrt(largest * usual), largest, usual)
    return none


def _clip_lines(values: Floats, unit: str) -> list[str]:
    """Lines on an end that may be a clip: far more depths have its value than any other."""
    distinct, counts = np.unique(values.astype(np.float32), return_counts=True)
    if len(distinct) < _VALUES:
        return []
    lines = list[str]()
    for at, name in ((-1, "largest"), (0, "smallest")):
        least = max(_LEAST_SPIKE, _SAME * len(values), _SPIKE * float(np.delete(counts, at).max()))
        if counts[at] >= least:
            lines.append(
                f"warning: {counts[at] / len(values):.1%} of the depths have the {name} one,"
                f" {float(distinct[at]):.6g} {unit} exactly, as of a clip, a sensor's range or a"
                " far plane; they count as depth, unless a mask rules them out"
            )
    return lines
