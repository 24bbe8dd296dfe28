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

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset.range_ends import far_values
from pnpdepth_cli.dataset.resized_maps import interpolation_warning
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import metres
from pnpdepth_cli.io.formats import Reading

_FEW = 10
"""Numbers; fewer decide nothing."""
_MANY = 50
"""Numbers; as many tell something of all."""
_CODES = 100.0
"""Median from which floats that are whole numbers are codes."""
_COMMON_M = (0.2, 200.0)
"""Medians of nearly all frames."""
_MIDDLE_M = (0.5, 80.0)
"""Medians of most frames."""
_DEEP = 2.0
"""Times a tenth of the depths is another tenth farther; not so below an aircraft."""
_COMMON_SCALES = (1000.0, 256.0, 5000.0, 100.0, 10.0, 1.0)
"""Codes per metre in use, most likely first: millimetres, KITTI, TUM RGB-D, cm, dm, m."""
_UNITS = (1000.0, 100.0, 39.3701, 10.0, 3.28084, 1.0, 4000.0, 200.0)
"""Numbers per metre that are no codes: mm, cm, inches, dm, feet, m; and steps of 0.25 and 5 mm."""
_UNIT = 1.0001
"""Largest number of a map within 0…1, but for rounding."""
_WHOLE_UNIT = 0.99
"""Largest number from which a map within 0…1 reaches its end, as a normalised one does."""
_NEAR_UNIT = 0.9
"""Median from which a map within 0…1 is a z-buffer, most of which is near 1."""
OF_DATA_SET = "the data set"
"""What a scale is of that nobody states of these very numbers; floats are divided by it only where
they cannot be metres, and nothing is said."""
MAPS = (0.02, 1000.0)
"""The smallest and the largest median, metres, of depth maps."""
SCANS = (0.05, 300.0)
"""The smallest and the largest median, metres, of ranges of scans."""


def plausible_map(
    values: NDArray[np.float32],
    reading: Reading,
    what: str,
    option: str,
    scale: float | None,
    *,
    of_integers: str = OF_DATA_SET,
) -> tuple[NDArray[np.float32], list[str]]:
    """Returns a depth map (H, W) in metres without what is no depth, and lines for a person.

    Args:
        values: (H, W), 0 where unknown.
        reading: Format of the file, and the scale of its integers.
        what: Name of the depths in lines for a person.
        option: Option of the scale.
        scale: Numbers per metre that the user states. None: nothing is stated.
        of_integers: The other file of the frame whose integers that scale is of. Empty: it is
            stated of these numbers.

    Raises:
        InputError: The depths are implausible in metres.
    """
    known = values > 0
    far, notes = far_values(values[known])
    if (warning := interpolation_warning(values)) is not None:
        notes.append(warning)
    values = values.copy()
    values[known] = np.where(far, np.float32(0), values[known])
    # A scale of integers that is assumed is compared with the other file of the frame instead.
    stated = scale or reading.scale
    divisor, lines = divisor_to_metres(
        values[values > 0], reading, what, option, stated, of_integers=of_integers
    )
    notes = [named(what, note) for note in notes] + lines
    return values / np.float32(divisor), notes


def named(what: str, note: str) -> str:
    """Returns the line with the name of its depths, behind its mark if it is a warning."""
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
) -> tuple[float, list[str]]:
    """Returns what depths are divided by to be metres, mostly 1, and lines for a person.

    A float file holds metres, unless the user states a scale of it. One scale may be stated of two
    files. If one of these holds integers, it is theirs, and floats are divided by it only where
    they cannot be metres.

    Args:
        depth: (N,) known depths, or ranges, as they were read.
        reading: Format of the file; integers have been divided by its scale.
        what: Name of the depths in lines for a person.
        option: Option of the scale.
        scale: Numbers per metre that the user states. None: nothing is stated.
        medians: The smallest and the largest that is plausible.
        of_integers: The other file of the frame whose integers the scale is of. Empty: it is
            stated of these depths.

    Raises:
        InputError: They are implausible, and nothing that the user states explains it.
    """
    if not depth.size:
        return 1.0, []
    low, high = medians
    median = float(np.median(depth))
    is_float = reading.scale is None
    by_user = scale if is_float and scale != 1 else None
    # A scale that is stated of these floats is obeyed.
    if by_user is not None and not of_integers:
        lines = [f"{what}: ÷ {by_user:g}, as is stated"]
        made = median / by_user
        if not low <= made <= high:
            lines.append(f"warning: {what}: median {metres(made)} m is implausible with {option}")
        return by_user, lines
    # Floats of which nothing is stated are no metres if they are normalised.
    if is_float and scale is None:
        lines = _check_normalised(depth, median, what, option)
        if lines:
            return 1.0, lines
    # What is plausible as it is read stays.
    doubt = _doubt_of(depth, median, medians, is_float=is_float)
    if doubt is None or (doubt == "deep" and scale == 1):
        if by_user is None or of_integers in ("", OF_DATA_SET):
            return 1.0, []
        return 1.0, [
            f"{what}: floats, read as metres; {option} {by_user:g} is of the integers of"
            f" {of_integers}"
        ]
    # Else a scale that is stated of integers is of these floats, too, if it explains them.
    if by_user is not None and low <= median / by_user <= high:
        return by_user, [f"{what}: ÷ {by_user:g}, as {metres(median)} m are implausible"]
    # A person is told by which scales they would be plausible.
    now = reading.scale or 1.0
    scales = _COMMON_SCALES if doubt == "codes" or not is_float else _UNITS
    advice = _scale_advice(median * now, now, scales, option)
    kind = " of whole numbers" if doubt == "codes" else ""
    verdict = "far for so deep a view" if doubt == "deep" else "implausible"
    fact = (
        f"{what}: median{kind} {metres(median)} m is {verdict}, the scale is probably wrong:"
        f" {advice}"
    )
    is_open = scale is None and (is_float or reading.assumed)
    if doubt == "deep" or not is_open:
        return 1.0, [f"warning: {fact}"]
    raise InputError(f"{fact}, {option} {now:g} keeps it")


def _check_normalised(
    depth: NDArray[np.floating], median: float, what: str, option: str
) -> list[str]:
    """A warning on depths (N,) that are all within 0…1, if there are many.

    Raises:
        InputError: They reach 1, or most are near it: they are normalised, or a z-buffer.
    """
    largest = float(depth.max())
    if depth.size < _MANY or largest > _UNIT:
        return []
    fact = f"{what}: all {depth.size:,} depths are within 0…1, up to {largest:.4g}"
    if largest >= _WHOLE_UNIT or median >= _NEAR_UNIT:
        raise InputError(
            f"{fact}, as of normalised depth or a z-buffer; {option} 1 keeps it as metres; another"
            " number of it divides"
        )
    return [
        f"warning: {fact}: are they metres? {option} 1 keeps it as metres; another number of it"
        " divides"
    ]


def _doubt_of(
    depth: NDArray[np.floating], median: float, medians: tuple[float, float], *, is_float: bool
) -> Literal["codes", "median", "deep"] | None:
    """Why depths (N,) may be no metres, if they are read as such. None: they are plausible.

    - codes: floats that are whole numbers, and large
    - median: it is beyond what frames have
    - deep: floats that are far for a view from near to far, but possible
    """
    low, high = medians
    many = depth.size >= _FEW
    if is_float and many and median >= _CODES and bool((np.rint(depth) == depth).all()):
        return "codes"
    if not low <= median <= high:
        return "median"
    if is_float and many and median > _COMMON_M[1]:
        near_m, far_m = np.quantile(depth, (0.1, 0.9))
        if far_m > _DEEP * near_m:
            return "deep"
    return None


def _scale_advice(median_number: float, now: float, scales: tuple[float, ...], option: str) -> str:
    """The scales in use by which depths would be plausible, the most likely first.

    Args:
        median_number: Median of the numbers, as their file stores them.
        now: Numbers per metre by which they are read.
        scales: Scales in use.
        option: Option of the scale.
    """
    better = dict[float, str]()  # the median as text, by scale
    for least, most in (_MIDDLE_M, _COMMON_M):
        for scale in scales:
            if least <= median_number / scale <= most and scale != now:
                better.setdefault(scale, f"{metres(median_number / scale)} m")
    if not better:
        return f"give numbers per metre with {option} (now {now:g})"
    first, *others = better
    advice = f"{option} {first:g} (now {now:g}) would make it {better[first]}"
    return advice + "".join(f", {scale:g} {better[scale]}" for scale in others)
