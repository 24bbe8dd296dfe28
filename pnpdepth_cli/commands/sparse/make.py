"""The commands that make sparse depth: `pnpdepth project`, `sample` and `simulate`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli import __version__
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.dataset.arrays import record_of
from pnpdepth_cli.dataset.frame_camera import check_size
from pnpdepth_cli.dataset.plausible import plausible_map
from pnpdepth_cli.dataset.read_options import ScanOptions
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.file_record import FileRecord, SamplePattern
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import SPARSE_SUFFIXES, describe_range, read_depth, write_sparse
from pnpdepth_cli.io.file_bytes import plain, write_json
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.visualisation import overlay
from pnpdepth_cli.sensors.lidar import LIDARS, Lidar, ideal_lidar, simulate_lidar
from pnpdepth_cli.sensors.pixels import Points, as_depth_image
from pnpdepth_cli.sensors.samplers import sample_points


class SparseSummary(NamedTuple):
    """What was written."""

    points: Points
    notes: Sequence[str]
    """Lines for a person."""
    files: Sequence[Path]


def _overlay(output: Path) -> Path:
    """The image with the points, of a scan that is projected."""
    return output.with_name(f"{output.stem}_overlay.png")


def _check(
    output: Path, inputs: Iterable[Path | None], overwrite: bool, *, drawn: bool = False
) -> None:
    """Raises OutputError for files that cannot be written, or that replace an input."""
    if output.suffix.lower() not in SPARSE_SUFFIXES:
        raise OutputError(
            f"{output}: sparse depth is written as one of {', '.join(SPARSE_SUFFIXES)}"
        )
    written = [output, output.with_suffix(".json"), *[_overlay(output)] * drawn]
    check_outputs(written, [path for path in inputs if path], overwrite=overwrite)


def _write(
    command: str,
    output: Path,
    points: Points,
    settings: Mapping[str, object],
    inputs: Mapping[str, FileRecord],
    notes: Sequence[str],
    *,
    rgb: NDArray[np.float32] | None = None,
) -> SparseSummary:
    """Writes the sparse depth, its record, and with an image (H, W, 3) in 0..1 the overlay."""
    # The points, as a map or a list, and over the image.
    make_folder(output.parent)
    image, record = as_depth_image(points), output.with_suffix(".json")
    write_sparse(output, points.xy, points.depth, image)
    if rgb is not None:
        overlay(rgb, points.xy, points.depth, _overlay(output))
    drawn = None if rgb is None else _overlay(output)
    outputs = {"sparse": output, "overlay": drawn, "record": record}
    # The record.
    content = {
        "command": command,
        "version": __version__,
        **settings,
        "inputs": {name: part.to_json() for name, part in inputs.items()},
        "points": {
            "count": len(points),
            "fraction_of_pixels": len(points) / image.size,
            "nearest": float(points.depth.min()),
            "farthest": float(points.depth.max()),
            "dropped": dict(points.dropped),
        },
        "size": [points.size[1], points.size[0]],
        "notes": list(notes),
        "outputs": plain(outputs),
    }
    write_json(record, content)
    return SparseSummary(points, notes, [path for path in outputs.values() if path])


def project_scan(
    scan: Path,
    image: Path,
    output: Path,
    options: ScanOptions,
    *,
    depth_scale: float | None = None,
    overwrite: bool = False,
) -> SparseSummary:
    """Writes the scan's points that the camera of the image sees; returns what was written."""
    _check(output, (scan, image, options.calib, options.extrinsics), overwrite, drawn=True)
    rgb = read_rgb(image).values
    size = (rgb.shape[0], rgb.shape[1])
    projected = read_scan_points(scan, options, size, image, scale=depth_scale)
    inputs = {"image": record_of(image), "scan": projected.record}
    settings = plain(asdict(options))
    return _write("project", output, projected.points, settings, inputs, projected.notes, rgb=rgb)


def sample_depth(
    depth: Path,
    output: Path,
    pattern: SamplePattern,
    *,
    image: Path | None = None,
    seed: int = 0,
    depth_scale: float | None = None,
    overwrite: bool = False,
) -> SparseSummary:
    """Writes points of a dense depth map; returns what was written."""
    _check(output, (depth, image), overwrite)
    dense, notes = _dense(depth, depth_scale)
    rgb, inputs = None, {"depth": record_of(depth)}
    if image is not None:
        rgb, inputs["image"] = read_rgb(image).values, record_of(image)
    points = sample_points(dense, pattern, seed, image=rgb)
    wanted = pattern.wanted(int(np.count_nonzero(dense)))
    if pattern.kind == "features" and len(points) < wanted:
        notes.append(f"warning: the image has {len(points):,} of the {wanted:,} points asked for")
    notes.append(f"sparse: {describe_range(points.depth, Reading(f'{pattern.kind}, seed {seed}'))}")
    settings = {"pattern": asdict(pattern), "seed": seed}
    return _write("sample", output, points, settings, inputs, notes)


def simulate_scan(
    depth: Path,
    calib: Path,
    output: Path,
    sensor: Lidar,
    *,
    seed: int = 0,
    depth_scale: float | None = None,
    overwrite: bool = False,
) -> SparseSummary:
    """Writes the points of a sensor at the camera's place; returns what was written."""
    _check(output, (depth, calib), overwrite)
    dense, notes = _dense(depth, depth_scale)
    calibration = read_calibration(calib)
    notes += check_size(calib, calibration.camera, (dense.shape[0], dense.shape[1]), depth)
    points = simulate_lidar(dense, calibration.camera, sensor, seed)
    notes.append(f"sparse: {describe_range(points.depth, Reading(f'{sensor.name}, seed {seed}'))}")
    settings = {"sensor": plain(asdict(sensor)), "seed": seed}
    read_as = FileRecord(path=str(calib), read_as=calibration.camera.source)
    inputs = {"depth": record_of(depth), "calibration": read_as}
    return _write("simulate", output, points, settings, inputs, notes)


def _dense(path: Path, scale: float | None) -> tuple[NDArray[np.float32], list[str]]:
    """The dense depth (H, W), and lines for a person."""
    dense = read_depth(path, scale=scale)
    values, notes = plausible_map(dense.values, dense.reading, "depth", "--depth-scale", scale)
    return values, [f"depth: {describe_range(values, dense.reading, noun='pixels')}", *notes]


def lidar_of(
    name: str | None, beams: int | None, vertical_fov: tuple[float, float] | None
) -> Lidar:
    """Returns the sensor of this name, or one of so many beams between two elevations, degrees.

    Raises:
        UsageError: Neither or both are given.
    """
    if name is not None and beams is None and vertical_fov is None:
        return LIDARS[name]
    if name is not None or beams is None or vertical_fov is None:
        raise UsageError("give --sensor, or --beams and --vertical-fov")
    return ideal_lidar(beams, *vertical_fov)
