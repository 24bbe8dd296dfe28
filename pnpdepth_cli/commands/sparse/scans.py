"""A LiDAR scan and a calibration: read, checked against the image, and projected into it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.sparse.options import METRES, ScanOptions
from pnpdepth_cli.errors import NoPointsError, SizeError, UsageError
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.depth import DepthKind, describe_range
from pnpdepth_cli.io.extrinsics import inverse, read_extrinsics
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.points import SparsePoints, in_frame
from pnpdepth_cli.sensors import Camera, describe_dropped, edge_agreement, project_velodyne

_MORE_IF_INVERTED = 3.0  # times as many points in the image with inverted extrinsics: a warning
_NEXT_TO_NONE = 0.05  # of them; fewer points with the extrinsics themselves are an error
_THIN = 0.5  # largest variance of a scan's rays along its thin direction, of the next
_AHEAD_DEG = 15.0  # angle to the camera's axis below which points are expected in the image
_MOST_OUTSIDE = 1 / 3  # of these points; more outside the image give a warning
_OFF_CENTRE = 0.15  # of the image's side: principal points nearer the centre give no warning
_CLEARLY_BETTER = 0.03  # in `edge_agreement`, of a camera that replaces the one that is named
_FEW_INSIDE = 0.5  # of the most points in the image; a camera with fewer is ruled out


@dataclass(frozen=True, kw_only=True)
class SparseDepth:
    """The sparse depth of a frame, as it was read."""

    points: SparsePoints[Any]
    """In the image, as arrays of either library."""
    record: dict[str, Any]
    notes: tuple[str, ...]
    scale: float | None = None
    """Integers per unit of depth in its file. None: it holds no integers."""
    kind: DepthKind | None = None
    unit: str = METRES
    camera: Camera | None = None
    """The camera of the whole image, where it came with the points."""
    camera_source: str = ""
    pose: NDArray[np.float64] | None = None
    """(3, 4) from the camera's frame to the world's, in `unit`. None: unknown."""


def read_scan_points(
    path: Path,
    options: ScanOptions,
    size: tuple[int, int] | None,
    image: Path | None = None,
) -> SparseDepth:
    """Returns the points of a scan that are visible in an image.

    Args:
        path: The scan.
        options: Calibration and limits.
        size: (H, W) of the image; None for the calibration's.
        image: Its file; tells whether it is rectified, where the calibration leaves that open.

    Raises:
        InputError: A file cannot be read.
        SizeError: Calibration and image do not fit together.
        NoPointsError: No point is visible.
    """
    named = options.calib
    if named is None:
        raise UsageError(
            f"{path} is a scan, which needs --calib: a calibration file, or KITTI's raw folder"
        )
    calibration = read_calibration(named, options.camera)
    if options.extrinsics is not None:
        rotation, translation = read_extrinsics(options.extrinsics)
        calibration = _with_pose(calibration, rotation, translation)
    if not calibration.has_pose:
        raise UsageError(
            f"{named} has no pose of the scanner; add it (R and t, Tr, T_camera_lidar), or"
            " give --scan extrinsics=FILE"
        )
    if options.inverse_extrinsics:
        pose = inverse((calibration.rotation, calibration.translation))
        calibration = _with_pose(calibration, *pose)
    size = size or calibration.size
    if size is None:
        raise SizeError(f"{named} does not give the image's size; give --image or --size")
    warnings = check_size(named, calibration, size, image)
    scan = read_scan(path, options.point_fields)
    if calibration.rectified:
        frames = [] if image is None else [(read_rgb(image).values, scan.points)]
        calibration, note = chosen_camera(calibration, frames)
        warnings.append(note)
    camera = camera_of(calibration)
    if not calibration.source.startswith("KITTI"):  # whose pose has one direction
        warnings += check_direction(scan.points, camera, size)
    points = project_velodyne(
        scan.points,
        camera,
        size,
        euclidean=options.euclidean,
        limits=(options.min_range, np.inf if options.max_range is None else options.max_range),
        keep_occluded=options.keep_occluded,
    )
    warnings += _outside_warning(scan.points, camera, size)
    source = f"{scan.source} of {len(scan.points):,} points, {calibration.source}"
    notes = [f"sparse: {describe_range(points.depth, source)}"]
    if lost := describe_dropped(points.dropped):
        notes.append(f"sparse: dropped {lost}")
    return SparseDepth(
        points=points,
        camera=camera,
        camera_source=f"calibration of {path.name}",
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


def chosen_camera(
    raw: Calibration,
    frames: Iterable[tuple[NDArray[np.float32], NDArray[np.float32]]],
    topic: str = "",
) -> tuple[Calibration, str]:
    """Returns the camera of images that may be rectified, and a line that says which it is.

    A topic image_rect* is of rectified images. Any other image is raw unless a rectified camera
    puts the jumps of depth clearly better onto its edges, as in bags that hold rectified images as
    image_raw.

    Args:
        raw: K, distortion and the pose of the scanner, with the rectified cameras.
        frames: Images (H, W, 3) in 0..1, each with a scan (N, 3).
        topic: Of the images, where it is known.
    """
    named = "image_rect" in topic
    cameras = {
        name: _with_pose(
            camera,
            camera.rotation @ raw.rotation,
            camera.rotation @ raw.translation + camera.translation,
            has_pose=raw.has_pose,
        )
        for name, camera in raw.rectified.items()
    }
    candidates = cameras if named else {"K and distortion": raw} | cameras
    scores = _scores(frames, candidates) if raw.has_pose and len(candidates) > 1 else {}
    choice = first = next(iter(candidates))
    best = max(scores, key=lambda name: scores[name], default=first)
    if best != first and scores[best] - scores[first] > _CLEARLY_BETTER:
        choice = best
    why = f"the topic {topic}" if named else "the usual meaning of camera_info"
    if scores and (choice != first or not named):
        compared = ", ".join(f"{name} {score:+.2f}" for name, score in scores.items())
        why = f"image edges at jumps of depth: {compared}"
    images = "rectified" if choice in cameras else "raw"
    note = f"camera: {images} images, by {choice} ({why}); --calib gives another"
    return candidates[choice], note


def _with_pose(
    camera: Calibration,
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    *,
    has_pose: bool = True,
) -> Calibration:
    return replace(camera, rotation=rotation, translation=translation, has_pose=has_pose)


def _scores(
    frames: Iterable[tuple[NDArray[np.float32], NDArray[np.float32]]],
    candidates: Mapping[str, Calibration],
) -> dict[str, float]:
    """The mean edge agreement of frames by camera, −1 for one that puts few points into them."""
    agreement = {name: list[float]() for name in candidates}
    counts = dict.fromkeys(candidates, 0)
    for rgb, xyz in frames:
        for name, calibration in candidates.items():
            try:
                points = project_velodyne(xyz, camera_of(calibration), rgb.shape[:2])
            except NoPointsError:
                continue
            counts[name] += len(points)
            agreement[name].append(edge_agreement(points, rgb))
    few = _FEW_INSIDE * max(counts.values())
    return {
        name: float(np.mean(values)) if counts[name] >= few else -1.0
        for name, values in agreement.items()
        if any(counts.values())
    }


def check_direction(scan: NDArray[np.floating], camera: Camera, size: tuple[int, int]) -> list[str]:
    """Returns a warning if the inverse of the scanner's pose fits the image (H, W) better.

    That is: it puts far more points into the image, or more points and the camera upright in the
    scan, which is flatter than it is wide.

    Raises:
        UsageError: The pose puts next to none of the points into the image.
    """
    rotation, translation = inverse((camera.rotation, camera.translation))
    turned = replace(camera, rotation=rotation, translation=translation)
    seen = (eye.from_scanner(scan) for eye in (camera, turned))
    inside, inverted = (
        int(np.count_nonzero(in_frame(eye.pixels_of(xyz[xyz[:, 2] > 0]), size)))
        for eye, xyz in zip((camera, turned), seen, strict=True)
    )
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


def _outside_warning(
    scan: NDArray[np.floating], camera: Camera, size: tuple[int, int]
) -> list[str]:
    """A warning if many points straight ahead of the camera are outside the image."""
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
    """Returns warnings if image (H, W) and calibration seem to belong to different cameras.

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
