"""The commands that make sparse depth: `pnpdepth project`, `sample` and `simulate`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli import __version__
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.dataset.arrays import check_size, record_of
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.plausible import plausible_map
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.file_record import FileRecord, SamplePattern, what_applies
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import SPARSE_SUFFIXES, describe_range, read_depth, write_sparse
from pnpdepth_cli.io.file_bytes import plain, write_json
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.visualisation import overlay
from pnpdepth_cli.sensors.projection import Points, as_depth_image
from pnpdepth_cli.sensors.simulation import lidar_of, sample_points, simulate_lidar

Written = tuple[Points, list[str], list[Path]]
"""The points, lines for a person, and the files that were written."""


def _outputs(
    output: Path, inputs: Iterable[Path | None], overwrite: bool, *, drawn: bool = False
) -> dict[str, Path]:
    """The files to write. Raises OutputError if one cannot be written, or replaces an input."""
    if output.suffix.lower() not in SPARSE_SUFFIXES:
        raise OutputError(
            f"{output}: sparse depth is written as one of {', '.join(SPARSE_SUFFIXES)}"
        )
    files = {"sparse": output, "record": output.with_suffix(".json")}
    if drawn:
        files["overlay"] = output.with_name(f"{output.stem}_overlay.png")
    check_outputs(files.values(), [path for path in inputs if path], overwrite=overwrite)
    return files


def _write(
    files: dict[str, Path],
    points: Points,
    settings: Mapping[str, object],
    inputs: Mapping[str, FileRecord],
    notes: list[str],
    *,
    rgb: NDArray[np.float32] | None = None,
) -> Written:
    """Writes the sparse depth, over an image (H, W, 3) in 0..1 if there is one, and its record."""
    make_folder(files["sparse"].parent)
    image = as_depth_image(points)
    write_sparse(files["sparse"], points.xy, points.depth, image)
    if rgb is not None:
        overlay(rgb, points.xy, points.depth, files["overlay"])
    content = {
        "version": __version__,
        **settings,
        "inputs": {k: asdict(part, dict_factory=what_applies) for k, part in inputs.items()},
        "points": {
            "count": len(points),
            "fraction_of_pixels": len(points) / image.size,
            "nearest": float(points.depth.min()),
            "farthest": float(points.depth.max()),
            "dropped": dict(points.dropped),
        },
        "size": [points.size[1], points.size[0]],
        "notes": notes,
        "outputs": plain(files),
    }
    write_json(files["record"], content)
    return points, notes, [*files.values()]


def project_scan(
    scan: Path,
    image: Path,
    output: Path,
    options: ScanOptions,
    *,
    depth_scale: float | None = None,
    overwrite: bool = False,
) -> Written:
    """Writes the scan's points that the camera of the image sees; returns what was written."""
    files = _outputs(
        output, (scan, image, options.calib, options.extrinsics), overwrite, drawn=True
    )
    rgb = read_rgb(image).values
    size = (rgb.shape[0], rgb.shape[1])
    projected = read_scan_points(scan, options, size, image, scale=depth_scale)
    records = {"image": record_of(image), "scan": projected.record}
    settings = {"command": "project", **plain(asdict(options))}
    return _write(files, projected.points, settings, records, [*projected.notes], rgb=rgb)


def sample_depth(
    depth: Path,
    output: Path,
    pattern: SamplePattern,
    *,
    image: Path | None = None,
    seed: int = 0,
    depth_scale: float | None = None,
    overwrite: bool = False,
) -> Written:
    """Writes points of a dense depth map; returns what was written."""
    files = _outputs(output, (depth, image), overwrite)
    dense, notes = _dense(depth, depth_scale)
    rgb, inputs = None, {"depth": record_of(depth)}
    if image is not None:
        rgb, inputs["image"] = read_rgb(image).values, record_of(image)
    points = sample_points(dense, pattern, seed, image=rgb)
    wanted = pattern.wanted(int(np.count_nonzero(dense)))
    if pattern.kind == "features" and len(points) < wanted:
        notes.append(f"warning: the image has {len(points):,} of the {wanted:,} points asked for")
    notes.append(f"sparse: {describe_range(points.depth, Reading(f'{pattern.kind}, seed {seed}'))}")
    drawn = {"kind": pattern.kind, "count": pattern.count, "fraction": pattern.fraction}
    settings = {"command": "sample", "pattern": drawn, "seed": seed}
    return _write(files, points, settings, inputs, notes)


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

    The sensor is one by name, or of so many beams between two elevations, degrees.
    """
    lidar = lidar_of(sensor, beams, vertical_fov)
    files = _outputs(output, (depth, calib), overwrite)
    dense, notes = _dense(depth, depth_scale)
    calibration = read_calibration(calib)
    notes += check_size(calib, calibration.camera, (dense.shape[0], dense.shape[1]), depth)
    points = simulate_lidar(dense, calibration.camera, lidar, seed)
    notes.append(f"sparse: {describe_range(points.depth, Reading(f'{lidar.name}, seed {seed}'))}")
    settings = {"command": "simulate", "sensor": plain(asdict(lidar)), "seed": seed}
    read_as = FileRecord(path=str(calib), read_as=calibration.camera.source)
    inputs = {"depth": record_of(depth), "calibration": read_as}
    return _write(files, points, settings, inputs, notes)


def _dense(path: Path, scale: float | None) -> tuple[NDArray[np.float32], list[str]]:
    """The dense depth (H, W), and lines for a person."""
    dense = read_depth(path, scale=scale)
    values, notes = plausible_map(
        dense.values, dense.reading, "depth", "--depth-scale", scale, of_integers=""
    )
    return values, [f"depth: {describe_range(values, dense.reading, noun='pixels')}", *notes]
