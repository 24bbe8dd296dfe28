"""The sparse points of a sweep: a frame's own, drawn from its ground truth, or simulated in it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.request import RefineRequest, count_or_fraction
from pnpdepth_cli.pipeline.sparse.make import find_sensor
from pnpdepth_cli.pipeline.sparse.scans import camera_of, check_size
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors import (
    FORWARD_LEFT_UP,
    LIDARS,
    PATTERNS,
    Lidar,
    Points,
    SampleNoise,
    SamplePattern,
    SimulationSettings,
    sample_points,
    simulate_lidar,
    with_noise,
)

OWN = "own"
"""The name of the frames' own sparse depth as a sensor."""

_DETERMINISTIC = ("grid", "lines", "features", OWN)
"""Sensors whose points do not depend on the seed."""


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Where the points of a run come from."""

    sensor: str = OWN
    """OWN, a pattern of `pnpdepth sample`, or a LiDAR of `pnpdepth simulate`."""
    points: str | None = None
    """Number or fraction (`500`, `5%`), for a pattern of the known pixels, else of the sensor's
    points; None for all of these."""
    noise: float = 0.0
    """Standard deviation of the depth, metres."""
    relative_noise: float = 0.0
    """Standard deviation as a fraction of the depth."""
    outliers: float = 0.0
    """Fraction of points with a random depth."""
    jitter: float = 0.0
    """Standard deviation of the pixel coordinates."""
    rotation_noise: float = 0.0
    """Standard deviation of the scanner's rotation, degrees."""

    @property
    def is_pattern(self) -> bool:
        """True for a pattern of `pnpdepth sample`."""
        return self.sensor in PATTERNS

    @property
    def lidar(self) -> Lidar | None:
        """The scanner, if the sensor is one."""
        return None if self.is_pattern or self.sensor == OWN else find_sensor(self.sensor)

    @property
    def sample_noise(self) -> SampleNoise:
        """The noise of each point."""
        return SampleNoise(
            metres=self.noise,
            relative=self.relative_noise,
            outliers=self.outliers,
            jitter_px=self.jitter,
        )

    @property
    def is_random(self) -> bool:
        """True if the points depend on the seed."""
        thinned = self.points is not None and not self.is_pattern
        return self.sensor not in _DETERMINISTIC or thinned or self.sample_noise != SampleNoise()

    def pattern(self) -> SamplePattern:
        """Returns the pattern to draw. Raises UsageError without a number of points."""
        if self.points is None:
            raise UsageError(
                f"sensor {self.sensor!r} needs a number of points: {self.sensor}:500, or --sample"
                " 500, or --vary points=100,500"
            )
        count, fraction = count_or_fraction(self.points)
        return SamplePattern(kind=self.sensor, count=count, fraction=fraction)

    def record(self) -> dict[str, Any]:
        """Returns all that decides the points except the frame and the seed."""
        lidar = self.lidar
        return asdict(self) | {"sensor": self.sensor if lidar is None else asdict(lidar)}


def read_sensor_text(text: str) -> tuple[str, str | None]:
    """Returns (sensor, points) of `500`, `grid:400`, `grid` or `vlp-16`, else raises UsageError."""
    if text in (OWN, *PATTERNS, *LIDARS) or text.lower().endswith(".toml"):
        return text, None
    kind, colon, points = text.rpartition(":")
    if (colon and kind not in (OWN, *PATTERNS, *LIDARS)) or not (colon or text[:1].isdigit()):
        raise UsageError(
            f"no sensor {text!r}; it is {OWN}, a pattern such as grid:500 ({', '.join(PATTERNS)}),"
            f" a TOML file, or a LiDAR ({', '.join(LIDARS)})"
        )
    count_or_fraction(points)
    return kind or "uniform", points


def read_sampling(text: str) -> Sampling:
    """Returns the sampling of `500`, `grid:400` or `vlp-16`, without noise."""
    sensor, points = read_sensor_text(known_sensor(text))
    return Sampling(sensor=sensor, points=points)


def known_sensor(text: str) -> str:
    """Returns the text if it names a sensor, else raises UsageError."""
    sensor, points = read_sensor_text(text)
    sampling = Sampling(sensor=sensor, points=points)
    if sampling.is_pattern and points is not None:
        sampling.pattern()
    elif sampling.lidar is not None:
        pass  # the sensor exists and its file is readable
    return text


def frame_points(
    sampling: Sampling, seed: int, inputs: Inputs, request: RefineRequest, frame: Frame
) -> SparsePoints:
    """Returns the points of one frame.

    Args:
        sampling: Where they come from.
        seed: Of the drawing.
        inputs: The frame as read, with its own points if the sensor is OWN.
        request: How it was read.
        frame: The frame in its data set.

    Raises:
        InputError: If the frame cannot have such points.
    """
    try:
        points = _points_of(sampling, seed, inputs, request, frame)
    except UsageError as error:  # the sensor is valid, but not for this frame
        raise InputError(str(error)) from error
    return points.tensors()


def _points_of(
    sampling: Sampling, seed: int, inputs: Inputs, request: RefineRequest, frame: Frame
) -> Points:
    ground_truth, noise = inputs.gt, sampling.sample_noise
    if ground_truth is None:
        raise InputError("there is no ground truth")
    if sampling.is_pattern:
        return sample_points(
            ground_truth, sampling.pattern(), seed, image=inputs.image, noise=noise
        )
    rng = np.random.default_rng(seed)
    if sampling.lidar is not None:
        points = _scanned(sampling, sampling.lidar, seed, inputs, request, frame)
    elif request.files.sparse is None:
        raise InputError(
            "there is no sparse depth; --sample 500 draws points from the ground truth"
        )
    else:
        own = inputs.points
        points = SparsePoints(xy=own.xy.numpy(), depth=own.depth.numpy(), size=own.size)
    return with_noise(_thinned(points, sampling.points, rng), noise, rng)


def _scanned(
    sampling: Sampling,
    lidar: Lidar,
    seed: int,
    inputs: Inputs,
    request: RefineRequest,
    frame: Frame,
) -> Points:
    """The points of a LiDAR at the camera's position, simulated in the frame's ground truth."""
    if frame.calib is None:
        raise InputError(
            f"sensor {sampling.sensor!r} needs to know the camera; give --calib, or a list with a"
            " column calib"
        )
    protocol = request.files.protocol
    if protocol.halved or protocol.crop:
        raise InputError(
            f"sensor {sampling.sensor!r} needs the image that the calibration is of, but protocol"
            f" {protocol.name!r} crops it; --protocol whole does not"
        )
    calibration = read_calibration(frame.calib, frame.camera)
    check_size(frame.calib, calibration, inputs.size)
    here = replace(camera_of(calibration), rotation=FORWARD_LEFT_UP, translation=np.zeros(3))
    settings = SimulationSettings(rotation_noise_deg=sampling.rotation_noise)
    assert inputs.gt is not None
    return simulate_lidar(inputs.gt, here, lidar, seed, settings)


def _thinned(points: Points, wanted: str | None, rng: np.random.Generator) -> Points:
    """A uniform random subset of the points."""
    if wanted is None:
        return points
    available = len(points.depth)
    count, fraction = count_or_fraction(wanted)
    number = max(1, round(fraction * available)) if fraction is not None else count or 0
    if number > available:
        raise InputError(
            f"{number:,} points of {available:,}; ask for fewer, or draw them from the ground truth"
            f" with --sample {wanted}"
        )
    kept = np.sort(rng.choice(available, number, replace=False))
    return replace(points, xy=points.xy[kept], depth=points.depth[kept])


def calibration_file(sampling: Sampling, frame: Frame) -> Path | None:
    """Returns the calibration file that these points need, if any."""
    path = frame.calib if sampling.lidar is not None else None
    return path if path is not None and path.is_file() else None
