"""The points of neighbouring frames: read, with the motion to each, and added to a frame's own."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pnpdepth_cli.camera import Camera, Floats
from pnpdepth_cli.dataset.arrays import read_image, record_of
from pnpdepth_cli.dataset.frame_files import FrameFiles, ImageSource, Neighbour, file_of
from pnpdepth_cli.errors import InputError, NoPointsError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors import accumulation
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.projection import Points

_IMAGES_KEPT = 16
"""Images whose keypoints are kept, as each is a neighbour of several frames."""
_CONTRADICTION = 0.0075
"""Fraction of the image's width by which contradicting poses move points off what images show. On a
KITTI drive the inertial system is off by 0.0006 to 0.0021, poses of another drive by 0.010 to
0.027."""


class WithNeighbours(NamedTuple):
    """The points of a frame, with those of its neighbours."""

    points: SparsePoints
    records: list[FileRecord]
    """What a record keeps of each neighbour."""
    notes: list[str]
    """Lines for a person."""


class _Motion(NamedTuple):
    """The motion from a neighbour's camera to the frame's, and what the images say of it."""

    matrix: Floats | None
    """(3, 4). None: it is not known, and cannot be estimated."""
    source: str
    """Where it is from, for a person."""
    basis: str
    """What the images were compared by, or why no motion follows from them."""
    off_px: float = 0.0
    """Median distance in the image between what poses and images say; infinite where the poses put
    all points behind the camera."""


def read_neighbours(
    files: FrameFiles,
    used: SparsePoints,
    camera: Camera | None,
    points_of: Callable[[FrameFiles], Points],
) -> WithNeighbours:
    """Returns the points with those of the neighbours that agree with them.

    A neighbour is left out if its motion is unknown and cannot be estimated. A known motion to the
    frame before, or after, is compared with the motion that the images show.

    Args:
        files: Files of the frame.
        used: Points of the frame without the held-out ones; scans are registered to them.
        camera: Camera of the frame.
        points_of: Function of a frame's files that returns their points.

    Raises:
        InputError: The camera is unknown, a file cannot be read, or no motion is known.
    """
    if not files.neighbours:
        return WithNeighbours(used, [], [])
    if camera is None:
        raise InputError(
            f"{_name_of(files)}: moving points to other frames needs the camera; give --calib, or a"
            " column calib in a list"
        )
    scans = dict[int, list[accumulation.Scan]]()
    records = list[FileRecord]()
    notes = list[str]()
    estimated = list[str]()
    basis = ""
    for neighbour in files.neighbours:
        record = record_of(_source_of(neighbour.files), kind="neighbour")
        # The neighbour's points.
        try:
            points = points_of(neighbour.files)
        except NoPointsError as error:
            notes.append(f"warning: a neighbour adds no points: {error}")
            records.append(record)
            continue
        # Its motion, which must not contradict the images.
        is_nearest = neighbour.apart == 1 and 1 not in scans
        motion = _motion_from(neighbour, files, points, camera, is_compared=is_nearest)
        basis = motion.basis
        is_off = not motion.off_px <= _CONTRADICTION * points.size[1]
        if is_off:
            notes.append(_contradiction_warning(neighbour, motion))
        if neighbour.motion is None and motion.matrix is not None:
            estimated.append(f"{_name_of(neighbour.files)} ({basis})")
        # A neighbour of known motion joins.
        if motion.matrix is None:
            notes.append(
                f"warning: {_name_of(neighbour.files)} is left out of the accumulated points, as"
                f" its motion is unknown: {basis}"
            )
        else:
            scans.setdefault(neighbour.apart, []).append((points, motion.matrix))
        records.append(
            replace(
                record,
                poses=motion.source,
                motion=None if motion.matrix is None else motion.matrix.tolist(),
                contradicts_images=is_off,
            )
        )
    # At least one of those with points must join.
    if not scans and basis:
        raise InputError(
            f"{_name_of(files)}: no motion to a neighbour can be estimated ({basis}); give"
            " --poses, or leave out --accumulate"
        )
    if estimated:
        notes.append(
            "note: the motion of accumulated points is estimated from the images, from"
            f" {' and '.join(estimated)}; --poses gives a known one"
        )
    points_of_frame = Points(xy=used.xy.numpy(), depth=used.depth.numpy(), size=used.size)
    joined = accumulation.accumulate(points_of_frame, scans, camera)
    return WithNeighbours(joined.tensors(), records, notes)


def _motion_from(
    neighbour: Neighbour, files: FrameFiles, points: Points, camera: Camera, *, is_compared: bool
) -> _Motion:
    """The motion from a neighbour: of poses, else the one that the images show.

    Args:
        neighbour: The neighbour.
        files: Files of the frame.
        points: Points of the neighbour.
        camera: Camera of both.
        is_compared: Whether the motion of poses is compared with that of the images.
    """
    # What the images show, where it is of use.
    here = files.image
    there = neighbour.files.image
    shown = None
    basis = ""
    if here is not None and there is not None and (neighbour.motion is None or is_compared):
        keypoints = _keypoints_of(here, files.part)
        keypoints_there = _keypoints_of(there, neighbour.files.part)
        shown, basis = accumulation.motion_of_images(keypoints, keypoints_there, points, camera)
    if neighbour.motion is None:
        return _Motion(shown, f"{neighbour.poses}: {basis}", basis)
    # What the poses say, and how far it is from that.
    motion = np.array(neighbour.motion)
    off_px = 0.0
    if shown is not None:
        off_px = _distance_px(motion, shown, points, camera)
    return _Motion(motion, neighbour.poses, basis, off_px)


def _contradiction_warning(neighbour: Neighbour, motion: _Motion) -> str:
    """A line on a neighbour whose poses say another motion than the images."""
    moved = f"puts points {motion.off_px:.0f} px elsewhere"
    if not math.isfinite(motion.off_px):
        moved = "puts points in view that the poses put behind the camera"
    return (
        f"warning: the poses contradict the images: the motion from {_name_of(neighbour.files)}"
        f" on, by {motion.basis}, {moved}; give poses of these frames, or none"
    )


def _distance_px(first: Floats, second: Floats, points: Points, camera: Camera) -> float:
    """The median distance in the image between where two motions put points.

    It is infinite where no point is in front of the camera by both motions.
    """
    xyz = unproject(camera, points.xy, points.depth)
    moved = [xyz @ motion[:, :3].T + motion[:, 3] for motion in (first, second)]
    seen = (moved[0][:, 2] > 0) & (moved[1][:, 2] > 0)
    if not seen.any():
        return math.inf
    pixels = [pixels_of(camera, coordinates[seen]) for coordinates in moved]
    return float(np.median(np.linalg.norm(pixels[0] - pixels[1], axis=1)))


def _keypoints_of(image: ImageSource, part: FramePart) -> accumulation.Keypoints:
    """The keypoints of a part of an image; those of the last images are kept."""
    return _keypoints(image, part, fingerprint(file_of(image)).sha256)


@functools.lru_cache(maxsize=_IMAGES_KEPT)
def _keypoints(image: ImageSource, part: FramePart, digest: str) -> accumulation.Keypoints:
    """The keypoints of an image whose file has this digest."""
    return accumulation.keypoints_of(np.ascontiguousarray(part.apply(read_image(image))))


def _source_of(files: FrameFiles) -> Path:
    """The file of a frame's points: sparse depth, else the ground truth they are sampled from."""
    source = files.sparse or files.gt
    if source is None:
        raise InputError(f"{files.image} has neither sparse depth nor ground truth; add one")
    return source


def _name_of(files: FrameFiles) -> str:
    """What a person calls a frame: one of its files."""
    return str(files.sparse or files.image or files.gt)
