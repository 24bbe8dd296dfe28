"""The sparse points of a sweep's runs: a frame's own, drawn from its truth, or a LiDAR's in it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.request import RefineRequest, count_or_share
from pnpdepth_cli.pipeline.sparse.scans import camera_of, check_size
from pnpdepth_cli.pipeline.sparse.simulate import find_sensor
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
"""The sensor that the frames' own sparse depth is of."""

_REPEATED = ("grid", "lines", "features", OWN)
"""Sensors that give the same points whatever the seed."""


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Where the points of a run come from.

    sensor: OWN, a pattern of `pnpdepth sample`, or a LiDAR of `pnpdepth simulate`. points: so many
    or a share (`500`, `5%`) of the known pixels for a pattern, else of the points there are; None
    for all of those. The others are noise, as `pnpdepth sample` and `simulate` have it.
    """

    sensor: str = OWN
    points: str | None = None
    noise: float = 0.0
    relative_noise: float = 0.0
    outliers: float = 0.0
    jitter: float = 0.0
    rotation_noise: float = 0.0

    @property
    def is_pattern(self) -> bool:
        """Whether the points come from a pattern of `pnpdepth sample`."""
        return self.sensor in PATTERNS

    @property
    def lidar(self) -> Lidar | None:
        """The simulated LiDAR, or None."""
        return None if self.is_pattern or self.sensor == OWN else find_sensor(self.sensor)

    @property
    def sample_noise(self) -> SampleNoise:
        """The noise of the points."""
        return SampleNoise(
            metres=self.noise,
            relative=self.relative_noise,
            outliers=self.outliers,
            jitter_px=self.jitter,
        )

    @property
    def is_random(self) -> bool:
        """False if every seed gives the same points."""
        thinned = self.points is not None and not self.is_pattern
        return self.sensor not in _REPEATED or thinned or self.sample_noise != SampleNoise()

    def pattern(self) -> SamplePattern:
        """Of a sensor that is one. UsageError without a number of points."""
        if self.points is None:
            raise UsageError(
                f"sensor {self.sensor!r} needs a number of points: {self.sensor}:500, or --sample"
                " 500, or --vary points=100,500"
            )
        count, share = count_or_share(self.points)
        return SamplePattern(kind=self.sensor, count=count, share=share)

    def record(self) -> dict[str, Any]:
        """All that decides the points, but for the frame and the seed."""
        lidar = self.lidar
        return asdict(self) | {"sensor": self.sensor if lidar is None else asdict(lidar)}


def read_sensor_text(text: str) -> tuple[str, str | None]:
    """(sensor, points) of `500`, `grid:400`, `grid` or `vlp-16`. UsageError for what is none."""
    if text in (OWN, *PATTERNS, *LIDARS) or text.lower().endswith(".toml"):
        return text, None
    kind, colon, points = text.rpartition(":")
    if (colon and kind not in (OWN, *PATTERNS, *LIDARS)) or not (colon or text[:1].isdigit()):
        raise UsageError(
            f"no sensor {text!r}; it is {OWN}, a pattern such as grid:500 ({', '.join(PATTERNS)}),"
            f" a TOML file, or a LiDAR ({', '.join(LIDARS)})"
        )
    count_or_share(points)
    return kind or "uniform", points


def read_sampling(text: str) -> Sampling:
    """Points of `500`, `grid:400` or `vlp-16`, without noise. UsageError for what is none."""
    sensor, points = read_sensor_text(known_sensor(text))
    return Sampling(sensor=sensor, points=points)


def known_sensor(text: str) -> str:
    """The text, if it is a sensor's. UsageError for what is none."""
    sensor, points = read_sensor_text(text)
    sampling = Sampling(sensor=sensor, points=points)
    if sampling.is_pattern and points is not None:
        sampling.pattern()
    elif sampling.lidar is not None:
        pass  # it was found, and its file could be read
    return text


def frame_points(
    sampling: Sampling, seed: int, inputs: Inputs, request: RefineRequest, frame: Frame
) -> SparsePoints:
    """The points of one frame. InputError if it cannot have them.

    inputs: the frame as read, with its own points if those are wanted. request: how it was read.
    """
    try:
        found = _found(sampling, seed, inputs, request, frame)
    except UsageError as error:  # the sensor itself is good, this frame is too poor for it
        raise InputError(str(error)) from error
    return found.tensors()


def _found(
    sampling: Sampling, seed: int, inputs: Inputs, request: RefineRequest, frame: Frame
) -> Points:
    truth, noise = inputs.gt, sampling.sample_noise
    if truth is None:
        raise InputError("there is no ground truth")
    if sampling.is_pattern:
        return sample_points(truth, sampling.pattern(), seed, image=inputs.rgb, noise=noise)
    rng = np.random.default_rng(seed)
    if sampling.lidar is not None:
        points = _scanned(sampling, sampling.lidar, seed, inputs, request, frame)
    elif request.files.sparse is None:
        raise InputError("there is no sparse depth; --sample 500 takes points of the truth")
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
    """What the LiDAR, standing in the camera's place, measures in the frame's true depth."""
    if frame.calib is None:
        raise InputError(
            f"sensor {sampling.sensor!r} needs to know the camera; give --calib, or a list with a"
            " column calib"
        )
    protocol = request.files.protocol
    if protocol.halved or protocol.crop:
        raise InputError(
            f"sensor {sampling.sensor!r} needs the picture that the calibration is of, but protocol"
            f" {protocol.name!r} cuts it; --protocol whole does not"
        )
    calibration = read_calibration(frame.calib, frame.camera)
    check_size(frame.calib, calibration, inputs.size)
    here = replace(camera_of(calibration), rotation=FORWARD_LEFT_UP, translation=np.zeros(3))
    settings = SimulationSettings(rotation_noise_deg=sampling.rotation_noise)
    assert inputs.gt is not None
    return simulate_lidar(inputs.gt, here, lidar, seed, settings)


def _thinned(points: Points, wanted: str | None, rng: np.random.Generator) -> Points:
    """So many of the points, each as likely as any other."""
    if wanted is None:
        return points
    known = len(points.depth)
    count, share = count_or_share(wanted)
    number = max(1, round(share * known)) if share is not None else count or 0
    if number > known:
        raise InputError(
            f"{number:,} points of {known:,}; ask for fewer, or take them of the truth with"
            f" --sample {wanted}"
        )
    kept = np.sort(rng.choice(known, number, replace=False))
    return replace(points, xy=points.xy[kept], depth=points.depth[kept])


def calibration_file(sampling: Sampling, frame: Frame) -> Path | None:
    """The calibration that is read for these points as well, if any."""
    path = frame.calib if sampling.lidar is not None else None
    return path if path is not None and path.is_file() else None
