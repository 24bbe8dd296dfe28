"""Times in the names of files, which say whether an image and its depth are of one moment."""

from __future__ import annotations

import functools
import re
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import NamedTuple

from pnpdepth_cli.dataset.frame_files import SCAN_ONLY_SUFFIXES

_STAMP = re.compile(r"(?:.*[^\d.])?(\d+\.\d{3,9}|\d{13}|\d{16}|\d{19})")
"""Seconds with decimals as TUM has them, or ms, µs or ns since 1970, as nuScenes and EuRoC."""
_DIGITS_OF_SECONDS = 10
"""Digits of the whole seconds since 1970, in the years 2001 to 2286."""
_USUAL_PERIOD_S = 0.1
"""Time between frames, where no other files tell it: a LiDAR's."""
_FEWEST_TIMES = 3
"""Files of a folder that tell the time between frames."""
_APART = 0.6
"""Multiple of the time between frames, up to which an image and its depth are of one moment. The
nearest frame is within half of it; TUM's associate.py allows 0.02 s at 30 Hz, 0.6 of it."""
_APART_OF_SCANS = 1.1
"""The same of scans, whose time is of their end, or of their begin."""
_OTHER_CLOCK_S = 3600.0
"""Times that are farther apart are of two clocks."""
_FOLDERS_KEPT = 16
"""Folders whose times are kept, as all frames of a sequence have their depth in one."""


class _Times(NamedTuple):
    """The times of the files of a folder."""

    names: dict[float, str]
    """Names of files by their time in s, the earliest first."""
    period_s: float
    """Time between two frames."""


def time_of(path: Path) -> float | None:
    """Returns the time in s that a file's name ends with, before its suffix; None for others."""
    stem = path.stem
    inner_suffix = Path(stem).suffix
    if inner_suffix[1:].isalpha():  # .pcd.bin
        stem = stem.removesuffix(inner_suffix)
    match = _STAMP.fullmatch(stem)
    if match is None:
        return None
    number = match[1]
    if "." in number:
        return float(number)
    # The digits behind those of whole seconds are ms, µs or ns.
    return int(number) / 10.0 ** (len(number) - _DIGITS_OF_SECONDS)


def time_warning(image: Path, depth: Path) -> str | None:
    """Returns a warning if an image and its depth are of two moments by their names, else None."""
    image_s = time_of(image)
    depth_s = time_of(depth)
    if image_s is None or depth_s is None:
        return None
    gap_s = abs(depth_s - image_s)
    if gap_s == 0 or gap_s > _OTHER_CLOCK_S:
        return None
    # The time between frames is that of the files beside the depth. They are listed again only if
    # their folder changed.
    folder = depth.parent
    times = _times_of(folder, depth.suffix, folder.stat().st_mtime_ns)
    is_scan = depth.suffix.lower() in SCAN_ONLY_SUFFIXES
    if gap_s <= (_APART_OF_SCANS if is_scan else _APART) * times.period_s:
        return None
    # One of these may be nearer to the image.
    nearest_s = min(times.names, key=lambda time_s: abs(time_s - image_s))
    way_out = "give depth of the same time"
    if abs(nearest_s - image_s) < gap_s:
        way_out = f"{times.names[nearest_s]} is nearer"
    return (
        f"warning: by their names {depth} is {1000 * gap_s:.0f} ms"
        f" {'after' if depth_s > image_s else 'before'} {image}, and frames are"
        f" {1000 * times.period_s:.0f} ms apart; {way_out}"
    )


@functools.lru_cache(maxsize=_FOLDERS_KEPT)
def _times_of(folder: Path, suffix: str, changed_ns: int) -> _Times:
    """The times of a folder's files of this suffix, one of which has a time, at least.

    Args:
        folder: The folder, which is listed once for all frames of a batch.
        suffix: Suffix of the files, with its dot.
        changed_ns: When the folder was last changed, so that one that grows is listed again.
    """
    names = dict[float, str]()
    for path in sorted(folder.iterdir()):
        time_s = time_of(path) if path.suffix == suffix else None
        if time_s is not None:
            names[time_s] = path.name
    in_order = sorted(names)
    steps_s = [later - earlier for earlier, later in pairwise(in_order)]
    period_s = median(steps_s) if len(names) >= _FEWEST_TIMES else _USUAL_PERIOD_S
    return _Times({time_s: names[time_s] for time_s in in_order}, period_s)
