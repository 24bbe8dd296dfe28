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

# Returns of a scan.
_AT_SENSOR_M = 1e-3
"""Range up to which a point is at the sensor, a beam without return."""
_FARTHEST_M = 1e5
"""Largest coordinate of a scan; no LiDAR reaches a hundredth of it."""
_MOST_BROKEN = 0.1
"""Fraction of the points that may have a coordinate that is none. With more, the file is of another
format than it was read as."""
_FEWEST_POINTS = 10
"""Points of a scan; equal ones among fewer tell nothing."""
_SAME_PLACE = 0.005
"""Fraction of the points that are at one place, from which that place is no surface."""
_FEWEST_AT_PLACE = 3
"""Points at one place, at least, for the same."""

# Whether one scanner measured the points; see `has_scanner`.
_FEWEST_RETURNS = 1000
"""Points; fewer do not tell whether one scanner saw them."""
_CELLS_DEG = (0.25, 0.35, 0.5, 0.7, 1.0)
"""Sides of square cells of azimuth and elevation in which a scanner sees one surface."""
_CELL_ROWS = 4096
"""More cells than there are above each other, 180° / 0.25°, so that each cell has its number."""
_MANY_SHARED = 0.4
"""Fraction of the cells with a point that have two or more, if the cells are large enough."""
_FEWEST_SHARED = 100
"""Cells with two points or more; fewer tell nothing."""
_SEVERAL_SURFACES = 0.26
"""Log ratio of the ranges in a cell, 1.3 times, beyond which they are of several surfaces."""
_MOST_SEVERAL = 0.12
"""Fraction of the cells with two points or more that may have several surfaces: between the 11 %
and the 13 % of `has_scanner`."""


class CloudInMetres(NamedTuple):
    """The points of a scan or a cloud that are usable."""

    points: NDArray[np.floating]
    """(N, 3) metres."""
    dropped: dict[str, int]
    """Number of the points that were dropped, by the reason."""
    notes: list[str]
    """Lines for a person."""


def scan_returns(
    path: Path | str,
    xyz: NDArray[np.floating],
    scale: float | None = None,
    *,
    of_integers: str = OF_DATA_SET,
) -> CloudInMetres:
    """Returns the points of a scan that are returns of a beam, in metres.

    Args:
        path: Path or topic of the scan, for messages.
        xyz: (N, 3) in the scanner's coordinates, as they are stored.
        scale: Numbers per metre that the user or the data set states. None: nothing is stated.
        of_integers: Where the integers are that `scale` is stated for, if not here: path of the
            frame's other file, or `OF_DATA_SET`. Floats are then divided only where they cannot be
            metres. Empty: it is stated for these very numbers.

    Raises:
        InputError: Many coordinates are none of a scan, or are implausible in metres.
        NoPointsError: No point is left.
    """
    # The returns, and how many of the other points there are.
    stored_range = np.linalg.norm(np.where(np.isfinite(xyz), xyz, 0).astype(np.float64), axis=1)
    drops = DropCounter()
    rows = _rows_of_returns(path, xyz, stored_range, drops)
    if not len(rows):
        raise NoPointsError(
            f"{path}: none of its {len(xyz):,} points is a return; give another scan"
        )
    dropped, notes = _describe_drops(drops, len(xyz))
    # Their unit.
    divisor, lines = divisor_to_metres(
        stored_range[rows],
        Reading("scan"),
        f"{path}: range",
        "--depth-scale",
        scale,
        SCANS,
        of_integers=of_integers,
    )
    points = np.ascontiguousarray(xyz[rows], np.float32) / np.float32(divisor)
    return CloudInMetres(points, dropped, [*notes, *lines])


def _rows_of_returns(
    path: Path | str,
    xyz: NDArray[np.floating],
    stored_range: NDArray[np.float64],
    drops: DropCounter,
) -> NDArray[np.intp]:
    """The row numbers (M,) of the points of a scan that are returns of a beam.

    Args:
        path: Path or topic of the scan, for messages.
        xyz: (N, 3), as they are stored.
        stored_range: (N,) distances from the scanner, in the unit of `xyz`; coordinates that are
            not finite count as 0.
        drops: Counter of the other points, by the reason; they are added to it.

    Raises:
        InputError: Many coordinates are none of a scan.
    """
    is_finite = np.isfinite(xyz)
    is_far = np.abs(np.where(is_finite, xyz, 0)) > _FARTHEST_M
    is_broken = ~is_finite.all(axis=1) | is_far.any(axis=1)
    # Beams without return: as no numbers, as zeros, at one place, at the sensor's largest range or
    # at its smallest. A point with some finite coordinates is broken, not without return.
    rows = np.arange(len(xyz))
    rows = rows[drops.keep(is_finite.any(axis=1), "without return, as they are not finite")]
    is_away = ~is_finite[rows].all(axis=1) | (stored_range[rows] >= _AT_SENSOR_M)
    rows = rows[drops.keep(is_away, "without return, as they are at the sensor")]
    is_apart = ~_at_one_place(xyz[rows].astype(np.float64))
    rows = rows[drops.keep(is_apart, "without return, as they are at one and the same place")]
    is_nearer = ~far_end(stored_range[rows]).is_no_surface
    rows = rows[
        drops.keep(is_nearer, "without return, as they are at one range far beyond all others")
    ]
    is_farther = ~near_end(stored_range[rows]).is_no_surface
    rows = rows[
        drops.keep(is_farther, "without return, as they are at one range, nearer than all others")
    ]
    # Coordinates that are none.
    if np.count_nonzero(is_broken[rows]) > _MOST_BROKEN * len(xyz):
        first = int(rows[is_broken[rows]][0])
        raise InputError(
            f"{path}: {np.count_nonzero(is_broken[rows]):,} of {len(xyz):,} points have a"
            f" coordinate that is none of a scan (number {first + 1:,}:"
            f" {' '.join(f'{number:.3g}' for number in xyz[first])} m); its numbers are probably"
            " not stored as the format says"
        )
    return rows[drops.keep(~is_broken[rows], "with a coordinate that is none")]


def _describe_drops(drops: DropCounter, total: int) -> tuple[dict[str, int], list[str]]:
    """How many of all points were dropped, by each reason that applies; and lines that say it."""
    dropped = {why: count for why, count in drops.dropped.items() if count}
    notes = [
        f"sparse: dropped {count:,} of {total:,} points {why}" for why, count in dropped.items()
    ]
    return dropped, notes


def cloud_points(
    path: Path | str, xyz: NDArray[np.floating], scale: float | None = None
) -> CloudInMetres:
    """Returns the points of a cloud that no scanner at its origin measured, in metres.

    Its coordinates are of a map or a survey. Their distances from the origin are no ranges, so the
    rules of a scan do not apply, and no coordinate is too large.

    Args:
        path: Path of the cloud, for messages.
        xyz: (N, 3), as they are stored.
        scale: Numbers per metre that the user states. None: the cloud is in metres.

    Raises:
        NoPointsError: No point has three finite coordinates.
    """
    drops = DropCounter()
    has_place = np.isfinite(xyz).all(axis=1)
    rows = np.flatnonzero(drops.keep(has_place, "with a coordinate that is none"))
    if not len(rows):
        raise NoPointsError(
            f"{path}: none of its {len(xyz):,} points has coordinates; give another cloud"
        )
    dropped, notes = _describe_drops(drops, len(xyz))
    if scale is not None and scale != 1:
        notes.append(f"{path}: ÷ {scale:g}, as is stated")
    points = np.asarray(xyz[rows], np.float64) / (scale or 1.0)
    return CloudInMetres(points, dropped, notes)


def has_scanner(xyz: NDArray[np.floating]) -> bool:
    """Returns whether one scanner at the origin may have measured the points (N, 3).

    A scanner sees one surface in each direction. Of cells with two points or more, 11 % at most
    have surfaces at very different ranges in five scans, whole and thinned, and 13 to 49 % where
    the same scans are moved 10 m away. The cells are the smallest of which many have two points:
    in smaller ones, two points are of different beams. Too few points may always be of a scanner.
    """
    # Ranges and directions of the points.
    points = np.asarray(xyz, np.float64)
    range_m = np.linalg.norm(points, axis=1)
    is_usable = np.isfinite(range_m) & (range_m > _AT_SENSOR_M)
    if np.count_nonzero(is_usable) < _FEWEST_RETURNS:
        return True
    points = points[is_usable]
    range_m = range_m[is_usable]
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation_deg = np.degrees(np.arcsin(np.clip(points[:, 2] / range_m, -1, 1)))
    # The smallest cells of which many have two points or more; else the largest ones.
    for cell_deg in _CELLS_DEG:
        column = np.floor(azimuth_deg / cell_deg)
        row = np.floor(elevation_deg / cell_deg)
        _, cell_of_point, counts = np.unique(
            column * _CELL_ROWS + row, return_inverse=True, return_counts=True
        )
        is_shared = counts >= 2
        if is_shared.mean() >= _MANY_SHARED:
            break
    if np.count_nonzero(is_shared) < _FEWEST_SHARED:
        return True
    # How many of these cells hold very different ranges.
    log_range = np.log(range_m)
    nearest = np.full(len(counts), np.inf)
    farthest = np.full(len(counts), -np.inf)
    np.minimum.at(nearest, cell_of_point, log_range)
    np.maximum.at(farthest, cell_of_point, log_range)
    has_several_surfaces = (farthest - nearest)[is_shared] > _SEVERAL_SURFACES
    return float(has_several_surfaces.mean()) < _MOST_SEVERAL


def _at_one_place(xyz: NDArray[np.float64]) -> Mask:
    """(N,) true for points of a scan (N, 3) at the place of most of them, if too many are there."""
    if len(xyz) < _FEWEST_POINTS:
        return np.zeros(len(xyz), bool)
    # Places are compared as one number each: a sum with weights that no coordinates have.
    place = xyz @ (1.0, np.pi, np.e**2)
    places, counts = np.unique(place, return_counts=True)
    if counts.max() < max(_FEWEST_AT_PLACE, _SAME_PLACE * len(xyz)):
        return np.zeros(len(xyz), bool)
    return np.asarray(place == places[counts.argmax()])
