"""A LiDAR scan and a calibration: read, checked against the image, and projected into it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Camera, Extrinsics
from pnpdepth_cli.dataset.arrays import check_camera
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.rectified_camera import choose_camera
from pnpdepth_cli.dataset.scan_fit import fit_warning, points_by_alternative
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
from pnpdepth_cli.sensors.ground import height_above_ground
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.projection import (
    Points,
    describe_dropped,
    points_in_image,
    project_velodyne,
)

_FARTHEST_SCANNER_M = 20.0
"""Distance of a scanner from its camera; farther apart are the origins of maps."""
_KITTI_CAMERAS = 4
"""Cameras of KITTI; if a calibration has more, they are not tried."""

# Extrinsics that may be inverted.
_MORE_IF_INVERTED = 3.0
"""Times as many points in the image with inverted extrinsics, from which there is a warning."""
_NEXT_TO_NONE = 0.05
"""Fraction of the points in the image with inverted extrinsics; fewer with those that are given are
an error."""
_THIN = 0.5
"""Largest variance of a scan's rays along its thin direction, as a fraction of the next one."""

# Intrinsics of another image.
_AHEAD_DEG = 15.0
"""Angle to the camera's axis below which points are expected in the image."""
_MOST_OUTSIDE = 1 / 3
"""Fraction of the points ahead that may be outside the image without a warning."""


# Heights that tell a scan in another unit.
_HIGH_M = 4.5
"""Height above the ground from which a scanner is on no vehicle; scanners on trucks are at 4 m."""
_ON_VEHICLES_M = (0.15, 4.0)
"""The smallest and the largest height of scanners on vehicles and robots."""
_UNITS = {"feet": 3.28084, "decimetres": 10.0, "inches": 39.3701}
"""Numbers per metre."""


class _Cloud(NamedTuple):
    """The points of a scan, in metres."""

    xyz: NDArray[np.floating]
    """(N, 3) in the scanner's coordinates."""
    source: str
    """Format of the file, for a person."""
    of_scanner: bool
    """Whether a scanner at the origin of the coordinates measured the points."""
    dropped: dict[str, int]
    """Number of stored points that are no returns, by the reason."""
    notes: list[str]
    """Lines for a person."""


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
    """Returns the points of a scan that are visible in an image, with depth z in metres.

    Args:
        path: The scan.
        options: The calibration, and whether occluded points stay.
        size: (H, W) of the image. None: the calibration states it.
        image: File of the image; its edges tell whether it is rectified, where the calibration
            leaves that open. None: there is none.
        rgb: (H, W, 3) in 0…1, the image, if its file has been read.
        scale: Numbers of the scan per metre that the user or the data set states.
        of_integers: Where the integers are that `scale` is stated for, if not here: path of the
            frame's other file, or `plausible.OF_DATA_SET`. Floats are then divided only where they
            cannot be metres. Empty: it is stated for these very numbers.
        search: Whether it is searched how image and scan belong together.

    Raises:
        InputError: A file cannot be read, or calibration and image do not fit together.
        NoPointsError: No point is visible.
        UsageError: There is no calibration, or it has no pose of the scanner.
    """
    # The calibration must be of the image.
    calibration, calib = _calibration_of(path, options)
    size = size or calibration.camera.size
    if size is None:
        raise InputError(f"{calib} does not give the image's size; give --image")
    warnings = check_camera(calib, calibration.camera, size, image)
    # The returns of the scan, in metres.
    cloud = _read_cloud(path, calibration, scale, of_integers)
    # Of a raw and rectified cameras, that of the image. It is read where its edges tell something.
    may_be_rectified = bool(calibration.rectified)
    if image is not None and rgb is None and (may_be_rectified or search):
        rgb = read_rgb(image).values
    if may_be_rectified:
        frames = [] if image is None or rgb is None else [(rgb, cloud.xyz)]
        calibration, note = choose_camera(calibration, frames)
        warnings.append(note)
    # The extrinsics must be of this scanner and camera.
    pose_notes, seem_inverted = _extrinsics_notes(cloud, calibration, options, calib, size)
    warnings += pose_notes
    # The points are projected, and what seems wrong is warned of.
    points = _project(cloud, calibration, size, keep_occluded=options.keep_occluded)
    xyz_of_camera = calibration.known_scanner.apply(cloud.xyz)
    warnings += _outside_warning(xyz_of_camera, calibration.camera, size)
    is_searched = search and not calibration.rectified and not seem_inverted
    if is_searched and image is not None and rgb is not None:
        others = _other_cameras(options, image)
        warnings += _edge_warning(cloud, points, calibration, others, options, rgb)
        # The height tells another unit, unless the unit is stated.
        if cloud.of_scanner and (scale is None or of_integers):
            warnings += _height_note(cloud.xyz @ calibration.known_scanner.rotation.T)
    # What a person should know, and what a record keeps.
    camera = calibration.camera
    reading = Reading(f"{cloud.source} of {len(cloud.xyz):,} points, {camera.source}")
    notes = [f"sparse: {describe_range(points.depth, reading)}", *cloud.notes]
    described = describe_dropped(points.dropped)
    if described:
        notes.append(f"sparse: dropped {described}")
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
    """The points of a scan that are returns, or those of a cloud that no scanner measured.

    Args:
        path: The scan.
        calibration: Calibration with the pose of the scanner.
        scale: Numbers per metre that are stated. None: none are.
        of_integers: Where the integers are that `scale` is stated for, as `read_scan_points` has
            it. Empty: it is stated for this scan.
    """
    stored, source = read_scan(path)
    if _is_of_scanner(calibration, stored):
        xyz, dropped, notes = scan_returns(path, stored, scale, of_integers=of_integers)
        return _Cloud(xyz, source, of_scanner=True, dropped=dropped, notes=notes)
    points, dropped, notes = cloud_points(path, stored, None if of_integers else scale)
    notes.append(
        "sparse: a cloud that no scanner at its origin measured; points behind nearer ones are"
        " taken for hidden"
    )
    return _Cloud(points, source, of_scanner=False, dropped=dropped, notes=notes)


def _extrinsics_notes(
    cloud: _Cloud, calibration: Calibration, options: ScanOptions, calib: Path, size: Size
) -> tuple[list[str], bool]:
    """Lines on the pose of the scanner, and whether it seems to be inverted.

    Args:
        cloud: The points of the scan.
        calibration: Calibration with the pose of the scanner.
        options: Options with the file of the pose, if the user gives one.
        calib: File of the calibration, for messages.
        size: (H, W) of the image.

    Raises:
        UsageError: The pose puts next to none of the points into the image.
    """
    lines = list[str]()
    if options.extrinsics is not None and calibration.rectification is not SAME_PLACE:
        lines.append(
            f"extrinsics: in the coordinates of the unrectified camera 0; the rotation and offset"
            f" that {calib} rectifies with are applied"
        )
    # KITTI's own files always have the pose in one direction.
    if options.extrinsics is None and calibration.camera.source.startswith("KITTI"):
        return lines, False
    inverted = check_direction(cloud.xyz, calibration.camera, calibration.known_scanner, size)
    return [*lines, *inverted], bool(inverted)


def _project(cloud: _Cloud, calibration: Calibration, size: Size, *, keep_occluded: bool) -> Points:
    """The points of a scan that the image shows, with depth z in metres.

    Args:
        cloud: The points of the scan.
        calibration: The calibration, with a pose of the scanner.
        size: (H, W) of the image.
        keep_occluded: Whether points stay that nearer ones hide from the camera.

    Raises:
        NoPointsError: There is none. It names the axes or the pose of the scan by which there would
            be some.
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
        # The axes or the pose of the scan by which most points would be in the image.
        counts = points_by_alternative(cloud.xyz, calibration, size)
        text = max(counts, key=lambda alternative: counts[alternative])
        count = counts[text]
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
    """A warning if the image's edges contradict how the points are projected, else none.

    Args:
        cloud: The points of the scan.
        points: The points that the image shows.
        calibration: The calibration by which they are projected.
        others: Further calibrations of the same scan, by the option that gives each.
        options: Options that say whether `points` has occluded ones.
        rgb: (H, W, 3) in 0…1, the image.
    """
    if cloud.of_scanner:
        return fit_warning(cloud.xyz, calibration, others, rgb)
    # A cloud is compared as the camera sees it: hidden points beside nearer ones are no jumps.
    visible = points
    if options.keep_occluded:
        visible = _project(cloud, calibration, points.size, keep_occluded=False)
    # Coordinates of the camera, in which there is no scanner elsewhere.
    xyz = unproject(calibration.camera, visible.xy, visible.depth)
    return fit_warning(xyz, replace(calibration, scanner=SAME_PLACE), {}, rgb, is_whole=False)


def _calibration_of(path: Path, options: ScanOptions) -> tuple[Calibration, Path]:
    """The calibration of a scan, with a pose of the scanner, and the path of the calibration.

    Args:
        path: The scan, for messages.
        options: Options with the file of the calibration, and that of the pose if there is one.

    Raises:
        InputError: A file cannot be read.
        UsageError: There is no calibration, or it has no pose of the scanner.
    """
    calib = options.calib
    if calib is None and path in model_files(path.parent):
        raise UsageError(f"{path} is of a COLMAP model; name its folder, {path.parent}")
    if calib is None:
        # A depth map of COLMAP has a scan's suffix; its first bytes tell.
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


def _is_of_scanner(calibration: Calibration, stored: NDArray[np.floating]) -> bool:
    """Whether a scanner at the origin of the points (N, 3) measured them.

    It did not if the calibration has it far from the camera, or if the points are no such view.
    """
    away_m = float(np.linalg.norm(calibration.known_scanner.translation))
    return away_m <= _FARTHEST_SCANNER_M and has_scanner(stored)


def check_direction(
    scan: NDArray[np.floating], camera: Camera, scanner: Extrinsics, size: Size
) -> list[str]:
    """Returns a warning if the inverse of the scanner's pose fits the image better, else none.

    The inverse fits better if it puts far more points into the image. It also does if it puts more
    points into it and the camera upright in the scan, which is flatter than it is wide.

    Args:
        scan: (N, 3) metres in the scanner's coordinates.
        camera: The camera of the image.
        scanner: The pose that is given.
        size: (H, W) of the image.

    Raises:
        UsageError: The pose puts next to none of the points into the image.
    """
    inverse = scanner.inverse()
    inside = _count_in_image(scan, camera, scanner, size)
    inside_by_inverse = _count_in_image(scan, camera, inverse, size)
    if inside_by_inverse <= inside or _is_upright(scan, scanner.rotation):
        return []
    has_far_more = inside_by_inverse >= _MORE_IF_INVERTED * max(inside, 1)
    if not has_far_more and not _is_upright(scan, inverse.rotation):
        return []
    text = (
        f"the extrinsics put {inside:,} of {len(scan):,} scan points into the image, their inverse"
        f" {inside_by_inverse:,}; if they map the camera to the scanner, give their inverse"
    )
    if inside < _NEXT_TO_NONE * inside_by_inverse:
        raise UsageError(text)
    return [f"warning: {text}"]


def _count_in_image(
    scan: NDArray[np.floating], camera: Camera, scanner: Extrinsics, size: Size
) -> int:
    """The number of points of a scan (N, 3) that a pose of it puts into the image (H, W)."""
    xyz, _ = points_in_image(scanner.apply(scan), camera, size)
    return len(xyz)


def _outside_warning(xyz: NDArray[np.float64], camera: Camera, size: Size) -> list[str]:
    """A warning if many points straight ahead of the camera are outside the image, else none.

    Args:
        xyz: (N, 3) in the camera's coordinates.
        camera: The camera.
        size: (H, W) of the image.
    """
    off_axis = np.hypot(xyz[:, 0], xyz[:, 1])
    ahead = xyz[off_axis < np.tan(np.radians(_AHEAD_DEG)) * xyz[:, 2]]
    outside = len(ahead) - int(np.count_nonzero(in_frame(pixels_of(camera, ahead), size)))
    if outside <= _MOST_OUTSIDE * len(ahead):
        return []
    return [
        f"warning: {outside:,} of the {len(ahead):,} scan points within {_AHEAD_DEG:g}° of the"
        " camera's axis fall outside the image; check that the intrinsics belong to this image,"
        " such as those of a rectified one"
    ]


def _height_note(xyz: NDArray[np.float64]) -> list[str]:
    """A line if a scan is from higher above the ground than vehicles are, else none.

    It names the units, such as feet, by which it would be from the height of a vehicle.

    Args:
        xyz: (N, 3) from the scanner's origin, in the camera's axes: x right, y down, z forward.
    """
    height_m = height_above_ground(xyz)
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
    """The calibrations of all cameras of a file that has several, by the option that gives them.

    There is none with extrinsics that the user states, as these are of one camera.

    Args:
        options: Options with the calibration.
        image: File of the image, for messages.
    """
    cameras = dict[str, Calibration]()
    if options.extrinsics is not None:
        return cameras
    for number in range(_KITTI_CAMERAS):
        with suppress(UsageError):  # there is no such camera
            calibration, _ = _calibration_of(image, replace(options, camera=number))
            cameras[f"with --camera {number}"] = calibration
    return cameras


def _is_upright(scan: NDArray[np.floating], rotation: NDArray[np.float64]) -> bool:
    """Whether a scan has a thin direction, and that is the camera's y, up or down.

    A rotating scanner sees far around it and little above and below.

    Args:
        scan: (N, 3) in the scanner's coordinates.
        rotation: (3, 3) from the scanner's axes to the camera's.
    """
    rays = scan / np.maximum(np.linalg.norm(scan, axis=1, keepdims=True), 1e-9)
    variances, directions = np.linalg.eigh(rays.T @ rays / len(rays))  # the thinnest is the first
    if variances[0] > _THIN * variances[1]:
        return False
    thinnest = rotation @ directions[:, 0]  # x, y, z of the camera
    return int(np.argmax(np.abs(thinnest))) == 1
