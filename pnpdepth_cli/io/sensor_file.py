"""A user's own LiDAR, described in a small TOML file.

name = "my-lidar"
elevations_deg = [10, 5, 0, -5, -10]      # or: top_deg, step_deg and beams
azimuth_step_deg = 0.2
max_range = 80                            # metres; optional, as all below
range_noise = 0.02                        # metres, standard deviation
angle_noise_deg = 0.05
rotation_noise_deg = 0.1
dropout = 0.05
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
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
OPTIONAL = ("max_range", "range_noise", "angle_noise_deg", "rotation_noise_deg", "dropout")


def read_sensor(path: Path) -> dict[str, Any]:
    """Returns the fields of `sensors.Lidar` that a TOML file gives.

    Raises:
        InputError: The file cannot be read, or does not describe a LiDAR.
    """
    try:
        table = tomllib.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"{path} is not valid TOML ({one_line(error)}); correct it"
        ) from error
    known = {"name", "elevations_deg", "azimuth_step_deg", *_EVEN, *OPTIONAL}
    unknown = sorted(set(table) - known)
    if unknown:
        raise FileFormatError(
            f"{path}: {unknown[0]!r} is not part of a sensor; use {', '.join(sorted(known))}"
        )
    numbers = ["azimuth_step_deg", *(key for key in OPTIONAL if key in table)]
    return {
        "name": str(table.get("name", path.stem)),
        "elevations_deg": _elevations(path, table),
        **{key: _number(path, key, table.get(key)) for key in numbers},
    }


def _elevations(path: Path, table: Mapping[str, Any]) -> tuple[float, ...]:
    if "elevations_deg" in table:
        if any(key in table for key in _EVEN):
            raise FileFormatError(f"{path}: give elevations_deg, or {', '.join(_EVEN)}, not both")
        listed = table["elevations_deg"]
        if not isinstance(listed, list) or not 0 < len(listed) <= _MOST_BEAMS:
            raise FileFormatError(
                f"{path}: elevations_deg is not a list of at most {_MOST_BEAMS:,} degrees"
            )
        return tuple(_number(path, "elevations_deg", item) for item in listed)
    top, step, beams = (_number(path, key, table.get(key)) for key in _EVEN)
    if not (1 <= beams <= _MOST_BEAMS and beams == int(beams)):
        raise FileFormatError(
            f"{path}: beams is {beams:g}; give a whole number from 1 to {_MOST_BEAMS}"
        )
    return tuple(top - step * beam for beam in range(int(beams)))


def _number(path: Path, key: str, value: Any) -> float:
    # TOML has true, nan, and whole numbers of any length
    if type(value) not in (int, float) or not abs(value) <= sys.float_info.max:
        fact = "is missing" if value is None else "is not a number"
        raise FileFormatError(f"{path}: {key} {fact}; write {key} = NUMBER")
    return float(value)
