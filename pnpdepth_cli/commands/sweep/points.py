"""The sparse points of a sweep: a frame's own, drawn from its ground truth, or simulated in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pnpdepth_cli.commands.refinement.inputs import Inputs
from pnpdepth_cli.commands.refinement.request import (
    RefineRequest,
    count_or_fraction,
    sample_pattern,
)
from pnpdepth_cli.commands.sparse.make import find_sensor
from pnpdepth_cli.commands.sparse.scans import camera_of, check_size
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors import (
    FORWARD_LEFT_UP,
    LIDARS,
    PATTERNS,
    Lidar,
    Points,
    SampleNoise,
    SamplePattern,
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
    """Where the points of a run come from; noises are standard deviations."""

    sensor: str = OWN
    """OWN, a pattern of `pnpdepth sample`, or a LiDAR of `pnpdepth simulate`."""
    points: str | None = None
    """Number or fraction (`500`, `5%`), for a pattern of the known pixels, else of the sensor's
    points; None for all of these."""
    noise: float = 0.0
    """Of the depth, metres; `relative_noise` as a fraction of it."""
    relative_noise: float = 0.0
    outliers: float = 0.0
    """Fraction of points with a random depth."""
    jitter: float = 0.0
    """Of the pixel coordinates."""
    rotation_noise: float = 0.0
    """Of the scanner, degrees."""

    def __post_init__(self) -> None:
        _ = self.sample_noise  # refuses what is out of range
        if not 0 <= self.rotation_noise <= 360:
            raise UsageError(f"must be from 0 to 360 degrees, got {self.rotation_noise:g}")

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
        return sample_pattern(self.sensor, self.points)

    def record(self) -> dict[str, Any]:
        """Returns all that decides the points except the frame and the seed."""
        return asdict(self) | ({"sensor": asdict(self.lidar)} if self.lidar else {})

    def with_values(self, values: Mapping[str, Any]) -> Sampling:
        """Returns the sampling with other values of its fields; the sensor's is a sampling.

        A number of points is of the sensor that it was given with, unless that is varied.

        Raises:
            UsageError: If they contradict each other, or the number of points is missing.
        """
        varied: dict[str, Any] = dict(values)
        sensor = varied.pop("sensor", self)
        if sensor is not self and sensor.points is not None and "points" in varied:
            raise UsageError(
                f"sensor '{sensor.sensor}:{sensor.points}' says how many points; leave that out or"
                " do not vary the points"
            )
        same = sensor.is_pattern or sensor.sensor == self.sensor
        kept = sensor.points or (self.points if same else None)
        sampling = replace(self, **{"sensor": sensor.sensor, "points": kept, **varied})
        if sampling.is_pattern:
            sampling.pattern()
        return sampling


def read_sampling(text: str) -> Sampling:
    """Returns the sampling of `500`, `grid:400`, `grid` or `vlp-16`, without noise.

    Raises:
        UsageError: There is no such sensor.
        InputError: The file that describes it cannot be read.
    """
    sensor, points = text, None
    if text not in (OWN, *PATTERNS, *LIDARS) and not text.lower().endswith(".toml"):
        kind, colon, points = text.rpartition(":")
        if (colon and kind not in (OWN, *PATTERNS, *LIDARS)) or not (colon or text[:1].isdigit()):
            raise UsageError(
                f"no sensor {text!r}; it is {OWN}, a pattern such as grid:500"
                f" ({', '.join(PATTERNS)}), a TOML file, or a LiDAR ({', '.join(LIDARS)})"
            )
        count_or_fraction(points)
        sensor = kind or "uniform"
    sampling = Sampling(sensor=sensor, points=points)
    if sampling.is_pattern and points is not None:
        sampling.pattern()
    sampling.record()  # reads the file of a sensor
    return sampling


def frame_points(
    sampling: Sampling, seed: int, inputs: Inputs, request: RefineRequest, frame: Frame
) -> SparsePoints:
    """Returns the points of one frame, drawn with a seed. Raises InputError if it has none such.

    Args:
        inputs: The frame as read by the request, with its own points if the sensor is OWN.
    """
    noise, rng = sampling.sample_noise, np.random.default_rng(seed)
    if inputs.gt is None:
        raise InputError("there is no ground truth")
    try:
        if sampling.is_pattern:
            pattern = sampling.pattern()
            return sample_points(
                inputs.gt, pattern, seed, image=inputs.image, noise=noise
            ).tensors()
        if sampling.lidar is not None:
            points = _scanned(sampling, sampling.lidar, seed, inputs.gt, request, frame)
        elif request.files.sparse is None:
            raise InputError(
                "there is no sparse depth; --sample 500 draws points from the ground truth"
            )
        else:
            own = inputs.points
            points = SparsePoints(xy=own.xy.numpy(), depth=own.depth.numpy(), size=own.size)
        return with_noise(_thinned(points, sampling.points, rng), noise, rng).tensors()
    except UsageError as error:  # the sensor is valid, but not for this frame
        raise InputError(str(error)) from error


def _scanned(
    sampling: Sampling, lidar: Lidar, seed: int, gt: Any, request: RefineRequest, frame: Frame
) -> Points:
    """The points of a LiDAR at the camera's position, simulated in the frame's ground truth."""
    sensor, protocol = f"sensor {sampling.sensor!r} needs", request.files.protocol
    if frame.calib is None:
        raise InputError(f"{sensor} the camera; give --calib, or a list with a column calib")
    if protocol.halved or protocol.crop:
        raise InputError(
            f"{sensor} the image that the calibration is of, but protocol {protocol.name!r} crops"
            " it; --protocol whole does not"
        )
    calibration = read_calibration(frame.calib, frame.camera)
    check_size(frame.calib, calibration, gt.shape)
    here = replace(camera_of(calibration), rotation=FORWARD_LEFT_UP, translation=np.zeros(3))
    return simulate_lidar(
        gt, here, replace(lidar, rotation_noise_deg=sampling.rotation_noise), seed
    )


def _thinned(points: Points, wanted: str | None, rng: np.random.Generator) -> Points:
    """A uniform random subset of the points."""
    if wanted is None:
        return points
    available = len(points.depth)
    number = sample_pattern("uniform", wanted).wanted(available)
    if number > available:
        raise InputError(
            f"{number:,} points of {available:,}; ask for fewer, or draw them from the ground truth"
            f" with --sample {wanted}"
        )
    return points.select(np.sort(rng.choice(available, number, replace=False)))
