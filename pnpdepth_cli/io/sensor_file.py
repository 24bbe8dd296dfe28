"""A user's own LiDAR, described in a small TOML file.

name = "my-lidar"
elevations_deg = [10, 5, 0, -5, -10]      # or: top_deg, step_deg and beams
azimuth_step_deg = 0.2
max_range = 80                            # metres; optional, as the two below
range_noise = 0.02                        # metres, standard deviation
angle_noise_deg = 0.05
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import one_line, read_bytes

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_EVEN = ("top_deg", "step_deg", "beams")
_MOST_BEAMS = 4096
_OPTIONAL = {"max_range": math.inf, "range_noise": 0.0, "angle_noise_deg": 0.0}


@dataclass(frozen=True, kw_only=True)
class SensorFile:
    """A LiDAR as the file describes it; the fields are those of `sensors.Lidar`."""

    name: str
    """As users and records call it."""

    elevations_deg: tuple[float, ...]
    """Elevation of each beam."""

    azimuth_step_deg: float
    """Angle between firings."""

    max_range: float
    """Metres; may be infinite."""

    range_noise: float
    """Standard deviation of a range, metres."""

    angle_noise_deg: float
    """Standard deviation of a direction."""


def read_sensor(path: Path) -> SensorFile:
    """Returns the LiDAR that a TOML file describes.

    Raises:
        InputError: The file cannot be read, or does not describe one.
    """
    try:
        table = tomllib.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"{path} is not valid TOML ({one_line(error)}); correct it"
        ) from error
    known = {"name", "elevations_deg", "azimuth_step_deg", *_EVEN, *_OPTIONAL}
    unknown = sorted(set(table) - known)
    if unknown:
        raise FileFormatError(
            f"{path}: {unknown[0]!r} is not part of a sensor; use {', '.join(sorted(known))}"
        )
    return SensorFile(
        name=str(table.get("name", path.stem)),
        elevations_deg=_elevations(path, table),
        azimuth_step_deg=_number(path, table, "azimuth_step_deg"),
        **{key: _number(path, {key: default} | table, key) for key, default in _OPTIONAL.items()},
    )


def _elevations(path: Path, table: dict[str, Any]) -> tuple[float, ...]:
    if "elevations_deg" in table:
        if any(key in table for key in _EVEN):
            raise FileFormatError(f"{path}: give elevations_deg, or {', '.join(_EVEN)}, not both")
        listed = table["elevations_deg"]
        if not isinstance(listed, list) or not listed:
            raise FileFormatError(f"{path}: elevations_deg is not a list of degrees")
        if len(listed) > _MOST_BEAMS:
            raise FileFormatError(
                f"{path}: {len(listed):,} elevations; give at most {_MOST_BEAMS:,}"
            )
        return tuple(_number(path, {"elevations_deg": item}, "elevations_deg") for item in listed)
    top, step, beams = (_number(path, table, key) for key in _EVEN)
    if not (1 <= beams <= _MOST_BEAMS and beams == int(beams)):
        raise FileFormatError(
            f"{path}: beams is {beams:g}; give a whole number from 1 to {_MOST_BEAMS}"
        )
    return tuple(top - step * beam for beam in range(int(beams)))


def _number(path: Path, table: dict[str, Any], key: str) -> float:
    value: Any = table.get(key)
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if math.isnan(number) or not isinstance(value, (int, float)):
        fact = "is missing" if value is None else f"is {_short(value)}, not a number"
        raise FileFormatError(f"{path}: {key} {fact}; write {key} = NUMBER")
    return number


def _short(value: Any) -> str:
    try:
        return one_line(value)[:40]
    except (ValueError, RecursionError):  # more digits than Python writes, or lists in lists
        return "too long"
