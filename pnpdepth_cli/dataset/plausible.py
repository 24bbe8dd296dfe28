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

_AT_SENSOR_M = 1e-3
_FARTHEST_M = 1e5  # of a coordinate of a scan
_BROKEN = 0.1  # of the points; more that are no numbers are another format
_MANY_RETURNS, _CELL_DEG = 1000, 0.25
_SEVERAL, _MOST_SEVERAL = 0.26, 0.12  # log ratio of ranges (1.3), and of the cells that have it
_SAME, _LEAST_SAME = 0.005, 3  # of the numbers, and how many, that no surface shares
_FEW = 10  # fewer numbers decide nothing
_CODES = 100.0  # median from which floats that are whole numbers are codes
_COMMON_M = (0.2, 200.0)
_MIDDLE_M = (0.5, 80.0)  # medians of most frames
_DEEP = 2.0  # times a tenth of the depths is another tenth farther; not so below an aircraft
# Codes per metre in use, most likely first: millimetres, KITTI, TUM RGB-D, centimetres.
_COMMON_SCALES = (1000.0, 256.0, 5000.0, 100.0, 10.0, 1.0)
# Numbers per metre that are no codes: mm, cm, inches, dm, feet, m; and steps of 0.25 and 5 mm.
_UNITS = (1000.0, 100.0, 39.3701, 10.0, 3.28084, 1.0, 4000.0, 200.0)
_SWAPPED = 0.05  # of the points; more outside the image, but inside it turned, have x and y swapped
_RELATIVE, _RELATIVE_FEW, _NEARLY_ALL = 1.05, 5, 0.9  # largest, of so many points, and of these
_LARGER, _ALIKE = 1.25, 1.08  # times the image, in both directions alike
_SQUARE = 0.97  # of the other side, up to which the points of a square reach
_CORNER, _MANY = 0.75, 50  # of the image's sides that so many points keep within: another size
_DOWN, _PART_OF_ROWS = 0.6, 0.3  # rank correlation; of the image's height, that points cover
_MANY_BESIDE, _RUN_DOWN = 100, 0.15  # pixels beside unknown ones, and how many of them run down
_TWICE = 0.04
"""Log ratio to 2 within which neighbours are one twice the other; as wide as either side of it."""
_MANY_TWICE = 30
"""Neighbours; as many as any map has by chance."""
_PART_TWICE = 0.004
"""Of all neighbours."""
_MORE_TWICE = 5.0
"""Times as many as have a ratio beside 2."""
_UNIT, _WHOLE_UNIT, _NEAR_UNIT = 1.0001, 0.99, 0.9  # ends and a median of maps within 0…1
_BELOW_ZERO = 0.1  # of the points; more left of or above the image are x y z of a scan

OF_DATA_SET = "the data set"
"""What a scale is of that nobody states of these very numbers; floats are divided by it only where
they cannot be metres, and nothing is said."""

MAPS, SCANS = (0.02, 1000.0), (0.05, 300.0)
"""The smallest and the largest median, metres, of depth maps and of ranges of scans."""


def scan_returns(
    path: Path | str,
    xyz: NDArray[np.floating],
    scale: float | None = None,
    *,
    of_integers: str = OF_DATA_SET,
) -> tuple[NDArray[np.float32], dict[str, int], list[str]]:
    """Returns the points (N, 3) of a scan that are returns, in metres; counts; lines for a person.

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
    finite = np.isfinite(xyz)
    known = np.where(finite, xyz, 0)
    range_m = np.linalg.norm(known.astype(np.float64), axis=1)
    odd = ~finite.all(axis=1) | (np.abs(known) > _FARTHEST_M).any(axis=1)
    # beams without return: as no numbers, as zeros, at one place, at the sensor's largest range
    drops = DropCounter()
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
    # coordinates that are none
    if np.count_nonzero(odd[row]) > _BROKEN * len(xyz):
        first = int(row[odd[row]][0])
        raise InputError(
            f"{path}: {np.count_nonzero(odd[row]):,} of {len(xyz):,} points have a coordinate"
            f" that is none of a scan (number {first + 1:,}:"
            f" {' '.join(f'{n:.3g}' for n in xyz[first])} m); its numbers are probably not stored"
            " as the format says"
        )
    row = row[drops.keep(~odd[row], "with a coordinate that is none")]
    if not len(row):
        raise NoPointsError(f"{path}: none of its {len(xyz):,} points is a return")
    dropped = {why: count for why, count in drops.dropped.items() if count}
    notes = [f"sparse: dropped {n:,} of {len(xyz):,} points {why}" for why, n in dropped.items()]
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
    return points, dropped, [*notes, *lines]


def cloud_points(
    path: Path | str, xyz: NDArray[np.floating], scale: float | None = None
) -> tuple[NDArray[np.float64], dict[str, int], list[str]]:
    """Returns the points (N, 3) of a cloud that no scanner at its origin measured; as above.

    Its coordinates are of a map or a survey, so they have no range, and no limit.

    Raises:
        NoPointsError: No point is a number.
    """
    drops = DropCounter()
    known = np.isfinite(xyz).all(axis=1)
    row = np.flatnonzero(drops.keep(known, "with a coordinate that is none"))
    if not len(row):
        raise NoPointsError(f"{path}: none of its {len(xyz):,} points has coordinates")
    dropped = {why: count for why, count in drops.dropped.items() if count}
    notes = [f"sparse: dropped {n:,} of {len(xyz):,} points {why}" for why, n in dropped.items()]
    if scale is not None and scale != 1:
        notes.append(f"{path}: ÷ {scale:g}, as is stated")
    return np.asarray(xyz[row], np.float64) / (scale or 1.0), dropped, notes


def has_scanner(xyz: NDArray[np.floating]) -> bool:
    """Returns whether points (N, 3) may be of one scanner at their origin.

    A scanner sees one surface in each direction. Of cells of a quarter of a degree with two points
    or more, 7 % at most have surfaces at very different ranges in five scans of KITTI, and 17 to
    29 % where the same scans are moved 10 m away.
    """
    range_m = np.linalg.norm(np.asarray(xyz, np.float64), axis=1)
    usable = np.isfinite(range_m) & (range_m > _AT_SENSOR_M)
    if np.count_nonzero(usable) < _MANY_RETURNS:
        return True
    points, range_m = np.asarray(xyz, np.float64)[usable], range_m[usable]
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.degrees(np.arcsin(np.clip(points[:, 2] / range_m, -1, 1)))
    cell = np.floor(azimuth / _CELL_DEG) * 4096 + np.floor(elevation / _CELL_DEG)
    _, place, counts = np.unique(cell, return_inverse=True, return_counts=True)
    log_range = np.log(range_m)
    nearest = np.full(len(counts), np.inf)
    farthest = np.full(len(counts), -np.inf)
    np.minimum.at(nearest, place, log_range)
    np.maximum.at(farthest, place, log_range)
    shared = counts >= 2
    if np.count_nonzero(shared) < _MANY_RETURNS / 10:
        return True
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
    # a scale of integers that is assumed is compared with the other file of the frame instead
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
    floats = reading.scale is None
    if floats and scale is not None and scale != 1 and not of_integers:
        made = median / scale
        lines = [f"{what}: ÷ {scale:g}, as is stated"]
        if not low <= made <= high:
            lines.append(f"warning: {what}: median {metres(made)} m is implausible with {option}")
        return scale, lines
    # A map within 0…1 is normalised, or a z-buffer.
    if floats and scale is None and depth.size >= _MANY and float(depth.max()) <= _UNIT:
        fact = f"{what}: all {depth.size:,} depths are within 0…1, up to {float(depth.max()):.4g}"
        hint = f"{option} 1 keeps it as metres; another number of it divides"
        if float(depth.max()) >= _WHOLE_UNIT or median >= _NEAR_UNIT:
            raise InputError(f"{fact}, as of normalised depth or a z-buffer; {hint}")
        return 1.0, [f"warning: {fact}: are they metres? {hint}"]
    # What is implausible as it is read.
    many = floats and median >= _CODES and depth.size >= _FEW
    codes = many and bool((np.rint(depth) == depth).all())
    likely = low <= median <= high and not codes
    far = floats and median > _COMMON_M[1] and depth.size >= _FEW
    near_m, far_m = np.quantile(depth, (0.1, 0.9)) if likely and far else (1.0, 1.0)
    if likely and (far_m <= _DEEP * near_m or scale == 1):
        if not floats or scale in (None, 1) or of_integers in ("", OF_DATA_SET):
            return 1.0, []
        return 1.0, [
            f"{what}: floats, read as metres; {option} {scale:g} is of the integers of"
            f" {of_integers}"
        ]
    if floats and scale is not None and scale != 1 and low <= median / scale <= high:
        return scale, [f"{what}: ÷ {scale:g}, as {metres(median)} m are implausible"]
    # All scales in use that would make it plausible, the most likely first.
    kind = " of whole numbers" if codes else ""
    doubt = "far for so deep a view" if likely else "implausible"
    fact = f"{what}: median{kind} {metres(median)} m is {doubt}, the scale is probably wrong"
    now = reading.scale or 1.0
    common = _COMMON_SCALES if codes or not floats else _UNITS
    scales = [(s, limits) for limits in (_MIDDLE_M, _COMMON_M) for s in common]
    better = dict.fromkeys(s for s, (least, most) in scales if least <= median * now / s <= most)
    better.pop(now, None)
    if not better:
        advice = f"give numbers per metre with {option} (now {now:g})"
    else:
        first, *others = (f"{s:g}" for s in better)
        texts = [f"{metres(median * now / s)} m" for s in better]
        advice = f"{option} {first} (now {now:g}) would make it {texts[0]}"
        advice += "".join(f", {s} {m}" for s, m in zip(others, texts[1:], strict=True))
    if likely or scale is not None or not (floats or reading.assumed):
        return 1.0, [f"warning: {fact}: {advice}"]
    raise InputError(f"{fact}: {advice}, {option} {now:g} keeps it")


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
    # Coordinates that are relative to the image.
    (height, width), inside = size, np.asarray(in_frame(xy, size))
    outside = len(xy) - int(np.count_nonzero(inside))
    relative = (np.abs(xy) <= _RELATIVE).all(axis=1)
    if len(xy) >= _RELATIVE_FEW and relative.mean() >= _NEARLY_ALL and min(size) > 2 * _FEW:
        low = "0"
        how = f"multiply them by {width} and {height}"
        if (xy[relative] < 1 - _RELATIVE).any():
            low = "−1"
            how = f"add 1 and multiply them by {width / 2:g} and {height / 2:g}"
        raise InputError(
            f"{path}: the coordinates of {np.count_nonzero(relative):,} of {len(xy):,} points are"
            f" within {low}…1, so they are relative to the image; {how} to make them pixels"
        )
    # Coordinates of an image that was turned.
    if outside > _SWAPPED * len(xy) and bool(in_frame(xy, (width, height)).all()):
        raise InputError(
            f"{path}: {outside:,} of {len(xy):,} points are outside the {width}×{height} image,"
            f" but all are inside {height}×{width}: swap x and y, or turn the image by 90°"
        )
    # Coordinates of a larger image.
    reach = (np.quantile(xy, 0.99, axis=0) / 0.99 + 1) / (width, height)
    larger = float(reach.min())
    is_larger = larger > _LARGER and reach.max() < _ALIKE * larger and outside > _SWAPPED * len(xy)
    if len(xy) >= _FEW and is_larger and bool((xy >= -0.5).all()):
        raise InputError(
            f"{path}: {outside:,} of {len(xy):,} points are outside the {width}×{height} image; all"
            f" are within one that is {larger:.3g} times as large; divide them by that"
        )
    # Coordinates of a scan.
    below = int((xy < -0.5).any(axis=1).sum())
    if len(xy) >= _FEW and below > _BELOW_ZERO * len(xy):
        raise InputError(
            f"{path}: {below:,} of {len(xy):,} points have coordinates below 0, down to"
            f" {xy.min():.3g}, which are no pixels; if these are x y z of a scan, give --calib"
        )
    if not inside.any():
        raise NoPointsError(f"{path}: none of its {len(xy)} points lies in the image")
    # Points that all keep within a corner are pixels of a smaller image.
    notes = [f"sparse: {outside:,} points outside the image"] if outside else []
    right, down = (xy.max(axis=0) + 1) / (width, height)
    last = xy.max(axis=0)
    square = last.max() < _CORNER * min(size) and last.min() > _SQUARE * last.max()
    corner = max(right, down) < _CORNER and min(right, down) > 0.9 * max(right, down)
    corner |= square and width != height  # such as 0…255 or per cent
    if len(xy) >= _MANY and corner and (xy.min(axis=0) < 0.1 * xy.max(axis=0)).all():
        notes.append(
            f"warning: all {len(xy):,} points of {path} are in the upper left corner, up to"
            f" {xy[:, 0].max():.0f}, {xy[:, 1].max():.0f} of {width}×{height} pixels; if these are"
            " pixels of a smaller image, scale them to this one"
        )
    return inside, notes
