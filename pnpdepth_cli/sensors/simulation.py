"""Sparse depth made of dense depth: sampled by a pattern, or measured by a simulated LiDAR.

The paper's four LiDARs are there by data sheet, and as the paper has them.

A rotating LiDAR fires all its beams at every azimuth step. Elevations are degrees above the
horizontal; its coordinates are x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli import choices
from pnpdepth_cli.camera import Camera, Floats
from pnpdepth_cli.errors import NoPointsError, UsageError, unequal_sizes
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.points import Size
from pnpdepth_cli.sensors.projection import DropCounter, Points, pixel_index

Pixels = NDArray[np.intp]
"""(N,) row-major indices of pixels."""

_LEAST_AHEAD = 1e-9
"""Least z, along the camera's axis, of the unit vector of a beam that looks ahead. Depth is divided
by it."""

FORWARD_LEFT_UP: Floats = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""The rotation from a scanner's coordinates to those of a camera facing the same way."""


@dataclass(frozen=True, kw_only=True)
class Lidar:
    """A rotating LiDAR; noise is given as standard deviations."""

    name: str
    elevations_deg: tuple[float, ...]  # elevation of each beam, −90° to 90°
    azimuth_step_deg: float  # angle between firings
    max_range: float = np.inf  # metres from the scanner
    range_noise: float = 0.0  # metres
    angle_noise_deg: float = 0.0
    """Standard deviation of each measurement's direction, in elevation and in azimuth."""

    def directions(self, rng: np.random.Generator) -> Floats:
        """Returns (M, 3) unit vectors of one revolution in scanner coordinates, beam after beam.

        The axes are x forward, y left, z up; azimuth is from x to y.

        Args:
            rng: Generator of the noise of the angles.
        """
        steps = round(360 / self.azimuth_step_deg)
        azimuth_deg = np.arange(steps) * self.azimuth_step_deg
        elevation, azimuth = np.radians(
            np.meshgrid(self.elevations_deg, azimuth_deg, indexing="ij")
        ).reshape(2, -1)
        if self.angle_noise_deg > 0:
            std = np.radians(self.angle_noise_deg)
            elevation = elevation + rng.normal(0, std, elevation.shape)
            azimuth = azimuth + rng.normal(0, std, azimuth.shape)
        x = np.cos(elevation) * np.cos(azimuth)
        y = np.cos(elevation) * np.sin(azimuth)
        z = np.sin(elevation)
        return np.column_stack([x, y, z])


def evenly_spaced(top_deg: float, step_deg: float, beams: int) -> tuple[float, ...]:
    """Returns elevations of beams in degrees, from the top downwards by equal steps."""
    return tuple(round(top_deg - step_deg * beam, 6) for beam in range(beams))


# Azimuth steps are those at 10 revolutions a second; firing times and angles from the manuals:
# Velodyne VLP-16 user manual 63-9243, VLP-32C 63-9325, HDL-32E 63-9113, HDL-64E S2 63-HDL64ES2.
_VLP_32C_DEG = (
    15.0, 10.333, 7.0, 4.667, 3.333, 2.333, 1.667, 1.333, 1.0, 0.667, 0.333, 0.0, -0.333, -0.667,
    -1.0, -1.333, -1.667, -2.0, -2.333, -2.667, -3.0, -3.333, -3.667, -4.0, -4.667, -5.333, -6.148,
    -7.254, -8.843, -11.31, -15.639, -25.0,
)  # fmt: skip
_HDL_64E_DEG = evenly_spaced(2, 1 / 3, 32) + evenly_spaced(-8.83, 0.5, 32)


def _from_sheet(
    name: str,
    elevations_deg: tuple[float, ...],
    azimuth_step_deg: float,
    max_range: float,
    range_noise: float,
) -> Lidar:
    """The scanner of a data sheet, which has no noise of angles; the arguments are its fields."""
    return Lidar(
        name=name,
        elevations_deg=elevations_deg,
        azimuth_step_deg=azimuth_step_deg,
        max_range=max_range,
        range_noise=range_noise,
    )


def _from_paper(name: str, elevations_deg: tuple[float, ...]) -> Lidar:
    """A scanner of Wang et al. 2019, table on LiDAR types.

    It has fields of view of 30, 40, 41 and 27 degrees, with beams evenly spaced by the vertical
    resolution. The table gives no elevation of the top beam, which is the data sheet's here. It
    gives no azimuth step and no size of its "random noise on rotation" either: these two are ours,
    chosen once for all four so that their fractions of sampled pixels are about those printed
    there, in SYNTHIA's view of 100° by 71° at 512×304.
    """
    return Lidar(
        name=name, elevations_deg=elevations_deg, azimuth_step_deg=0.19, angle_noise_deg=0.4
    )


VLP_16 = _from_sheet("vlp-16", evenly_spaced(15, 2, 16), 0.2, 100, 0.03)
VLP_32C = _from_sheet("vlp-32c", _VLP_32C_DEG, 0.2, 200, 0.03)
HDL_32E = _from_sheet("hdl-32e", evenly_spaced(10 + 2 / 3, 4 / 3, 32), 0.166, 100, 0.02)
HDL_64E = _from_sheet("hdl-64e", _HDL_64E_DEG, 0.1728, 120, 0.02)
PAPER_VLP_16 = _from_paper("paper-vlp-16", evenly_spaced(15, 2, 16))
PAPER_VLP_32C = _from_paper("paper-vlp-32c", evenly_spaced(15, 0.3, 134))
PAPER_HDL_32E = _from_paper("paper-hdl-32e", evenly_spaced(10.67, 1.3, 32))
PAPER_HDL_64E = _from_paper("paper-hdl-64e", evenly_spaced(2, 0.4, 68))


def lidar_of(
    name: str | None, beams: int | None, vertical_fov: tuple[float, float] | None
) -> Lidar:
    """Returns the scanner of a name, or one of a number of beams, without noise.

    The latter has a VLP-16's azimuth step.

    Args:
        name: Name in `choices.SENSORS`. None with the other two arguments.
        beams: Number of beams, evenly spaced in elevation. None with a name.
        vertical_fov: Elevations of the uppermost and the lowest beam, degrees. None with a name.

    Raises:
        UsageError: There is no such field of view, or neither or both are given.
    """
    if name is not None and beams is None and vertical_fov is None:
        named: Lidar = choices.SENSORS[name]
        return named
    if name is not None or beams is None or vertical_fov is None:
        raise UsageError("give --sensor, or --beams and --vertical-fov")
    top_deg, bottom_deg = vertical_fov
    if not -90 <= bottom_deg <= top_deg <= 90 or (top_deg == bottom_deg and beams > 1):
        raise UsageError(
            f"there is no field of view from {top_deg:g}° down to {bottom_deg:g}°; give TOP and"
            " BOTTOM from 90° to −90°, or two equal ones of one beam"
        )
    elevations = evenly_spaced(top_deg, (top_deg - bottom_deg) / max(beams - 1, 1), beams)
    return Lidar(
        name=f"{beams} beams",
        elevations_deg=elevations,
        azimuth_step_deg=VLP_16.azimuth_step_deg,
    )


def simulate_lidar(depth: NDArray[np.floating], camera: Camera, sensor: Lidar, seed: int) -> Points:
    """Returns sparse depth of one revolution of a scanner at the camera's place, facing its way.

    Args:
        depth: (H, W) metres along the camera's axis, 0 = unknown.
        camera: The camera of the image.
        sensor: Beams, range and noise of the scanner.
        seed: Random seed of all noise; the same seed gives the same points.

    Raises:
        NoPointsError: No beam hits anything that the camera sees.
    """
    size = (depth.shape[0], depth.shape[1])
    # The beams (M, 3) that look ahead, in the camera's coordinates, and the depth that each meets.
    rng = np.random.default_rng(seed)
    beams = sensor.directions(rng) @ FORWARD_LEFT_UP.T
    beams = beams[beams[:, 2] > _LEAST_AHEAD]
    drops = DropCounter()
    # The scanner is at the camera's centre, so a beam stays in one pixel at all depths.
    beams, xy = drops.keep_seen(beams, camera, size)
    z = np.asarray(depth, np.float64).ravel()[pixel_index(xy, size)]
    is_met = drops.keep(z > 0, "meets nothing that the camera sees")
    z, beams = z[is_met], beams[is_met]
    # The distance of what it meets, as the scanner measures it: along the beam, with noise.
    distance = z / beams[:, 2]
    in_range = drops.keep(distance <= sensor.max_range, "out of range")
    distance, beams = distance[in_range], beams[in_range]
    if sensor.range_noise > 0:
        distance = distance + rng.normal(0, sensor.range_noise, len(distance))
    # The points, which noise moves along their beams; of each pixel the nearest.
    points = beams * distance[:, None]
    ahead = drops.keep(distance > 0, "noise put it behind the camera")
    points = points[ahead]
    points, xy = drops.keep_seen(points, camera, size)
    if not len(xy):
        raise NoPointsError(
            f"no beam of {sensor.name} gives a point in the image ({drops}); check depth and"
            " intrinsics"
        )
    return drops.points(points, xy, size)


def sample_points(
    depth: NDArray[np.float32],
    pattern: SamplePattern,
    seed: int,
    *,
    image: NDArray[np.float32] | None = None,
) -> Points:
    """Returns points sampled from a dense depth map; the same seed gives the same points.

    Args:
        depth: (H, W) metres, 0 = unknown.
        pattern: Kind of the pattern, and how many points or lines are wanted.
        seed: Random seed of the patterns "uniform" and "shuffle".
        image: (H, W, 3) in 0…1 of the same view, for the pattern "features".

    Raises:
        NoPointsError: The depth map or the pattern leaves no point.
        UsageError: More points or lines are asked for than there are, or the image is missing.
        InputError: Image and depth differ in size.
    """
    size = (depth.shape[0], depth.shape[1])
    if image is not None and image.shape[:2] != size:
        raise unequal_sizes("the image", image.shape, "the depth", size)
    known_pixels = np.flatnonzero(np.isfinite(depth) & (depth > 0))
    if not known_pixels.size:
        raise NoPointsError(
            "the depth map has no pixel with known depth to sample from; give one with depth above"
            " 0"
        )
    # Points are in the order of the image's rows, whatever the pattern's order.
    chosen = np.sort(_pixels_of_pattern(pattern, known_pixels, size, seed, image))
    if not chosen.size:
        raise NoPointsError(f"pattern {pattern.kind!r} leaves no point; ask for more")
    row, column = np.divmod(chosen, size[1])
    return Points(
        xy=np.stack([column, row], axis=1).astype(np.float32),
        depth=depth.ravel()[chosen].astype(np.float32),
        size=size,
    )


def _pixels_of_pattern(
    pattern: SamplePattern,
    known_pixels: Pixels,
    size: Size,
    seed: int,
    image: NDArray[np.float32] | None,
) -> Pixels:
    """The pixels of a pattern that have a depth.

    Args:
        pattern: Kind of the pattern, and how many points or lines are wanted.
        known_pixels: Pixels that have a depth, rising.
        size: (H, W) of the depth map.
        seed: Random seed of the patterns "uniform" and "shuffle".
        image: (H, W, 3) in 0…1, for the pattern "features".

    Raises:
        UsageError: More points or lines are asked for than there are, or the image is missing.
    """
    height, width = size
    wanted = pattern.wanted(known_pixels.size)
    match pattern.kind:
        case "uniform":
            if wanted > known_pixels.size:
                raise UsageError(
                    f"{wanted:,} points of {known_pixels.size:,} known pixels; ask for fewer"
                )
            return np.random.default_rng(seed).choice(known_pixels, wanted, replace=False)
        case "shuffle":  # as Marigold-DC does, by numpy's legacy generator
            rows = known_pixels[:, None].copy()  # rows of an array are shuffled unlike a flat one
            np.random.RandomState(seed).shuffle(rows)
            return np.asarray(rows[:wanted, 0])
        case "grid":
            fraction = pattern.fraction
            if fraction is None:
                fraction = wanted / (height * width)
            return np.intersect1d(_grid(fraction, size), known_pixels)
        case "lines":
            lines = _lines(pattern.wanted(height), height)
            return np.asarray(known_pixels[np.isin(known_pixels // width, lines)])
        case _:  # features
            corners = _corners(image, wanted)
            return np.asarray(corners[np.isin(corners, known_pixels)][:wanted])


def _grid(fraction: float, size: Size) -> Pixels:
    """The pixels at the nodes of a square grid, about a fraction of all pixels of an image.

    Args:
        fraction: Fraction of the pixels, above 0.
        size: (H, W) of the image.
    """
    height, width = size
    spacing_px: float = max(1.0, fraction**-0.5)
    rows = _nodes(height, spacing_px)
    columns = _nodes(width, spacing_px)
    pixels: Pixels = (rows[:, None] * width + columns).astype(np.intp).ravel()
    return pixels


def _nodes(side: int, spacing_px: float) -> Floats:
    """Whole coordinates of a grid's nodes along one side of an image, at least one.

    Args:
        side: Number of pixels of the side.
        spacing_px: Distance of the nodes; the first is half of that from the image's edge.
    """
    count = max(1, round(side / spacing_px))
    nodes: Floats = np.floor((np.arange(count) + 0.5) * spacing_px).clip(max=side - 1)
    return nodes


def _lines(count: int, height: int) -> Pixels:
    """The numbers of `count` evenly spaced rows of an image. Raises UsageError if it has fewer."""
    if count > height:
        raise UsageError(f"{count:,} lines do not fit {height:,} rows; ask for fewer")
    return np.floor((np.arange(count) + 0.5) * height / count).astype(np.intp)


def _corners(image: NDArray[np.float32] | None, wanted: int) -> Pixels:
    """The pixels of corners of an image, the strongest first, as structure from motion finds them.

    Args:
        image: (H, W, 3) in 0…1.
        wanted: Number of corners that are needed; there may be more or fewer.

    Raises:
        UsageError: There is no image.
    """
    if image is None:
        raise UsageError("pattern 'features' needs the image that the depth belongs to; give it")
    grey = cv2.cvtColor(image.clip(0, 1), cv2.COLOR_RGB2GRAY)
    # ORB's corners of several pyramid levels share pixels: three times as many, and some, leave
    # enough when each pixel counts once. A low `fastThreshold` finds weak corners, too.
    detector = cv2.ORB_create(nfeatures=3 * wanted + 100, edgeThreshold=4, fastThreshold=5)  # type: ignore[attr-defined]
    corners = detector.detect(np.rint(255 * grey).astype(np.uint8))
    strongest_first = sorted(corners, key=lambda corner: -corner.response)
    xy = np.array([corner.pt for corner in strongest_first])
    column, row = np.rint(xy.reshape(-1, 2)).astype(np.intp).T
    pixels = (row * image.shape[1] + column).tolist()
    return np.array(list(dict.fromkeys(pixels)), np.intp)  # each once, in this order
