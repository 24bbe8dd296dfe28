"""A LiDAR scan and a calibration: read, checked against the image, and projected into it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import SizeError, UsageError
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.pipeline.sparse.scan_options import ScanOptions
from pnpdepth_cli.sensors import (
    Camera,
    OcclusionFilter,
    ProjectedScan,
    ProjectionSettings,
    project_velodyne,
)

_OFF_CENTRE = 0.15
"""Fraction of the image's side by which a principal point may be off centre without warning."""


@dataclass(frozen=True, kw_only=True)
class ScanPoints:
    """A projected scan."""

    points: ProjectedScan
    """The points that the camera sees."""

    record: dict[str, Any]
    """What a record keeps of it."""

    notes: tuple[str, ...]
    """Lines for a person."""


def read_scan_points(
    path: Path, options: ScanOptions, size: tuple[int, int] | None, image: Path | None = None
) -> ScanPoints:
    """Returns the points of a scan that are visible in an image.

    Args:
        path: The scan.
        options: Calibration and limits.
        size: (H, W) of the image; None for the calibration's.
        image: Its file, for messages.

    Raises:
        InputError: A file cannot be read.
        SizeError: Calibration and image do not fit together.
        NoPointsError: No point is visible.
    """
    if options.calib is None:
        raise UsageError(
            f"{path} is a scan, which needs --calib: a calibration file, or KITTI's raw folder"
        )
    calibration = read_calibration(options.calib, options.camera)
    if not calibration.has_pose:
        raise UsageError(f"{options.calib} has no pose of the scanner; add R and t (or Tr)")
    size = size or calibration.size
    if size is None:
        raise SizeError(f"{options.calib} does not give the image's size; give the image too")
    warnings = check_size(options.calib, calibration, size, image)
    scan = read_scan(path, options.point_fields)
    settings = ProjectionSettings(
        euclidean=options.euclidean,
        min_range=options.min_range,
        max_range=np.inf if options.max_range is None else options.max_range,
        occlusion=None if options.keep_occluded else OcclusionFilter(),
    )
    points = project_velodyne(scan.points, camera_of(calibration), size, settings)
    source = f"{scan.source} of {len(scan.points):,} points, {calibration.source}"
    lost = ", ".join(f"{count:,} {why}" for why, count in points.dropped.items() if count)
    notes = [f"sparse: {describe_range(points.depth, source)}"]
    notes += [f"sparse: dropped {lost}"] if lost else []
    return ScanPoints(
        points=points,
        record={
            "path": str(path),
            "sha256": sha256_of(path),
            "read_as": source,
            "calibration": str(options.calib),
            "camera": options.camera,
            "depth_is": "range" if options.euclidean else "z",
            "min_range": options.min_range,
            "max_range": options.max_range,
            "keep_occluded": options.keep_occluded,
            "dropped": dict(points.dropped),
        },
        notes=(*notes, *warnings),
    )


def camera_of(calibration: Calibration) -> Camera:
    """Returns the camera and the scanner's pose that a calibration describes."""
    return Camera(
        intrinsics=calibration.intrinsics,
        rotation=calibration.rotation,
        translation=calibration.translation,
        distortion=calibration.distortion,
    )


def check_size(
    path: Path, calibration: Calibration, size: tuple[int, int], image: Path | None = None
) -> list[str]:
    """Returns warnings if image and calibration seem to belong to different cameras.

    Args:
        path: The calibration's file, for messages.
        calibration: What is in it.
        size: (H, W) of the image.
        image: Its file, for messages.

    Raises:
        SizeError: They cannot belong together.
    """
    name = f"{image} is" if image else "the image is"
    if calibration.size is not None and calibration.size != size:
        height, width = calibration.size
        raise SizeError(
            f"{name} {size[1]}×{size[0]} but {path} is for images of {width}×{height}; give the"
            " image at that size"
        )
    x, y = calibration.intrinsics[:2, 2]
    if not (0 <= x < size[1] and 0 <= y < size[0]):
        raise SizeError(
            f"{name} {size[1]}×{size[0]}, which does not contain the principal point"
            f" ({x:.1f}, {y:.1f}) of {path}; one of them is of another camera or size"
        )
    if max(abs(x / size[1] - 0.5), abs(y / size[0] - 0.5)) > _OFF_CENTRE:
        return [
            f"warning: the principal point ({x:.1f}, {y:.1f}) of {path} is far from the centre of"
            f" a {size[1]}×{size[0]} image; does the calibration belong to this image?"
        ]
    return []
