"""The gate that every number from a sensor passes, from scans, maps, lists, bags and ground truth.

Each rule has one sentence and its evidence in numbers. It mends and counts, or it stops and names
the option that mends.

| rule | evidence | then |
|---|---|---|
| a return is somewhere | none of x y z is finite, or it is within 1 mm of the sensor | dropped |
| beams end at different places | one x y z on 0.5 % of the points, at least 3 | dropped |
| a coordinate is a number | some of x y z are none, or beyond 100 km; stops at 10 % | dropped |
| a surface has several depths | `dataset.range_ends` | unknown, or warns |
| depth is in metres | the median; whole numbers in a float file | stops |
| a deep view is near | floats of a median above 200 m, from near to twice as far | warns |
| two files of a frame agree | their order is one, their ratio 1: `dataset.agreement` | stops |
| a list holds pixels | all within 0…1 or −1…1; many below 0 | stops |
| pixels are of this image | all in the upper left corner | warns |
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.completion.two_depths import compare_depths
from pnpdepth_cli.dataset.range_ends import far_end, far_values, near_end
from pnpdepth_cli.errors import InputError, NoPointsError
from pnpdepth_cli.io.depth import metres
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.points import SparsePoints, in_frame
from pnpdepth_cli.sensors.projection import DropCounter, Mask

# Scans.
_AT_SENSOR_M = 1e-3
"""Range up to which a point is at the sensor, a beam without return."""
_FARTHEST_M = 1e5
"""Largest coordinate of a scan; no LiDAR reaches a hundredth of it."""
_BROKEN = 0.1
"""Of the points; more that are no numbers are of another format."""
_MANY_RETURNS = 1000
"""Points; fewer do not tell whether one scanner saw them."""
_CELLS_DEG = (0.25, 0.35, 0.5, 0.7, 1.0)
"""Azimuth and elevation of the cells in which a scanner sees one surface; see `has_scanner`."""
_MANY_SHARED = 0.4
"""Of the cells that have a point, how many have several if the cells are large enough."""
_SEVERAL = 0.26
"""Log ratio of ranges in a cell, 1.3 times, beyond which they are of several surfaces."""
_MOST_SEVERAL = 0.12
"""Of the cells with two points; between the 11 % and 13 % of `has_scanner`."""
_SAME = 0.005
"""Of the points; as many at one place are no surface."""
_LEAST_SAME = 3
"""Points at one place, at least."""

# Units and scales.
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

# Pixels of a list.
_SWAPPED = 0.05
"""Of the points; more outside the image, but inside it turned, have x and y swapped."""
_RELATIVE = 1.05
"""Largest coordinate that is relative to the image's size."""
_RELATIVE_FEW = 5
"""Points; fewer may all lie in the first pixel."""
_NEARLY_ALL = 0.9
"""Of the points that have relative coordinates."""
_LARGER = 1.25
"""Times the image, within which the points are, if it is another size."""
_ALIKE = 1.08
"""Ratio of the two directions' such numbers."""
_SQUARE = 0.97
"""Of the other side, up to which the points of a square reach."""
_CORNER = 0.75
"""Of the image's sides that many points keep within, if they are of another size."""
_DOWN = 0.6
"""Rank correlation of depth and row, from which near things are above; see `check_rows`."""
_PART_OF_ROWS = 0.3
"""Of the image's height, that points cover at least for that."""
_BELOW_ZERO = 0.1
"""Of the points; more left of or above the image are x y z of a scan."""

# Maps that were resized by interpolation; see `interpolation_warning`.
_MANY_BESIDE = 100
"""Pixels beside unknown ones."""
_RUN_DOWN = 0.15
"""Of these, how many are below half of a neighbour."""
_TWICE = 0.04
"""Log ratio to 2 within which neighbours are one twice the other; as wide as either side of it."""
_MANY_TWICE = 30
"""Neighbours; as many as any map has by chance."""
_PART_TWICE = 0.004
"""Of all neighbours."""
_MORE_TWICE = 5.0
"""Times as many as have a ratio beside 2."""

OF_DATA_SET = "the data set"
"""What a scale is of that nobody states of these very numbers; floats are divided by it only where
they cannot be metres, and nothing is said."""

MAPS = (0.02, 1000.0)
"""The smallest and the largest median, metres, of depth maps."""
SCANS = (0.05, 300.0)
"""The smallest and the largest median, metres, of ranges of scans."""


class CloudInMetres(NamedTuple):
    """The points of a scan or a cloud that are usable."""

    points: NDArray[np.floating]
    """(N, 3) metres."""
    dropped: dict[str, int]
    """Number of the others, by the reason."""
    notes: list[str]
    """Lines for a person."""


def scan_returns(
    path: Path | str,
    xyz: NDArray[np.floating],
    scale: float | None = None,
    *,
    of_integers: str = OF_DATA_SET,
) -> CloudInMetres:
    """Returns the points of a scan that are returns, in metres.

    Args:
        path: Path or topic of the scan.
        xyz: (N, 3) in the scanner's coordinates, as they are stored.
        scale: Numbers per metre that the user states.
        of_integers: The other file of the frame whose integers that scale is of. Empty: it is
            stated of these numbers.

    Raises:
        InputError: Many coordinates are none of a scan, or are implausible in metres.
        NoPointsError: No point is left.
    """
    # The returns, and how many of the others there are.
    range_m = np.linalg.norm(np.where(np.isfinite(xyz), xyz, 0).astype(np.float64), axis=1)
    drops = DropCounter()
    row = _drop_no_returns(path, xyz, range_m, drops)
    if not len(row):
        raise NoPointsError(
            f"{path}: none of its {len(xyz):,} points is a return; give another scan"
        )
    dropped, notes = _described(drops, len(xyz))
    # Their unit.
    divisor, lines = divisor_to_metres(
        range_m[row],
        Reading("scan"),
        f"{path}: range",
        "--depth-scale",
        scale,
        SCANS,
        of_integers=of_integers,
    )
    points = np.ascontiguousarray(xyz[row], np.float32) / np.float32(divisor)
    return CloudInMetres(points, dropped, [*notes, *lines])


def _drop_no_returns(
    path: Path | str,
    xyz: NDArray[np.floating],
    range_m: NDArray[np.float64],
    drops: DropCounter,
) -> NDArray[np.intp]:
    """The numbers of the points (N, 3) that are returns, with these ranges (N,).

    The others are counted by the reason.

    Raises:
        InputError: Many coordinates are none of a scan.
    """
    finite = np.isfinite(xyz)
    far = np.abs(np.where(finite, xyz, 0)) > _FARTHEST_M
    odd = ~finite.all(axis=1) | far.any(axis=1)
    # Beams without return: as no numbers, as zeros, at one place, at the sensor's largest range.
    row = np.arange(len(xyz))
    row = row[drops.keep(finite.any(axis=1), "without return, as they are not finite")]
    seen = ~finite[row].all(axis=1) | (range_m[row] >= _AT_SENSOR_M)
    row = row[drops.keep(seen, "without return, as they are at the sensor")]
    apart = ~_at_one_place(xyz[row].astype(np.float64))
    row = row[drops.keep(apart, "without return, as they are at one and the same place")]
    near = ~far_end(range_m[row]).is_none
    row = row[drops.keep(near, "without return, as they are at one range far beyond all others")]
    beyond = ~near_end(range_m[row]).is_none
    row = row[
        drops.keep(beyond, "without return, as they are at one range, nearer than all others")
    ]
    # Coordinates that are none.
    if np.count_nonzero(odd[row]) > _BROKEN * len(xyz):
        first = int(row[odd[row]][0])
        raise InputError(
            f"{path}: {np.count_nonzero(odd[row]):,} of {len(xyz):,} points have a coordinate"
            f" that is none of a scan (number {first + 1:,}:"
            f" {' '.join(f'{number:.3g}' for number in xyz[first])} m); its numbers are probably"
            " not stored as the format says"
        )
    return row[drops.keep(~odd[row], "with a coordinate that is none")]


def _described(drops: DropCounter, total: int) -> tuple[dict[str, int], list[str]]:
    """How many points were dropped for each reason that applies, and lines for a person."""
    dropped = {why: count for why, count in drops.dropped.items() if count}
    notes = [
        f"sparse: dropped {count:,} of {total:,} points {why}" for why, count in dropped.items()
    ]
    return dropped, notes


def cloud_points(
    path: Path | str, xyz: NDArray[np.floating], scale: float | None = None
) -> CloudInMetres:
    """Returns the points of a cloud that no scanner at its origin measured, in metres.

    Its coordinates are of a map or a survey, so they have no range, and no limit.

    Raises:
        NoPointsError: No point is a number.
    """
    drops = DropCounter()
    known = np.isfinite(xyz).all(axis=1)
    row = np.flatnonzero(drops.keep(known, "with a coordinate that is none"))
    if not len(row):
        raise NoPointsError(
            f"{path}: none of its {len(xyz):,} points has coordinates; give another cloud"
        )
    dropped, notes = _described(drops, len(xyz))
    if scale is not None and scale != 1:
        notes.append(f"{path}: ÷ {scale:g}, as is stated")
    points = np.asarray(xyz[row], np.float64) / (scale or 1.0)
    return CloudInMetres(points, dropped, notes)


def has_scanner(xyz: NDArray[np.floating]) -> bool:
    """Returns whether points (N, 3) may be of one scanner at their origin.

    A scanner sees one surface in each direction. Of cells with two points or more, 11 % at most
    have surfaces at very different ranges in five scans, whole and thinned, and 13 to 49 % where
    the same scans are moved 10 m away. The cells are the smallest of which many have two points:
    in smaller ones, two points are of different beams.
    """
    range_m = np.linalg.norm(np.asarray(xyz, np.float64), axis=1)
    usable = np.isfinite(range_m) & (range_m > _AT_SENSOR_M)
    if np.count_nonzero(usable) < _MANY_RETURNS:
        return True
    points = np.asarray(xyz, np.float64)[usable]
    range_m = range_m[usable]
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.degrees(np.arcsin(np.clip(points[:, 2] / range_m, -1, 1)))
    for cell_deg in _CELLS_DEG:
        cell = np.floor(azimuth / cell_deg) * 4096 + np.floor(elevation / cell_deg)
        _, place, counts = np.unique(cell, return_inverse=True, return_counts=True)
        shared = counts >= 2
        if shared.mean() >= _MANY_SHARED:
            break
    if np.count_nonzero(shared) < _MANY_RETURNS / 10:
        return True
    # How many of these cells hold very different ranges.
    log_range = np.log(range_m)
    nearest = np.full(len(counts), np.inf)
    farthest = np.full(len(counts), -np.inf)
    np.minimum.at(nearest, place, log_range)
    np.maximum.at(farthest, place, log_range)
    several = (farthest - nearest)[shared] > _SEVERAL
    return float(several.mean()) < _MOST_SEVERAL


def _at_one_place(xyz: NDArray[np.float64]) -> Mask:
    """(N,) true for points at a place that more of them share than beams can."""
    if len(xyz) < _FEW:
        return np.zeros(len(xyz), bool)
    mixed = xyz @ (1.0, np.pi, np.e**2)  # one number for each place
    keys, counts = np.unique(mixed, return_counts=True)
    is_shared: bool = counts.max() >= max(_LEAST_SAME, _SAME * len(xyz))
    return np.asarray((mixed == keys[counts.argmax()]) & is_shared)


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


def interpolation_warning(depth: NDArray[np.float32]) -> str | None:
    """Returns a warning if a map (H, W) with unknown pixels, 0, was resized by interpolation.

    Values then run down to 0 beside unknown pixels. There, below half of a neighbour are 0.4 % of
    the pixels at most in 36 maps of five sets, 10 % in the samples, and 22 to 80 % after a resize.
    At exactly half the size, a pixel is the mean of four, of which one to four are known, so that
    neighbours have ratios such as 2.
    """
    known = depth > 0
    window = np.ones((3, 3), np.uint8)
    beside = known & (cv2.erode(known.astype(np.uint8), window, borderValue=1) == 0)
    count = int(np.count_nonzero(beside))
    if count < _MANY_BESIDE:
        return None
    low = depth[beside] < cv2.dilate(depth, window)[beside] / 2
    cause = "as of a map that was resized by interpolation, which mixes depth with unknown"
    way_out = "resize it by the nearest neighbour"
    if low.mean() >= _RUN_DOWN:
        return (
            f"warning: {low.mean():.0%} of {count:,} depths beside unknown pixels are below half of"
            f" a neighbour's, {cause}; {way_out}"
        )
    twice = _share_of_twice(depth)
    if twice is None:
        return None
    return (
        f"warning: {twice:.1%} of neighbouring depths are one exactly twice the other, {cause};"
        f" {way_out}"
    )


def _share_of_twice(depth: NDArray[np.float32]) -> float | None:
    """The share of neighbours of a map (H, W) of which one is twice the other; None if by chance.

    Where they are surfaces, no more have this ratio than have those beside it. After a resize to
    half or a quarter, 0.5 to 38 % have it in 30 maps of seven sets, and 6 to 500 times as many as
    beside it. Before it, of 130 maps that have 5 times as many, none has it at more than 0.14 %.
    """
    ratios = list[NDArray[np.float32]]()
    for first, second in ((depth[:, 1:], depth[:, :-1]), (depth[1:], depth[:-1])):
        both = (first > 0) & (second > 0)
        ratios.append(np.abs(np.log(first[both] / second[both])))
    off = np.abs(np.concatenate(ratios) - np.log(np.float32(2)))
    twice = int(np.count_nonzero(off < _TWICE))
    # The windows beside it are together twice as wide.
    beside = np.count_nonzero((off > 2 * _TWICE) & (off < 4 * _TWICE)) / 2
    if twice < max(_MANY_TWICE, _PART_TWICE * len(off), _MORE_TWICE * beside):
        return None
    return twice / len(off)


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


def check_rows(points: SparsePoints[NDArray[np.float32]]) -> list[str]:
    """Returns a warning if depth grows towards the bottom of the image, where floors are nearest.

    Its rank correlation with the row is −0.94 to 0.24 in 121 frames of seven sets, indoors and
    outdoors. Of disparity and 1/depth it is the opposite, and of rows from the bottom up.
    """
    y = points.xy[:, 1].astype(np.float64)
    if len(y) < _MANY or np.ptp(y) < _PART_OF_ROWS * points.size[0]:
        return []
    found = compare_depths(points.depth, y + 1)
    if found.rank < _DOWN:
        return []
    return [
        "warning: sparse: larger values are at the bottom of the image (rank correlation"
        f" {found.rank:.2f}), where floors are nearest: disparity or 1/depth, which --sparse-kind"
        " reads, or rows from the bottom up?"
    ]


def check_pixels(
    path: Path, xy: NDArray[np.floating], size: tuple[int, int]
) -> tuple[Mask, list[str]]:
    """Returns which points (N, 2) of a list lie in an image (H, W), and lines for a person.

    Raises:
        InputError: The coordinates are no pixels, or those of an image that was turned.
        NoPointsError: None lies in the image.
    """
    inside = np.asarray(in_frame(xy, size))
    outside = len(xy) - int(np.count_nonzero(inside))
    _check_relative(path, xy, size)
    _check_size_of_pixels(path, xy, size, outside)
    # Coordinates of a scan.
    below = int((xy < -0.5).any(axis=1).sum())
    if len(xy) >= _FEW and below > _BELOW_ZERO * len(xy):
        raise InputError(
            f"{path}: {below:,} of {len(xy):,} points have coordinates below 0, down to"
            f" {xy.min():.3g}, which are no pixels; if these are x y z of a scan, give --calib"
        )
    if not inside.any():
        raise NoPointsError(
            f"{path}: none of its {len(xy)} points lies in the image; give pixels of this image"
        )
    notes = [f"sparse: {outside:,} points outside the image"] if outside else []
    # Points that all keep within a corner are pixels of a smaller image.
    if _are_in_corner(xy, size):
        height, width = size
        notes.append(
            f"warning: all {len(xy):,} points of {path} are in the upper left corner, up to"
            f" {xy[:, 0].max():.0f}, {xy[:, 1].max():.0f} of {width}×{height} pixels; if these are"
            " pixels of a smaller image, scale them to this one"
        )
    return inside, notes


def _check_relative(path: Path, xy: NDArray[np.floating], size: tuple[int, int]) -> None:
    """Raises InputError for coordinates that are relative to the image (H, W)."""
    height, width = size
    relative = (np.abs(xy) <= _RELATIVE).all(axis=1)
    if len(xy) < _RELATIVE_FEW or relative.mean() < _NEARLY_ALL or min(size) <= 2 * _FEW:
        return
    count = np.count_nonzero(relative)
    if (xy[relative] < 1 - _RELATIVE).any():
        raise InputError(
            f"{path}: the coordinates of {count:,} of {len(xy):,} points are within −1…1, so they"
            f" are relative to the image; add 1 and multiply them by {width / 2:g} and"
            f" {height / 2:g} to make them pixels"
        )
    raise InputError(
        f"{path}: the coordinates of {count:,} of {len(xy):,} points are within 0…1, so they are"
        f" relative to the image; multiply them by {width} and {height} to make them pixels"
    )


def _check_size_of_pixels(
    path: Path, xy: NDArray[np.floating], size: tuple[int, int], outside: int
) -> None:
    """Raises InputError for pixels of an image that was turned, or of a larger one.

    Args:
        path: The file of the points.
        xy: (N, 2).
        size: (H, W) of the image.
        outside: Number of points outside the image.
    """
    height, width = size
    if outside <= _SWAPPED * len(xy):
        return
    if bool(in_frame(xy, (width, height)).all()):
        raise InputError(
            f"{path}: {outside:,} of {len(xy):,} points are outside the {width}×{height} image,"
            f" but all are inside {height}×{width}: swap x and y, or turn the image by 90°"
        )
    # How many times as large the image would be that they are of, in both directions.
    reach = (np.quantile(xy, 0.99, axis=0) / 0.99 + 1) / (width, height)
    larger = float(reach.min())
    is_larger = larger > _LARGER and reach.max() < _ALIKE * larger
    if is_larger and len(xy) >= _FEW and bool((xy >= -0.5).all()):
        raise InputError(
            f"{path}: {outside:,} of {len(xy):,} points are outside the {width}×{height} image; all"
            f" are within one that is {larger:.3g} times as large; divide them by that"
        )


def _are_in_corner(xy: NDArray[np.floating], size: tuple[int, int]) -> bool:
    """Whether many points (N, 2) cover a corner of an image (H, W), as of a smaller one."""
    height, width = size
    last = xy.max(axis=0)
    if len(xy) < _MANY or not (xy.min(axis=0) < 0.1 * last).all():
        return False
    # A smaller image of the same ratio of sides.
    right, down = (last + 1) / (width, height)
    if max(right, down) < _CORNER and min(right, down) > 0.9 * max(right, down):
        return True
    # A square, such as 0…255 or per cent.
    is_square = last.max() < _CORNER * min(size) and last.min() > _SQUARE * last.max()
    return bool(is_square) and width != height
