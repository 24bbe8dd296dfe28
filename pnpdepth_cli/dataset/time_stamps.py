"""Times in the names of files, which say whether an image and its depth are of one moment."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from statistics import median

from pnpdepth_cli.dataset.frame_files import SCAN_ONLY_SUFFIXES

_STAMP = re.compile(r"(?:.*[^\d.])?(\d+\.\d{3,9}|\d{13}|\d{16}|\d{19})")
"""Seconds with decimals as TUM has them, or ms, µs or ns since 1970, as nuScenes and EuRoC."""
_DIGITS_OF_SECONDS = 10  # of a time since 1970
_USUAL_PERIOD_S = 0.1  # of a LiDAR, where no other files tell
_FEWEST = 3  # files of a folder that tell the time between frames
_APART = 0.6
"""Of the time between frames; nearer are half of it, and what TUM's associate.py allows."""
_APART_OF_SCANS = 1.1
"""The same of scans, whose time is of their end, or of their begin."""
_OTHER_CLOCK_S = 3600.0  # farther apart are the times of two clocks


def time_of(path: Path) -> float | None:
    """Returns the time in s that a file's name ends with, before its suffix; None for others."""
    stem = path.stem
    inner = Path(stem).suffix
    if inner[1:].isalpha():  # .pcd.bin
        stem = stem.removesuffix(inner)
    found = _STAMP.fullmatch(stem)
    if found is None:
        return None
    number = found[1]
    if "." in number:
        return float(number)
    return int(number) / 10.0 ** (len(number) - _DIGITS_OF_SECONDS)


def time_warning(image: Path, depth: Path) -> str | None:
    """Returns a warning if an image and its depth are of two moments by their names, else None."""
    time_s = time_of(image)
    of_depth_s = time_of(depth)
    if time_s is None or of_depth_s is None:
        return None
    gap_s = abs(of_depth_s - time_s)
    if gap_s == 0 or gap_s > _OTHER_CLOCK_S:
        return None
    # The time between frames is that of the files beside the depth.
    times = dict[float, Path]()
    for other in depth.parent.iterdir():
        of_other_s = time_of(other) if other.suffix == depth.suffix else None
        if of_other_s is not None:
            times[of_other_s] = other
    steps = [later - earlier for earlier, later in pairwise(sorted(times))]
    period_s = median(steps) if len(times) >= _FEWEST else _USUAL_PERIOD_S
    is_scan = depth.suffix.lower() in SCAN_ONLY_SUFFIXES
    if gap_s <= (_APART_OF_SCANS if is_scan else _APART) * period_s:
        return None
    nearest_s = min(times, key=lambda of_other_s: abs(of_other_s - time_s))
    way_out = "give depth of the same time"
    if abs(nearest_s - time_s) < gap_s:
        way_out = f"{times[nearest_s].name} is nearer"
    return (
        f"warning: by their names {depth} is {1000 * gap_s:.0f} ms"
        f" {'after' if of_depth_s > time_s else 'before'} {image}, and frames are"
        f" {1000 * period_s:.0f} ms apart; {way_out}"
    )
