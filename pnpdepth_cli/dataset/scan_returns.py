"""The points of a scan that are returns, in metres; or those of a cloud that no scanner measured.

Each rule has one sentence and its evidence in numbers. It drops and counts, or it stops.

| rule | evidence | then |
|---|---|---|
| a return is somewhere | none of x y z is finite, or it is within 1 mm of the sensor | dropped |
| beams end at different places | one x y z on 0.5 % of the points, at least 3 | dropped |
| beams end at different ranges | one range at an end, `dataset.range_ends` | dropped |
| a coordinate is a number | some of x y z are none, or beyond 100 km; stops at 10 % | dropped |
| ranges are in metres | their median: `dataset.plausible` | stops |
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset.plausible import OF_DATA_SET, SCANS, divisor_to_metres
from pnpdepth_cli.dataset.range_ends import far_end, near_end
from pnpdepth_cli.errors import InputError, NoPointsError
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.sensors.projection import DropCounter, Mask

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
_FEW = 10
"""Numbers; fewer decide nothing."""
_SAME = 0.005
"""Of the points; as many at one place are no surface."""
_LEAST_SAME = 3
"""Points at one place, at least."""


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
