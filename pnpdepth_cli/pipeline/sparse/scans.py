"""A LiDAR scan and a calibration: read, checked against the image, and projected into it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import SizeError, UsageError
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.extrinsics import inverse, read_extrinsics
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.pipeline.sparse.options import ScanOptions
from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors import (
    Camera,
    ProjectedScan,
    ProjectionSettings,
    describe_dropped,
    project_velodyne,
)

_MORE_IF_INVERTED = 3.0
"""Times as many points in the image with inverted extrinsics that give a warning."""

_THIN = 0.5
"""Largest variance of a scan's rays along its thin direction, as a fraction of the next."""

_NEXT_TO_NONE = 0.05
"""Fraction of them; fewer points with the extrinsics themselves are an error."""

_AHEAD_DEG = 15.0
"""Largest angle to the camera's axis of points that are expected in the image,"""

_MOST_OUTSIDE = 1 / 3
"""of which a larger fraction outside gives a warning."""

_OFF_CENTRE = 0.15
"""Fraction of the image's side by which a principal point may be off centre without warning."""

_ONE_DIRECTION = ("KITTI", "nuScenes", "DDAD")
"""Sources of calibrations whose files give the pose in one direction."""


@dataclass(frozen=True, kw_only=True)
class ScanPoints:
    """A projected scan."""

    points: ProjectedScan
    camera: Camera
    """With the pose of the scanner."""
    record: dict[str, Any]
    """What a record keeps of it."""
    notes: tuple[str, ...]
    """Lines for a person."""


def read_scan_points(
    path: Path,
    options: ScanOptions,
    size: tuple[int, int] | None,
    image: Path | None = None,
    calibration: Calibration | None = None,
) -> ScanPoints:
    """Returns the points of a scan that are visible in an image.

    Args:
        path: The scan.
        options: Calibration and limits.
        size: (H, W) of the image; None for the calibration's.
        image: Its file, for messages.
        calibration: Of the frame, where the options name no file.

    Raises:
        InputError: A file cannot be read.
        SizeError: Calibration and image do not fit together.
        NoPointsError: No point is visible.
    """
    if options.calib is not None:
        calibration = read_calibration(options.calib, options.camera)
    if calibration is None:
        raise UsageError(
            f"{path} is a scan, which needs --calib: a calibration file, or KITTI's raw folder"
        )
    named = options.calib or Path(calibration.source)
    calibration = with_extrinsics(calibration, options)
    if not calibration.has_pose:
        raise UsageError(
            f"{named} has no pose of the scanner; add it (R and t, Tr, T_camera_lidar), or"
            " give --extrinsics"
        )
    size = size or calibration.size
    if size is None:
        raise SizeError(f"{named} does not give the image's size; give the image too")
    warnings = check_size(named, calibration, size, image)
    scan = read_scan(path, options.point_fields)
    settings = ProjectionSettings(
        euclidean=options.euclidean,
        min_range=options.min_range,
        max_range=np.inf if options.max_range is None else options.max_range,
        keep_occluded=options.keep_occluded,
    )
    camera = camera_of(calibration)
    if not calibration.source.startswith(_ONE_DIRECTION):
        warnings += check_direction(scan.points, camera, size)
    points = project_velodyne(scan.points, camera, size, settings)
    warnings += check_field_of_view(scan.points, camera, size)
    source = f"{scan.source} of {len(scan.points):,} points, {calibration.source}"
    lost = describe_dropped(points.dropped)
    notes = [f"sparse: {describe_range(points.depth, source)}"]
    notes += [f"sparse: dropped {lost}"] if lost else []
    return ScanPoints(
        points=points,
        camera=camera,
        record={
            "path": str(path),
            "sha256": sha256_of(path),
            "read_as": source,
            "calibration": str(named),
            "camera": options.camera,
            "extrinsics": None if options.extrinsics is None else str(options.extrinsics),
            "inverse_extrinsics": options.inverse_extrinsics,
            "depth_is": "range" if options.euclidean else "z",
            "min_range": options.min_range,
            "max_range": options.max_range,
            "keep_occluded": options.keep_occluded,
            "dropped": dict(points.dropped),
        },
        notes=(*notes, *warnings),
    )


def with_extrinsics(calibration: Calibration, options: ScanOptions) -> Calibration:
    """Returns the calibration with the pose of the scanner that the options name, if any."""
    rotation, translation = calibration.rotation, calibration.translation
    if options.extrinsics is not None:
        rotation, translation = read_extrinsics(options.extrinsics)
    if options.inverse_extrinsics:
        rotation, translation = inverse((rotation, translation))
    return replace(
        calibration,
        rotation=rotation,
        translation=translation,
        has_pose=calibration.has_pose or options.extrinsics is not None,
    )


def check_direction(scan: NDArray[np.floating], camera: Camera, size: tuple[int, int]) -> list[str]:
    """Returns a warning if the inverse of the scanner's pose fits the image better.

    That is: it puts far more points into the image, or more points and the camera upright in the
    scan, which is flatter than it is wide.

    Args:
        scan: (N, 3) metres in the scanner's frame.
        camera: With the pose.
        size: (H, W) of the image.

    Raises:
        UsageError: The pose puts next to none of the points into the image.
    """
    rotation, translation = inverse((camera.rotation, camera.translation))
    turned = replace(camera, rotation=rotation, translation=translation)
    inside, inverted = (_count_inside(scan, each, size) for each in (camera, turned))
    upright, upright_inverted = _is_upright(scan, camera), _is_upright(scan, turned)
    far_more = inverted >= _MORE_IF_INVERTED * max(inside, 1) and upright is not True
    if not far_more and not (inverted > inside and upright is False and upright_inverted):
        return []
    text = (
        f"the extrinsics put {inside:,} of {len(scan):,} scan points into the image, their inverse"
        f" {inverted:,}; if they map the camera to the scanner, add --scan inverse-extrinsics"
    )
    if inside < _NEXT_TO_NONE * inverted:
        raise UsageError(text)
    return [f"warning: {text}"]


def check_field_of_view(
    scan: NDArray[np.floating], camera: Camera, size: tuple[int, int]
) -> list[str]:
    """Returns a warning if many points straight ahead of the camera are outside the image.

    Args:
        scan: (N, 3) metres in the scanner's frame.
        camera: With the pose.
        size: (H, W) of the image.
    """
    seen = camera.from_scanner(scan)
    off_axis = np.hypot(seen[:, 0], seen[:, 1])
    ahead = seen[off_axis < np.tan(np.radians(_AHEAD_DEG)) * seen[:, 2]]
    outside = len(ahead) - int(np.count_nonzero(in_frame(camera.pixels_of(ahead), size)))
    if outside <= _MOST_OUTSIDE * len(ahead):
        return []
    return [
        f"warning: {outside:,} of the {len(ahead):,} scan points within {_AHEAD_DEG:g}° of the"
        " camera's axis fall outside the image; check that the intrinsics belong to this image,"
        " such as those of a rectified one"
    ]


def _is_upright(scan: NDArray[np.floating], camera: Camera) -> bool | None:
    """Whether the thin direction of the scan is the camera's y; None for a scan without one."""
    rays = scan / np.maximum(np.linalg.norm(scan, axis=1, keepdims=True), 1e-9)
    variances, axes = np.linalg.eigh(rays.T @ rays / len(rays))
    if variances[0] > _THIN * variances[1]:
        return None
    return bool(np.argmax(np.abs(camera.rotation @ axes[:, 0])) == 1)


def _count_inside(scan: NDArray[np.floating], camera: Camera, size: tuple[int, int]) -> int:
    seen = camera.from_scanner(scan)
    xy = camera.pixels_of(seen[seen[:, 2] > 0])
    return int(np.count_nonzero(in_frame(xy, size)))


def camera_of(calibration: Calibration) -> Camera:
    """Returns the camera and the scanner's pose that a calibration describes."""
    return Camera(
        intrinsics=calibration.intrinsics,
        rotation=calibration.rotation,
        translation=calibration.translation,
        distortion=calibration.distortion,
        lens=calibration.lens,
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
