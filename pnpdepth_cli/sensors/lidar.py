"""Rotating LiDARs as lists of beams: the paper's four by data sheet, and as the paper has them.

A rotating LiDAR fires all its beams at every azimuth step. Elevations are degrees above the
horizontal; its frame is x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pnpdepth_cli.choices import SENSORS
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.sensors.sparse import Floats

FORWARD_LEFT_UP: Floats = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""The rotation from a scanner's frame to that of a camera facing the same way."""

_MOST_RAYS = 1 << 23
"""Points of one revolution, so that simulating them fits into memory; 128 beams give 460,000."""


@dataclass(frozen=True, kw_only=True)
class Lidar:
    """A rotating LiDAR; noise is given as standard deviations."""

    name: str
    elevations_deg: tuple[float, ...]
    """Elevation of each beam, −90° to 90°."""
    azimuth_step_deg: float
    """Angle between firings."""
    max_range: float = np.inf
    """Metres from the scanner."""
    range_noise: float = 0.0
    """Metres."""
    angle_noise_deg: float = 0.0
    """Of the direction of each measurement, in elevation and in azimuth."""
    rotation_noise_deg: float = 0.0
    """Of a rotation of the whole scanner about each axis."""
    dropout: float = 0.0
    """Fraction of beams without return."""

    def __post_init__(self) -> None:
        angles, step = np.array(self.elevations_deg, np.float64), self.azimuth_step_deg
        rays = angles.size * round(360 / step) if 0.001 <= step <= 360 else 0
        noise = (self.range_noise, self.angle_noise_deg)
        faults = {
            "elevations must be between −90° and 90°": (
                not angles.size or not (np.abs(angles) <= 90).all()
            ),
            f"azimuth_step_deg must be 0.001 to 360, got {step:g}": not 0.001 <= step <= 360,
            f"it measures {rays:,} points per revolution; at most {_MOST_RAYS:,}": (
                rays > _MOST_RAYS
            ),
            f"max_range must be > 0, got {self.max_range:g}": not self.max_range > 0,
            "noise must be >= 0": not all(0 <= size < np.inf for size in noise),
            f"rotation_noise_deg must be 0 to 360, got {self.rotation_noise_deg:g}": (
                not 0 <= self.rotation_noise_deg <= 360
            ),
            f"dropout must be >= 0 and < 1, got {self.dropout:g}": not 0 <= self.dropout < 1,
        }
        for fault, holds in faults.items():
            if holds:
                raise UsageError(f"sensor {self.name!r}: {fault}")

    def directions(self, rng: np.random.Generator) -> Floats:
        """Returns (M, 3) unit vectors of one revolution in the scanner's frame, beam by beam."""
        elevation = np.radians(self.elevations_deg)[:, None]
        steps = round(360 / self.azimuth_step_deg)
        azimuth = np.radians(np.arange(steps) * self.azimuth_step_deg)[None, :]
        elevation, azimuth = np.broadcast_arrays(elevation, azimuth)
        if self.angle_noise_deg > 0:
            std = np.radians(self.angle_noise_deg)
            elevation = elevation + rng.normal(0, std, elevation.shape)
            azimuth = azimuth + rng.normal(0, std, azimuth.shape)
        level = np.cos(elevation)
        return np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1
        ).reshape(-1, 3)


def evenly_spaced(top_deg: float, step_deg: float, beams: int) -> tuple[float, ...]:
    """Returns elevations in degrees from the top downwards."""
    return tuple(round(top_deg - step_deg * beam, 6) for beam in range(beams))


# Azimuth steps are those at 10 revolutions a second; firing times and angles from the manuals:
# Velodyne VLP-16 user manual 63-9243, VLP-32C 63-9325, HDL-32E 63-9113, HDL-64E S2 63-HDL64ES2.
_VLP_32C_DEG = (
    15.0, 10.333, 7.0, 4.667, 3.333, 2.333, 1.667, 1.333, 1.0, 0.667, 0.333, 0.0, -0.333, -0.667,
    -1.0, -1.333, -1.667, -2.0, -2.333, -2.667, -3.0, -3.333, -3.667, -4.0, -4.667, -5.333, -6.148,
    -7.254, -8.843, -11.31, -15.639, -25.0,
)  # fmt: skip
_SHEETS = {
    "vlp-16": (evenly_spaced(15, 2, 16), 0.2, 100, 0.03),
    "vlp-32c": (_VLP_32C_DEG, 0.2, 200, 0.03),
    "hdl-32e": (evenly_spaced(10 + 2 / 3, 4 / 3, 32), 0.166, 100, 0.02),
    "hdl-64e": (evenly_spaced(2, 1 / 3, 32) + evenly_spaced(-8.83, 0.5, 32), 0.1728, 120, 0.02),
}
"""Elevations and azimuth step, degrees; range and its noise, metres."""

# Wang et al. 2019, table on LiDAR types: field of view and vertical resolution, beams evenly
# spaced. The table gives no elevation of the top beam, which is the data sheet's here. It gives no
# azimuth step and no size of its "random noise on rotation" either: these two are ours, chosen once
# for all four so that their fractions of sampled pixels are about those printed there, in SYNTHIA's
# view of 100° by 71° at 512×304 pixels.
_PAPER_FOV = {
    "vlp-16": (30, 2.0, 15.0),
    "vlp-32c": (40, 0.3, 15.0),
    "hdl-32e": (41, 1.3, 10.67),
    "hdl-64e": (27, 0.4, 2.0),
}
_PAPER_NOISE = {"azimuth_step_deg": 0.19, "angle_noise_deg": 0.4}


def _by_sheet(name: str) -> Lidar:
    elevations_deg, step_deg, max_range, range_noise = _SHEETS[name]
    return Lidar(
        name=name,
        elevations_deg=elevations_deg,
        azimuth_step_deg=step_deg,
        max_range=max_range,
        range_noise=range_noise,
    )


def _paper(name: str) -> Lidar:
    fov_deg, step_deg, top_deg = _PAPER_FOV[name]
    return Lidar(
        name=f"paper-{name}",
        elevations_deg=evenly_spaced(top_deg, step_deg, int(fov_deg / step_deg + 1e-9) + 1),
        **_PAPER_NOISE,
    )


LIDARS: dict[str, Lidar] = {
    sensor.name: sensor for make in (_by_sheet, _paper) for sensor in map(make, SENSORS)
}
"""The scanners that can be named; `choices.SENSORS` lists those by data sheet."""
