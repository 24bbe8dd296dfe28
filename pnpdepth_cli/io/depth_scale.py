"""Codes per metre of integer depth files."""

from __future__ import annotations

import math
import re
from pathlib import Path

from pnpdepth_cli.errors import FileFormatError, UsageError

KITTI_SCALE = 256.0
"""Codes per metre in the KITTI depth files, assumed for integers that do not say their own."""

SCALE_KEY = "pnpdepth:scale"
"""Key under which our own 16-bit files keep their codes per metre."""

SATURATED_CODE = 65535
"""The largest 16-bit code: what a sensor gives beyond its range, so never a measurement."""


def check_scale(scale: float | None) -> None:
    """Raises UsageError unless the scale is None or a finite number above 0."""
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise UsageError(f"--depth-scale must be a finite number above 0, not {scale:g}")


def scale_in_text(path: Path, text: str) -> float | None:
    """Returns the codes per metre in a text such as "pnpdepth:scale=256", None without one.

    Raises:
        FileFormatError: The text names a scale that is not a finite number above 0.
    """
    match = re.search(re.escape(SCALE_KEY) + r"=(\S+)", text)
    if match is None:
        return None
    try:
        scale = float(match[1])
    except ValueError:
        scale = math.nan
    if not (math.isfinite(scale) and scale > 0):
        raise FileFormatError(
            f"{path} says {SCALE_KEY}={match[1][:40]}, which is no scale; write the file again"
        )
    return scale
