"""`pnpdepth simulate`: the sparse depth that a LiDAR would give of a scene with dense depth."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.depth import describe_range, implausible, read_depth
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.sensor_file import read_sensor
from pnpdepth_cli.pipeline.sparse.outputs import Provenance, SparseTarget, write_sparse_outputs
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
    """What to simulate, and where to; None leaves a property to the sensor."""

    depth: Path
    """The dense depth."""

    calib: Path
    """The camera's calibration."""

    target: SparseTarget
    """Files to write."""

    sensor: str = "hdl-64e"
    """One of `LIDARS`, or a TOML file."""

    camera: int | None = None
    """One of KITTI's four, 0 to 3; None for the left colour camera."""

    offset: tuple[float, float, float] | None = None
    """Position of the scanner: metres to the right of, below and in front of the camera."""

    at_scanner: bool = False
    """The scanner has the pose that the calibration gives."""

    settings: SimulationSettings = field(default_factory=SimulationSettings)
    """Noise and limits."""

    seed: int = 0
    """Of all noise."""

    depth_scale: float | None = None
    """Codes per metre of an integer depth file; None for the file's own."""

    channel: str | None = None
    """The EXR channel or NPZ array with the depth."""

    @classmethod
    def from_fields(cls, **values: Any) -> SimulateRequest:
        """Returns the request with these fields, those of `settings` by their own names."""
        names = [each.name for each in fields(SimulationSettings) if each.name in values]
        settings = SimulationSettings(**{name: values.pop(name) for name in names})
        return cls(settings=settings, **values)


def simulate_scan(request: SimulateRequest) -> dict[str, Any]:
    """Writes the simulated sensor's points, and returns the record.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    sensor = find_sensor(request.sensor)
    request.target.check((request.depth, request.calib, Path(request.sensor)))
    dense = read_depth(request.depth, scale=request.depth_scale, channel=request.channel)
    calibration = read_calibration(request.calib, request.camera)
    height, width = dense.values.shape
    warnings = check_size(request.calib, calibration, (height, width), request.depth)
    unlikely = implausible(dense.values, dense.scale)
    warnings += [f"warning: {unlikely}"] if unlikely else []
    camera = _camera(request, calibration)
    points = simulate_lidar(dense.values, camera, sensor, request.seed, request.settings)
    depth_range = describe_range(
        dense.values, dense.source, assumed_scale=dense.assumed_scale, noun="pixels"
    )
    source = f"{sensor.name}, seed {request.seed}"
    return write_sparse_outputs(
        request.target,
        points,
        Provenance(
            command="simulate",
            settings={
                "sensor": asdict(sensor) | {"max_range": _finite(sensor.max_range)},
                **asdict(request.settings),
                "rotation": camera.rotation.tolist(),
                "translation": camera.translation.tolist(),
                "seed": request.seed,
            },
            inputs={
                "depth": {"path": str(request.depth), "sha256": sha256_of(request.depth)},
                "calibration": {"path": str(request.calib), "read_as": calibration.source},
            },
            notes=[
                f"depth: {depth_range}",
                *warnings,
                f"sparse: {describe_range(points.depth, source)}",
            ],
        ),
    )


def find_sensor(spec: str) -> Lidar:
    """Returns the named sensor, or the one that a TOML file describes.

    Raises:
        UsageError: There is no sensor of this name, or it is described wrongly.
        InputError: The file cannot be read.
    """
    if spec in LIDARS:
        return LIDARS[spec]
    if Path(spec).suffix.lower() == ".toml":
        return Lidar(**asdict(read_sensor(Path(spec))))
    raise UsageError(f"no sensor {spec!r}; --sensor is a TOML file or one of: {', '.join(LIDARS)}")


def _finite(value: float) -> float | None:
    """None for infinity, which JSON does not have."""
    return value if np.isfinite(value) else None


def _camera(request: SimulateRequest, calibration: Calibration) -> Camera:
    """The camera, with the scanner at the position that is asked for."""
    if request.at_scanner and request.offset is not None:
        raise UsageError("--at-scanner takes the position from the calibration; leave out --offset")
    camera = camera_of(calibration)
    if request.at_scanner:
        if not calibration.has_pose:
            raise UsageError(f"{request.calib} has no pose of the scanner; add R and t")
        return camera
    position = np.array(request.offset or (0.0, 0.0, 0.0))
    return replace(camera, rotation=FORWARD_LEFT_UP, translation=position)
