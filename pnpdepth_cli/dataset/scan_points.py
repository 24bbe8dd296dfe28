"""A LiDAR scan and a calibration: read, checked against the image, and projected into it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Camera, Extrinsics
from pnpdepth_cli.dataset.arrays import check_size
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.scan_fit import fit_warning, points_by_reading
from pnpdepth_cli.dataset.scan_returns import cloud_points, has_scanner, scan_returns
from pnpdepth_cli.dataset.sparse_depth import SparseDepth
from pnpdepth_cli.errors import InputError, NoPointsError, UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.colmap_model import model_files
from pnpdepth_cli.io.depth import describe_range
from pnpdepth_cli.io.file_bytes import fingerprint, read_bytes
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.io.poses import read_extrinsics
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import check_no_colmap_map, read_scan
from pnpdepth_cli.points import Size, in_frame
from pnpdepth_cli.sensors.edge_fit import edge_map, jumps_of
from pnpdepth_cli.sensors.ground import height_above_ground
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.projection import (
    Points,
    describe_dropped,
    points_in_image,
    project_velodyne,
)

_MORE_IF_INVERTED = 3.0
"""Times as many points in the image with inverted extrinsics, from which there is a warning."""
_NEXT_TO_NONE = 0.05
"""Of the points in the image with inverted extrinsics; fewer with those given are an error."""
_THIN = 0.5
"""Largest variance of a scan's rays along its thin direction, of that along the next one."""
_AHEAD_DEG = 15.0
"""Angle to the camera's axis below which points are expected in the image."""
_MOST_OUTSIDE = 1 / 3
"""Of the points ahead; more outside the image give a warning."""
_FARTHEST_SCANNER_M = 20.0
"""From its camera; farther apart are the origins of maps."""
_CLEARLY_BETTER = 1.0
"""In standard deviations by chance, of a camera that replaces the one that is named."""
_CHANCE_PX = 80.0
"""Shifts by which the spread by chance is known."""
_HIGH_M = 4.5
"""Height above the ground from which a scanner is on no vehicle; scanners on trucks are at 4 m."""
_ON_VEHICLES_M = (0.15, 4.0)
"""Heights of scanners on vehicles and robots."""
_UNITS = {"feet": 3.28084, "decimetres": 10.0, "inches": 39.3701}
"""Numbers per metre."""
_CAMERAS = 4
"""Of KITTI; more of a calibration are not tried."""
_FEW_INSIDE = 0.5
"""Of the most points in the image; a camera with fewer is ruled out."""


class _Cloud(NamedTuple):
    """The points of a scan, in metres."""

    xyz: NDArray[np.floating]
    """(N, 3) in the scanner's coordinates."""
    source: str
    """What was read, for a person."""
    of_scanner: bool
    """Whether they were measured from their origin."""
    dropped: dict[str, int]
    """Number of stored points that are no returns, by the reason."""
    notes: list[str]


def read_scan_points(
    path: Path,
    options: ScanOptions,
    size: Size | None,
    image: Path | None = None,
    *,
    rgb: NDArray[np.float32] | None = None,
    scale: float | None = None,
    of_integers: str = "",
    search: bool = True,
) -> SparseDepth:
    """Returns the points of a scan that are visible in an image.

    Args:
        path: The scan.
        options: The calibration, and whether occluded points stay.
        size: (H, W) of the image; None for the calibration's.
        image: File of the image; its edges tell whether it is rectified, where the calibration
            leaves that open.
        rgb: The image (H, W, 3) in 0…1, if its file has been read.
        scale: Numbers of the scan per metre that the user states.
        of_integers: The other file of the frame whose integers that scale is of, if there is one.
        search: Whether it is searched how image and scan belong together.

    Raises:
        InputError: A file cannot be read, or calibration and image do not fit together.
        NoPointsError: No point is visible.
    """
    # The calibration must be of the image.
    calibration, calib = _calibration_of(path, options)
    size = size or calibration.camera.size
    if size is None:
        raise InputError(f"{calib} does not give the image's size; give --image")
    warnings = check_size(calib, calibration.camera, size, image)
    # The returns of the scan, in metres.
    cloud = _read_cloud(path, calibration, scale, of_integers)
    # Of several cameras, that of the image. The image is read where its edges tell something.
    may_differ = bool(calibration.rectified)
    if image is not None and rgb is None and (may_differ or search):
        rgb = read_rgb(image).values
    if may_differ:
        frames = [] if image is None or rgb is None else [(rgb, cloud.xyz)]
        calibration, note = choose_camera(calibration, frames)
        warnings.append(note)
    # The extrinsics must be of this scanner and camera.
    of_extrinsics, seem_inverted = _extrinsics_warnings(cloud, calibration, options, calib, size)
    warnings += of_extrinsics
    # The points are projected, and what seems wrong is warned of.
    points = _project(cloud, calibration, size, keep_occluded=options.keep_occluded)
    seen = calibration.known_scanner.apply(cloud.xyz)
    warnings += _outside_warning(seen, calibration.camera, size)
    is_searched = search and not calibration.rectified and not seem_inverted
    if is_searched and image is not None and rgb is not None:
        others = _other_cameras(options, image)
        warnings += _edge_warning(cloud, points, calibration, others, options, rgb)
        if cloud.of_scanner and (scale is None or of_integers):
            warnings += _height_note(cloud.xyz @ calibration.known_scanner.rotation.T)
    # What a person should know, and what a record keeps.
    camera = calibration.camera
    reading = Reading(f"{cloud.source} of {len(cloud.xyz):,} points, {camera.source}")
    notes = [f"sparse: {describe_range(points.depth, reading)}", *cloud.notes]
    lost = describe_dropped(points.dropped)
    if lost:
        notes.append(f"sparse: dropped {lost}")
    return SparseDepth(
        points=points,
        camera=replace(camera, source=f"calibration of {path.name}"),
        record=FileRecord(
            path=str(path),
            kind="scan",
            sha256=fingerprint(path).sha256,
            read_as=reading.source,
            calibration=str(calib),
            camera=options.camera,
            extrinsics=None if options.extrinsics is None else str(options.extrinsics),
            keep_occluded=options.keep_occluded,
            dropped={**cloud.dropped, **points.dropped},
        ),
        notes=(*notes, *warnings),
        reading=reading,
    )


def _read_cloud(
    path: Path, calibration: Calibration, scale: float | None, of_integers: str
) -> _Cloud:
    """The points of a scan that are returns, or those of a cloud that no scanner measured."""
    stored, source = read_scan(path)
    if _of_scanner(calibration, stored):
        xyz, dropped, notes = scan_returns(path, stored, scale, of_integers=of_integers)
        return _Cloud(xyz, source, of_scanner=True, dropped=dropped, notes=notes)
    points, dropped, notes = cloud_points(path, stored, None if of_integers else scale)
    notes.append(
        "sparse: a cloud that no scanner at its origin measured; points behind nearer ones are"
        " taken for hidden"
    )
    return _Cloud(points, source, of_scanner=False, dropped=dropped, notes=notes)


def _extrinsics_warnings(
    cloud: _Cloud, calibration: Calibration, options: ScanOptions, calib: Path, size: Size
) -> tuple[list[str], bool]:
    """Lines on the pose of the scanner, and whether it seems to be inverted."""
    lines = list[str]()
    if options.extrinsics is not None and calibration.rectification is not SAME_PLACE:
        lines.append(
            f"extrinsics: in the coordinates of the unrectified camera 0; the rotation and offset"
            f" that {calib} rectifies with are applied"
        )
    # KITTI's own files have one direction.
    if options.extrinsics is None and calibration.camera.source.startswith("KITTI"):
        return lines, False
    inverted = check_direction(cloud.xyz, calibration.camera, calibration.known_scanner, size)
    return [*lines, *inverted], bool(inverted)


def _project(cloud: _Cloud, calibration: Calibration, size: Size, *, keep_occluded: bool) -> Points:
    """The points that the image (H, W) shows.

    Raises:
        NoPointsError: There is none. It names the axes of the scan by which there are some.
    """
    try:
        return project_velodyne(
            cloud.xyz,
            calibration.camera,
            calibration.known_scanner,
            size,
            keep_occluded=keep_occluded,
            has_scanner=cloud.of_scanner,
        )
    except NoPointsError as error:
        inside = points_by_reading(cloud.xyz, calibration, size)
        text, count = max(inside.items(), key=lambda reading: reading[1])
        if not count:
            raise
        raise NoPointsError(f"{error}; {text}, {count:,} points would be in the image") from error


def _edge_warning(
    cloud: _Cloud,
    points: Points,
    calibration: Calibration,
    others: Mapping[str, Calibration],
    options: ScanOptions,
    rgb: NDArray[np.float32],
) -> list[str]:
    """A warning if the image's edges contradict how the points are projected."""
    if cloud.of_scanner:
        return fit_warning(cloud.xyz, calibration, others, rgb)
    # From elsewhere, hidden points of a cloud would be jumps.
    visible = points
    if options.keep_occluded:
        visible = _project(cloud, calibration, points.size, keep_occluded=False)
    seen = unproject(calibration.camera, visible.xy, visible.depth)
    return fit_warning(seen, replace(calibration, scanner=SAME_PLACE), {}, rgb, is_whole=False)


def _calibration_of(path: Path, options: ScanOptions) -> tuple[Calibration, Path]:
    """The calibration, with a pose of the scanner, and its path."""
    calib = options.calib
    if calib is None and path in model_files(path.parent):
        raise UsageError(f"{path} is of a COLMAP model; name its folder, {path.parent}")
    if calib is None:
        if path.suffix.lower() == ".bin":
            check_no_colmap_map(path, read_bytes(path)[:32])
        raise UsageError(
            f"{path} is a scan, which needs --calib: a calibration file, or KITTI's raw folder"
        )
    calibration = read_calibration(calib, options.camera)
    if options.extrinsics is not None:
        pose = calibration.rectification @ read_extrinsics(options.extrinsics)
        calibration = replace(calibration, scanner=pose)
    if calibration.scanner is None:
        raise UsageError(
            f"{calib} has no pose of the scanner; add it (R and t, Tr, T_camera_lidar), or give"
            " --extrinsics FILE"
        )
    return calibration, calib


def _of_scanner(calibration: Calibration, stored: NDArray[np.floating]) -> bool:
    """Whether the points were measured from their origin, by the pose and by their directions."""
    away_m = float(np.linalg.norm(calibration.known_scanner.translation))
    return away_m <= _FARTHEST_SCANNER_M and has_scanner(stored)


def choose_camera(
    raw: Calibration,
    frames: Iterable[tuple[NDArray[np.float32], NDArray[np.floating]]],
    topic: str = "",
) -> tuple[Calibration, str]:
    """Returns the camera of images that may be rectified, and a line that says which it is.

    A topic image_rect* is of rectified images. Any other image is raw, unless a rectified camera
    puts the jumps of depth clearly better onto its edges: some bags hold rectified images as
    image_raw.

    Args:
        raw: The camera of raw images and the pose of the scanner, with the rectified cameras.
        frames: Images (H, W, 3) in 0..1, each with a scan (N, 3).
        topic: Topic of the images, where it is known.
    """
    cameras = {
        name: Calibration(camera=camera, scanner=raw.scanner and of_raw @ raw.scanner)
        for name, (camera, of_raw) in raw.rectified.items()
    }
    candidates = cameras if "image_rect" in topic else {"K and distortion": raw} | cameras
    choice = next(iter(candidates))
    named = candidates[choice]
    why = f"the topic {topic}" if topic else "the usual meaning of camera_info"
    # How well jumps of depth meet edges, in the mean of the frames.
    scores = list[dict[str, float]]()
    if named.scanner is not None and len(candidates) > 1:
        for rgb, xyz in frames:
            of_frame = _scores(xyz, rgb, named, candidates)
            if of_frame is not None:
                scores.append(of_frame)
    if scores:
        mean = {
            name: float(np.mean([of_frame[name] for of_frame in scores])) for name in candidates
        }
        best = max(mean, key=lambda name: mean[name])
        if mean[best] - mean[choice] > _CLEARLY_BETTER:
            choice = best
        compared = ", ".join(f"{name} {score:+.2f}" for name, score in mean.items())
        why = f"image edges at jumps of depth: {compared}"
    images = "rectified" if choice in cameras else "raw"
    note = f"camera: {images} images, by {choice} ({why}); --calib gives another"
    return candidates[choice], note


def _scores(
    scan: NDArray[np.floating],
    rgb: NDArray[np.float32],
    named: Calibration,
    candidates: Mapping[str, Calibration],
) -> dict[str, float] | None:
    """The score of each calibration; 0 of one that puts few of the jumps into the image.

    None where the points tell nothing.
    """
    # The jumps of depth are those that the named camera sees.
    size = (rgb.shape[0], rgb.shape[1])
    jumps = jumps_of(scan, named.camera, named.known_scanner, size)
    if jumps is None:
        return None
    edges = edge_map(rgb)
    shifted = edges.shifted(*jumps.projected(named.camera), (_CHANCE_PX, _CHANCE_PX))
    chance = float(shifted.mean())
    spread = float(shifted.std()) + 1e-9
    # The others project them anew.
    scores = dict.fromkeys(candidates, 0.0)
    for name, candidate in candidates.items():
        motion = candidate.known_scanner @ named.known_scanner.inverse()
        xy, weights = jumps.moved(motion).projected(candidate.camera)
        if np.count_nonzero(in_frame(xy, size)) >= _FEW_INSIDE * len(jumps.xyz):
            scores[name] = (edges.score(xy, weights) - chance) / spread
    return scores


def check_direction(
    scan: NDArray[np.floating], camera: Camera, scanner: Extrinsics, size: Size
) -> list[str]:
    """Returns a warning if the inverse of the scanner's pose fits the image (H, W) better.

    The inverse fits better if it puts far more points into the image. It also does if it puts more
    points into it and the camera upright in the scan, which is flatter than it is wide.

    Raises:
        UsageError: The pose puts next to none of the points into the image.
    """
    poses = (scanner, scanner.inverse())
    inside, inverted = (len(points_in_image(pose.apply(scan), camera, size)[0]) for pose in poses)
    upright, upright_inverted = (_is_upright(scan, pose.rotation) for pose in poses)
    far_more = inverted >= _MORE_IF_INVERTED * max(inside, 1)
    if upright or inverted <= inside or not (far_more or upright_inverted):
        return []
    text = (
        f"the extrinsics put {inside:,} of {len(scan):,} scan points into the image, their inverse"
        f" {inverted:,}; if they map the camera to the scanner, give their inverse"
    )
    if inside < _NEXT_TO_NONE * inverted:
        raise UsageError(text)
    return [f"warning: {text}"]


def _outside_warning(seen: NDArray[np.float64], camera: Camera, size: Size) -> list[str]:
    """A warning if many points (N, 3) straight ahead of the camera are outside the image."""
    off_axis = np.hypot(seen[:, 0], seen[:, 1])
    ahead = seen[off_axis < np.tan(np.radians(_AHEAD_DEG)) * seen[:, 2]]
    outside = len(ahead) - int(np.count_nonzero(in_frame(pixels_of(camera, ahead), size)))
    if outside <= _MOST_OUTSIDE * len(ahead):
        return []
    return [
        f"warning: {outside:,} of the {len(ahead):,} scan points within {_AHEAD_DEG:g}° of the"
        " camera's axis fall outside the image; check that the intrinsics belong to this image,"
        " such as those of a rectified one"
    ]


def _height_note(seen: NDArray[np.float64]) -> list[str]:
    """A line if a scan (N, 3), in the camera's axes, is from as high as one in feet would be."""
    height_m = height_above_ground(seen)
    if height_m is None or height_m < _HIGH_M:
        return []
    low, high = _ON_VEHICLES_M
    units = [
        f"--depth-scale {scale:g} if it is in {name}"
        for name, scale in _UNITS.items()
        if low <= height_m / scale <= high
    ]
    if not units:
        return []
    return [
        f"note: the ground is {height_m:.1f} m below the scanner, as of a drone or a mast;"
        f" {', '.join(units)}"
    ]


def _other_cameras(options: ScanOptions, image: Path) -> dict[str, Calibration]:
    """The other cameras of a calibration of several, by what gives them."""
    found = dict[str, Calibration]()
    if options.extrinsics is not None:
        return found
    for number in range(_CAMERAS):
        with suppress(UsageError):  # there is no such camera
            text = f"with --camera {number}"
            found[text], _ = _calibration_of(image, replace(options, camera=number))
    return found


def _is_upright(scan: NDArray[np.floating], rotation: NDArray[np.float64]) -> bool:
    """Whether the scan has a thin direction, and that is the camera's y."""
    rays = scan / np.maximum(np.linalg.norm(scan, axis=1, keepdims=True), 1e-9)
    variances, axes = np.linalg.eigh(rays.T @ rays / len(rays))
    is_thin = variances[0] <= _THIN * variances[1]
    return bool(is_thin and np.argmax(np.abs(rotation @ axes[:, 0])) == 1)
