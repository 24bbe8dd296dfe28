"""A LiDAR scan and a calibration: read, checked against the image, and projected into it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Camera, Extrinsics
from pnpdepth_cli.dataset.arrays import check_size
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.plausible import cloud_points, has_scanner, scan_returns
from pnpdepth_cli.dataset.scan_fit import fit_warning, points_by_reading
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
    describe_dropped,
    points_in_image,
    project_velodyne,
)

_MORE_IF_INVERTED = 3.0  # times as many points in the image with inverted extrinsics: a warning
_NEXT_TO_NONE = 0.05  # of the points with them inverted; with fewer, extrinsics are an error
_THIN = 0.5  # largest variance of a scan's rays along its thin direction, of the next
_AHEAD_DEG = 15.0  # angle to the camera's axis below which points are expected in the image
_MOST_OUTSIDE = 1 / 3  # of the points ahead; more outside the image give a warning
_FARTHEST_SCANNER_M = 20.0  # from its camera; farther apart are the origins of maps
_CLEARLY_BETTER = 1.0  # in standard deviations by chance, of a camera that replaces the named one
_CHANCE_PX = 80.0  # shifts by which the spread by chance is known
_HIGH_M = 4.5  # above the ground; scanners on trucks are at 4 m
_ON_VEHICLES_M = (0.15, 4.0)
_UNITS = {"feet": 3.28084, "decimetres": 10.0, "inches": 39.3701}  # per metre
_CAMERAS = 4  # of KITTI; more of a calibration are not tried
_FEW_INSIDE = 0.5  # of the most points in the image; a camera with fewer is ruled out


def read_scan_points(
    path: Path,
    options: ScanOptions,
    size: Size | None,
    image: Path | None = None,
    *,
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
        scale: Numbers of the scan per metre that the user states.
        of_integers: The other file of the frame whose integers that scale is of, if there is one.
        search: Whether it is searched how image and scan belong together.

    Raises:
        InputError: A file cannot be read, or calibration and image do not fit together.
        NoPointsError: No point is visible.
    """
    # The calibration must be of the image.
    calibration, named = _calibration_of(path, options)
    size = size or calibration.camera.size
    if size is None:
        raise InputError(f"{named} does not give the image's size; give --image")
    warnings = check_size(named, calibration.camera, size, image)
    # The returns of the scan.
    stored, source = read_scan(path)
    of_scanner = _of_scanner(calibration, stored)
    xyz: NDArray[np.floating] = stored
    if of_scanner:
        xyz, no_returns, mended = scan_returns(path, stored, scale, of_integers=of_integers)
    else:
        xyz, no_returns, mended = cloud_points(path, stored, None if of_integers else scale)
        mended.append(
            "sparse: a cloud that no scanner at its origin measured; points behind nearer ones are"
            " taken for hidden"
        )
    if calibration.rectified:
        frames = [] if image is None else [(read_rgb(image).values, xyz)]
        calibration, note = choose_camera(calibration, frames)
        warnings.append(note)
    camera, scanner = calibration.camera, calibration.scanner
    assert scanner is not None
    if options.extrinsics is not None and calibration.rectification is not SAME_PLACE:
        warnings.append(
            f"extrinsics: in the coordinates of the unrectified camera 0; the rotation and offset"
            f" that {named} rectifies with are applied"
        )
    inverted = list[str]()
    if options.extrinsics is not None or not camera.source.startswith("KITTI"):  # one direction
        inverted = check_direction(xyz, camera, scanner, size)
        warnings += inverted
    # They are projected, and what seems wrong is warned of.
    try:
        points = project_velodyne(
            xyz,
            camera,
            scanner,
            size,
            keep_occluded=options.keep_occluded,
            has_scanner=of_scanner,
        )
    except NoPointsError as error:
        inside = points_by_reading(xyz, calibration, size)
        text, count = max(inside.items(), key=lambda item: item[1])
        if not count:
            raise
        raise NoPointsError(f"{error}; {text}, {count:,} points would be in the image") from error
    warnings += _outside_warning(scanner.apply(xyz), camera, size)
    if search and image is not None and not calibration.rectified and not inverted:
        others = _other_cameras(options, image)
        rgb = read_rgb(image).values
        if of_scanner:
            warnings += fit_warning(xyz, calibration, others, rgb)
            if scale is None or of_integers:
                warnings += _height_note(xyz @ scanner.rotation.T)
        else:  # from elsewhere, hidden points of a cloud would be jumps
            visible = points
            if options.keep_occluded:
                visible = project_velodyne(xyz, camera, scanner, size, has_scanner=False)
            seen = unproject(camera, visible.xy, visible.depth)
            of_camera = replace(calibration, scanner=SAME_PLACE)
            warnings += fit_warning(seen, of_camera, {}, rgb, is_whole=False)
    # What a person should know, and what a record keeps.
    reading = Reading(f"{source} of {len(xyz):,} points, {camera.source}")
    notes = [f"sparse: {describe_range(points.depth, reading)}", *mended]
    if lost := describe_dropped(points.dropped):
        notes.append(f"sparse: dropped {lost}")
    return SparseDepth(
        points=points,
        camera=replace(camera, source=f"calibration of {path.name}"),
        record=FileRecord(
            path=str(path),
            kind="scan",
            sha256=fingerprint(path).sha256,
            read_as=reading.source,
            calibration=str(named),
            camera=options.camera,
            extrinsics=None if options.extrinsics is None else str(options.extrinsics),
            keep_occluded=options.keep_occluded,
            dropped={**no_returns, **points.dropped},
        ),
        notes=(*notes, *warnings),
        reading=reading,
    )


def _calibration_of(path: Path, options: ScanOptions) -> tuple[Calibration, Path]:
    """The calibration, with a pose of the scanner, and its path."""
    named = options.calib
    if named is None and path in model_files(path.parent):
        raise UsageError(f"{path} is of a COLMAP model; name its folder, {path.parent}")
    if named is None:
        if path.suffix.lower() == ".bin":
            check_no_colmap_map(path, read_bytes(path)[:32])
        raise UsageError(
            f"{path} is a scan, which needs --calib: a calibration file, or KITTI's raw folder"
        )
    calibration = read_calibration(named, options.camera)
    if options.extrinsics is not None:
        pose = calibration.rectification @ read_extrinsics(options.extrinsics)
        calibration = replace(calibration, scanner=pose)
    if calibration.scanner is None:
        raise UsageError(
            f"{named} has no pose of the scanner; add it (R and t, Tr, T_camera_lidar), or give"
            " --extrinsics FILE"
        )
    return calibration, named


def _of_scanner(calibration: Calibration, stored: NDArray[np.floating]) -> bool:
    """Whether the points were measured from their origin, by the pose and by their directions."""
    assert calibration.scanner is not None
    away_m = float(np.linalg.norm(calibration.scanner.translation))
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
    own = candidates[choice]
    why = f"the topic {topic}" if topic else "the usual meaning of camera_info"
    # How well jumps of depth meet edges, in the mean of the frames.
    scores = list[dict[str, float]]()
    for rgb, xyz in frames if own.scanner and len(candidates) > 1 else ():
        assert own.scanner is not None
        of_frame = _scores(xyz, rgb, own, candidates)
        if of_frame is not None:
            scores.append(of_frame)
    if scores:
        mean = {name: float(np.mean([each[name] for each in scores])) for name in candidates}
        best = max(mean, key=lambda name: mean[name])
        choice = best if mean[best] - mean[choice] > _CLEARLY_BETTER else choice
        compared = ", ".join(f"{name} {score:+.2f}" for name, score in mean.items())
        why = f"image edges at jumps of depth: {compared}"
    images = "rectified" if choice in cameras else "raw"
    note = f"camera: {images} images, by {choice} ({why}); --calib gives another"
    return candidates[choice], note


def _scores(
    scan: NDArray[np.floating],
    rgb: NDArray[np.float32],
    own: Calibration,
    candidates: Mapping[str, Calibration],
) -> dict[str, float] | None:
    """The score of each calibration; 0 of one that puts few of the jumps into the image.

    None where the points tell nothing.
    """
    # The jumps of depth are those that the own camera sees.
    assert own.scanner is not None
    size = (rgb.shape[0], rgb.shape[1])
    jumps = jumps_of(scan, own.camera, own.scanner, size)
    if jumps is None:
        return None
    edges = edge_map(rgb)
    shifted = edges.shifted(*jumps.projected(own.camera), (_CHANCE_PX, _CHANCE_PX))
    chance = float(shifted.mean())
    spread = float(shifted.std()) + 1e-9
    # The others project them anew.
    scores = dict.fromkeys(candidates, 0.0)
    for name, candidate in candidates.items():
        assert candidate.scanner is not None
        motion = candidate.scanner @ own.scanner.inverse()
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
    for number in range(_CAMERAS) if options.extrinsics is None else ():
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
