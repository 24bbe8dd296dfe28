"""`pnpdepth simulate`: the sparse depth that a LiDAR would give of a scene with dense depth."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.depth import describe_range, implausible, read_depth
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.sensor_file import read_sensor
from pnpdepth_cli.pipeline.sparse.outputs import SparseTarget, write_sparse_outputs
from pnpdepth_cli.pipeline.sparse.scans import camera_of, check_size
from pnpdepth_cli.sensors import (
    FORWARD_LEFT_UP,
    LIDARS,
    Camera,
    Lidar,
    SimulationSettings,
    simulate_lidar,
)


@dataclass(frozen=True, kw_only=True)
class SimulateRequest:
    """What to simulate. None leaves a property to the sensor.

    sensor: one of `LIDARS`, or a TOML file. offset: where the scanner stands, metres to the right
    of, below and in front of the camera. at_scanner: it stands where the calibration has it.
    """

    depth: Path
    calib: Path
    target: SparseTarget
    sensor: str = "hdl-64e"
    camera: int | None = None
    offset: tuple[float, float, float] | None = None
    at_scanner: bool = False
    rotation_noise_deg: float = 0.0
    angle_noise_deg: float | None = None
    range_noise: float | None = None
    dropout: float = 0.0
    max_range: float | None = None
    euclidean: bool = False
    seed: int = 0
    depth_scale: float | None = None
    channel: str | None = None


def simulate_scan(request: SimulateRequest) -> dict[str, Any]:
    """The simulated sensor's points are on disk; what was done is returned.

    Raises the errors of `pnpdepth_cli.errors`; then nothing is written.
    """
    sensor = find_sensor(request.sensor)
    request.target.check((request.depth, request.calib, Path(request.sensor)))
    settings = SimulationSettings(
        rotation_noise_deg=request.rotation_noise_deg,
        angle_noise_deg=request.angle_noise_deg,
        range_noise=request.range_noise,
        dropout=request.dropout,
        max_range=request.max_range,
        euclidean=request.euclidean,
    )
    dense = read_depth(request.depth, scale=request.depth_scale, channel=request.channel)
    calibration = read_calibration(request.calib, request.camera)
    height, width = dense.values.shape
    doubts = check_size(request.calib, calibration, (height, width), request.depth)
    unlikely = implausible(dense.values, dense.scale)
    doubts += [f"warning: {unlikely}"] if unlikely else []
    camera = _camera(request, calibration)
    points = simulate_lidar(dense.values, camera, sensor, request.seed, settings)
    said = describe_range(
        dense.values, dense.source, assumed_scale=dense.assumed_scale, noun="pixels"
    )
    source = f"{sensor.name}, seed {request.seed}"
    return write_sparse_outputs(
        request.target,
        points,
        command="simulate",
        settings={
            "sensor": asdict(sensor) | {"max_range": _finite(sensor.max_range)},
            **asdict(settings),
            "rotation": camera.rotation.tolist(),
            "translation": camera.translation.tolist(),
            "seed": request.seed,
        },
        inputs={
            "depth": {"path": str(request.depth), "sha256": sha256_of(request.depth)},
            "calibration": {"path": str(request.calib), "read_as": calibration.source},
        },
        notes=[f"depth: {said}", *doubts, f"sparse: {describe_range(points.depth, source)}"],
    )


def find_sensor(spec: str) -> Lidar:
    """The named sensor, or the one a TOML file describes. UsageError for a name nobody knows."""
    if spec in LIDARS:
        return LIDARS[spec]
    if Path(spec).suffix.lower() == ".toml":
        return Lidar(**asdict(read_sensor(Path(spec))))
    raise UsageError(f"no sensor {spec!r}; --sensor is a TOML file or one of: {', '.join(LIDARS)}")


def _finite(value: float) -> float | None:
    """None for infinity, which JSON does not have."""
    return value if np.isfinite(value) else None


def _camera(request: SimulateRequest, calibration: Calibration) -> Camera:
    """How the camera sees, with the scanner at the place that is asked for."""
    if request.at_scanner and request.offset is not None:
        raise UsageError("--at-scanner takes the place from the calibration; leave out --offset")
    camera = camera_of(calibration)
    if request.at_scanner:
        if not calibration.has_pose:
            raise UsageError(f"{request.calib} does not say where the scanner stands; add R and t")
        return camera
    place = np.array(request.offset or (0.0, 0.0, 0.0))
    return replace(camera, rotation=FORWARD_LEFT_UP, translation=place)
