"""The gate that every number from a sensor passes, from scans, maps, lists, bags and ground truth.

Each rule has one sentence and its evidence in numbers. It mends and counts, or it stops and names
the option that mends. Here are the rules of the unit. The others have files of their own:
`scan_returns`, `range_ends`, `resized_maps`, `pixel_checks`, and, of two files, `agreement`.

| rule | evidence | then |
|---|---|---|
| depth is in metres | the median; whole numbers in a float file | stops |
| metres reach beyond 1 | all within 0…1, up to 1 or mostly near it | stops |
| a deep view is near | floats of a median above 200 m, from near to twice as far | warns |
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset.range_ends import far_values
from pnpdepth_cli.dataset.resized_maps import interpolation_warning
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import metres
from pnpdepth_cli.io.formats import Reading

_FEW = 10
"""Depths; how fewer are distributed tells nothing."""
_MANY = 50
"""Depths; if so many are within 0…1, all of the file's numbers are made so."""
_CODES = 100.0
"""Median from which floats that are whole numbers are codes."""
_DEEP = 2.0
"""Times the 10 % quantile of the depths that the 90 % quantile is beyond, in a view from near to
far. Below an aircraft it is not."""
_COMMON_M = (0.2, 200.0)
"""The smallest and the largest median of nearly all frames."""
_MIDDLE_M = (0.5, 80.0)
"""The smallest and the largest median of most frames."""

# Scales that are proposed.
_COMMON_SCALES = (1000.0, 256.0, 5000.0, 100.0, 10.0, 1.0)
"""Codes per metre in use, most likely first: millimetres, KITTI, TUM RGB-D, cm, dm, m."""
_UNITS = (1000.0, 100.0, 39.3701, 10.0, 3.28084, 1.0, 4000.0, 200.0)
"""Numbers per metre that are no codes: mm, cm, inches, dm, feet, m; and steps of 0.25 and 5 mm."""

# Maps within 0…1.
_LARGEST_NORMALISED = 1.0001
"""Largest number of a map within 0…1, but for rounding."""
_REACHES_1 = 0.99
"""Largest number from which a map within 0…1 reaches its end, as a normalised one does."""
_NEAR_1 = 0.9
"""Median from which a map within 0…1 is a z-buffer, most of which is near 1."""

OF_DATA_SET = "the data set"
"""Stands for whose integers a scale is of, where nobody states it of the numbers at hand. Floats
are divided by it only where they cannot be metres, and nothing is said."""

MAPS = (0.02, 1000.0)
"""The smallest and the largest median, metres, of depth maps."""
SCANS = (0.05, 300.0)
"""The smallest and the largest median, metres, of ranges of scans."""


class DivisorToMetres(NamedTuple):
    """What numbers are divided by to be metres."""

    divisor: float
    notes: list[str]
    """Lines for a person, which name the numbers."""


def plausible_map(
    depth: NDArray[np.float32],
    reading: Reading,
    what: str,
    option: str,
    scale: float | None,
    *,
    of_integers: str = OF_DATA_SET,
) -> tuple[NDArray[np.float32], list[str]]:
    """Returns a depth map (H, W) in metres, 0 where it is no depth, and lines for a person.

    Args:
        depth: (H, W) as it was read, 0 where unknown. It is not changed.
        reading: Format of the file; integers have been divided by its scale.
        what: Name of the depths in lines for a person, such as "gt".
        option: Option of the command line that states the scale, for messages.
        scale: Numbers per metre that the user or the data set states. None: nothing is stated.
        of_integers: Where the integers are that `scale` is stated for, if not here: path of the
            frame's other file, or `OF_DATA_SET`. Floats are then divided only where they
            cannot be metres. Empty: it is stated for these very numbers.

    Raises:
        InputError: The depths are implausible in metres.
    """
    # Extreme values that are no depth become unknown.
    is_known = depth > 0
    is_no_depth, lines = far_values(depth[is_known])
    warning = interpolation_warning(depth)
    if warning is not None:
        lines.append(warning)
    kept = depth.copy()
    kept[is_known] = np.where(is_no_depth, np.float32(0), depth[is_known])
    # Of integers, the scale by which they were read counts as stated, also where it is assumed:
    # an assumed one is compared with the other file of the frame.
    divisor, notes = divisor_to_metres(
        kept[kept > 0], reading, what, option, scale or reading.scale, of_integers=of_integers
    )
    notes = [named(what, line) for line in lines] + notes
    return kept / np.float32(divisor), notes


def named(what: str, note: str) -> str:
    """Returns a line for a person that begins with the name of its depths; a warning's with both.

    Args:
        what: Name of the depths, such as "gt".
        note: The line. A warning begins with "warning: ", and so does what is returned.
    """
    text = note.removeprefix("warning: ")
    return f"{what}: {text}" if text == note else f"warning: {what}: {text}"


def divisor_to_metres(
    depth: NDArray[np.floating],
    reading: Reading,
    what: str,
    option: str,
    scale: float | None,
    medians: tuple[float, float] = MAPS,
    *,
    of_integers: str = OF_DATA_SET,
) -> DivisorToMetres:
    """Returns what depths are divided by to be metres: 1 if they are metres as they were read.

    A float file holds metres, unless the user states a scale of it. One scale may be stated of two
    files. If one of these holds integers, it is theirs, and floats are divided by it only where
    they cannot be metres.

    Args:
        depth: (N,) known depths, or ranges, as they were read.
        reading: Format of the file; integers have been divided by its scale.
        what: Name of the depths in lines for a person.
        option: Option of the command line that states the scale, for messages.
        scale: Numbers per metre that the user or the data set states. None: nothing is stated.
        medians: The smallest and the largest median, metres, that is plausible.
        of_integers: Where the integers are that `scale` is stated for, if not here: path of the
            frame's other file, or `OF_DATA_SET`. Floats are then divided only where they
            cannot be metres. Empty: it is stated for these very numbers.

    Raises:
        InputError: The depths are implausible, and nothing that the user states explains it.
    """
    if not depth.size:
        return DivisorToMetres(1.0, [])
    smallest, largest = medians
    median = float(np.median(depth))
    is_float = reading.scale is None
    float_scale = scale if is_float and scale != 1 else None
    # A scale that is stated of these floats is obeyed.
    if float_scale is not None and not of_integers:
        notes = [f"{what}: ÷ {float_scale:g}, as is stated"]
        median_m = median / float_scale
        if not smallest <= median_m <= largest:
            notes.append(
                f"warning: {what}: median {metres(median_m)} m is implausible with {option}"
            )
        return DivisorToMetres(float_scale, notes)
    # Floats of which nothing is stated are no metres if they are normalised.
    if is_float and scale is None:
        notes = _check_normalised(depth, median, what, option)
        if notes:
            return DivisorToMetres(1.0, notes)
    # What is plausible as it is read stays.
    doubt = _doubt_of(depth, median, medians, is_float=is_float)
    if doubt is None or (doubt == "deep" and scale == 1):
        if float_scale is None or of_integers in ("", OF_DATA_SET):
            return DivisorToMetres(1.0, [])
        note = (
            f"{what}: floats, read as metres; {option} {float_scale:g} is of the integers of"
            f" {of_integers}"
        )
        return DivisorToMetres(1.0, [note])
    # Else a scale that is stated of integers is of these floats, too, if it explains them.
    if float_scale is not None and smallest <= median / float_scale <= largest:
        note = f"{what}: ÷ {float_scale:g}, as {metres(median)} m are implausible"
        return DivisorToMetres(float_scale, [note])
    # A scale that nobody states stops; one that is stated stays, with a warning.
    fact = _describe_doubt(doubt, median, reading, what, option)
    is_stated = scale is not None or not (is_float or reading.assumed)
    if doubt == "deep" or is_stated:
        return DivisorToMetres(1.0, [f"warning: {fact}"])
    raise InputError(f"{fact}, {option} {reading.scale or 1:g} keeps it")


def _check_normalised(
    depth: NDArray[np.floating], median: float, what: str, option: str
) -> list[str]:
    """A warning on depths (N,) that are all within 0…1, if there are many; else none.

    Args:
        depth: The known depths.
        median: Their median.
        what: Name of the depths in lines for a person.
        option: Option of the command line that states the scale.

    Raises:
        InputError: They reach 1, or most are near it: they are normalised, or a z-buffer.
    """
    largest = float(depth.max())
    if depth.size < _MANY or largest > _LARGEST_NORMALISED:
        return []
    fact = f"{what}: all {depth.size:,} depths are within 0…1, up to {largest:.4g}"
    if largest >= _REACHES_1 or median >= _NEAR_1:
        raise InputError(
            f"{fact}, as of normalised depth or a z-buffer; {option} 1 keeps it as metres; another"
            " number of it divides"
        )
    return [
        f"warning: {fact}: are they metres? {option} 1 keeps it as metres; another number of it"
        " divides"
    ]


Doubt = Literal["codes", "median", "deep"]
"""Why depths may be no metres, if they are read as such.

- codes: floats that are whole numbers, and large
- median: it is beyond what frames have
- deep: floats that are far for a view from near to far, but possible
"""


def _doubt_of(
    depth: NDArray[np.floating], median: float, medians: tuple[float, float], *, is_float: bool
) -> Doubt | None:
    """Why depths (N,) may be no metres, if they are read as such. None: they are plausible.

    Args:
        depth: The known depths.
        median: Their median.
        medians: The smallest and the largest median, metres, that is plausible.
        is_float: Whether their file holds floats.
    """
    smallest, largest = medians
    are_enough = depth.size >= _FEW
    if is_float and are_enough and median >= _CODES and bool((np.rint(depth) == depth).all()):
        return "codes"
    if not smallest <= median <= largest:
        return "median"
    if is_float and are_enough and median > _COMMON_M[1]:
        near_m, far_m = np.quantile(depth, (0.1, 0.9))
        if far_m > _DEEP * near_m:
            return "deep"
    return None


def _describe_doubt(doubt: Doubt, median: float, reading: Reading, what: str, option: str) -> str:
    """A line that says what is implausible, and by which scales it would not be.

    Args:
        doubt: Why the depths may be no metres.
        median: Median of the depths as they were read.
        reading: Format of the file; integers have been divided by its scale.
        what: Name of the depths.
        option: Option of the command line that states the scale.
    """
    # Whole numbers are codes, in scales of depth files; other floats may be in another unit.
    scale = reading.scale or 1.0
    scales: tuple[float, ...] = _UNITS
    if doubt == "codes" or reading.scale is not None:
        scales = _COMMON_SCALES
    kind = " of whole numbers" if doubt == "codes" else ""
    verdict = "far for so deep a view" if doubt == "deep" else "implausible"
    return (
        f"{what}: median{kind} {metres(median)} m is {verdict}, the scale is probably wrong:"
        f" {_scale_advice(median * scale, scale, scales, option)}"
    )


def _scale_advice(
    stored_median: float, scale: float, scales: tuple[float, ...], option: str
) -> str:
    """Words on the scales by which depths would be plausible, the most likely first.

    Args:
        stored_median: Median of the numbers, as their file stores them.
        scale: Numbers per metre by which they were read.
        scales: Numbers per metre in use, the most likely first.
        option: Option of the command line that states the scale.
    """
    medians = dict[float, str]()  # the median in metres, as text, by the scale that gives it
    for least_m, most_m in (_MIDDLE_M, _COMMON_M):
        for usual in scales:
            if least_m <= stored_median / usual <= most_m and usual != scale:
                medians.setdefault(usual, f"{metres(stored_median / usual)} m")
    if not medians:
        return f"give numbers per metre with {option} (now {scale:g})"
    first, *others = medians
    advice = f"{option} {first:g} (now {scale:g}) would make it {medians[first]}"
    return advice + "".join(f", {usual:g} {medians[usual]}" for usual in others)
