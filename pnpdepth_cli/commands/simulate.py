"""`pnpdepth simulate`: the points that a LiDAR measures in a scene with dense depth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from pnpdepth_cli.commands.shared.sparse_files import (
    Written,
    read_dense,
    sparse_outputs,
    write_sparse_files,
)
from pnpdepth_cli.dataset.arrays import check_camera, record_of
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.file_bytes import plain
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.sensors.simulation import lidar_of, simulate_lidar


def simulate_scan(
    depth: Path,
    calib: Path,
    output: Path,
    *,
    sensor: str | None = None,
    beams: int | None = None,
    vertical_fov: tuple[float, float] | None = None,
    seed: int = 0,
    depth_scale: float | None = None,
    overwrite: bool = False,
) -> Written:
    """Writes the points of a sensor at the camera's place; returns what was written.

    The sensor is one by name, or of so many beams between two elevations.

    Args:
        depth: File of the dense depth of the scene.
        calib: Calibration of the camera that the depth is of.
        output: File of the sparse depth.
        sensor: Name of the sensor, one of `choices.SENSORS`. None: `beams` and `vertical_fov`.
        beams: Number of beams.
        vertical_fov: Elevations of the uppermost and the lowest beam, degrees.
        seed: Random seed of the sensor's noise.
        depth_scale: Numbers of the dense depth per metre. None: as the file says.
        overwrite: Whether existing files are replaced.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    # The sensor, and the files that are read.
    lidar = lidar_of(sensor, beams, vertical_fov)
    files = sparse_outputs(output, (depth, calib), overwrite)
    dense, notes = read_dense(depth, depth_scale)
    camera = read_calibration(calib).camera
    notes += check_camera(calib, camera, (dense.shape[0], dense.shape[1]), depth)
    # The points, with what decided them.
    points = simulate_lidar(dense, camera, lidar, seed)
    notes.append(f"sparse: {describe_range(points.depth, Reading(f'{lidar.name}, seed {seed}'))}")
    settings = {"command": "simulate", "sensor": plain(asdict(lidar)), "seed": seed}
    calibration = FileRecord(path=str(calib), kind="calibration", read_as=camera.source)
    inputs = {"depth": record_of(depth), "calibration": calibration}
    return write_sparse_files(files, points, settings, inputs, notes)
