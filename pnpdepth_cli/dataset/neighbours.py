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
    """(3, 4) x_frame = matrix · (x_neighbour, 1), in the unit of the points. None: it is not known,
    and cannot be estimated."""
    source: str
    """Where it is from, for a person."""
    basis: str
    """What the images were compared by, or why no motion follows from them."""
    off_px: float = 0.0
    """Median distance in the image between what poses and images say; infinite where the poses put
    all points behind the camera. 0 where the two are not compared."""


class _ReadNeighbour(NamedTuple):
    """A neighbour as it was read."""

    record: FileRecord
    """What a record keeps of it."""
    notes: list[str]
    """Lines for a person."""
    points: Points | None
    """Points in its own image. None: it has none."""
    motion: _Motion | None
    """The motion from its camera to the frame's. None without points."""


def read_neighbours(
    files: FrameFiles,
    used: SparsePoints,
    camera: Camera | None,
    points_of: Callable[[FrameFiles], Points],
) -> WithNeighbours:
    """Returns the points of a frame, with those of its neighbours that agree with them.

    A neighbour is left out if its motion is unknown and cannot be estimated. A known motion to the
    frame before, or after, is compared with the motion that the images show.

    Args:
        files: Files of the frame, which name those of its neighbours.
        used: Points of the frame without the held-out ones; neighbours are registered to them.
        camera: Camera of the frame and of all neighbours. None: unknown.
        points_of: Function of a neighbour's files that returns its points.

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
    # Each neighbour, whose points join if their motion is known.
    scans = dict[int, list[accumulation.Scan]]()  # by the number of frames between the two
    records = list[FileRecord]()
    notes = list[str]()
    estimated = list[str]()
    basis = ""
    for neighbour in files.neighbours:
        is_nearest = neighbour.apart == 1 and 1 not in scans
        read = _read_neighbour(neighbour, files, camera, points_of, is_compared=is_nearest)
        records.append(read.record)
        notes += read.notes
        if read.points is None or read.motion is None:
            continue
        basis = read.motion.basis
        if read.motion.matrix is None:
            continue
        scans.setdefault(neighbour.apart, []).append((read.points, read.motion.matrix))
        if neighbour.motion is None:
            estimated.append(f"{_name_of(neighbour.files)} ({basis})")
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


def _read_neighbour(
    neighbour: Neighbour,
    files: FrameFiles,
    camera: Camera,
    points_of: Callable[[FrameFiles], Points],
    *,
    is_compared: bool,
) -> _ReadNeighbour:
    """A neighbour's points and its motion, with what a record and a person should know of them.

    Args:
        neighbour: The neighbour.
        files: Files of the frame.
        camera: Camera of both.
        points_of: Function of a neighbour's files that returns its points.
        is_compared: Whether the motion of poses is compared with that of the images.
    """
    record = record_of(_source_of(neighbour.files), kind="neighbour")
    try:
        points = points_of(neighbour.files)
    except NoPointsError as error:
        notes = [f"warning: a neighbour adds no points: {error}"]
        return _ReadNeighbour(record, notes, None, None)
    # Its motion, which must not contradict the images.
    motion = _motion_from(neighbour, files, points, camera, is_compared=is_compared)
    notes = list[str]()
    is_off = not motion.off_px <= _CONTRADICTION * points.size[1]  # so is NaN
    if is_off:
        notes.append(_contradiction_warning(neighbour, motion))
    if motion.matrix is None:
        notes.append(
            f"warning: {_name_of(neighbour.files)} is left out of the accumulated points, as"
            f" its motion is unknown: {motion.basis}"
        )
    record = replace(
        record,
        poses=motion.source,
        motion=None if motion.matrix is None else motion.matrix.tolist(),
        contradicts_images=is_off,
    )
    return _ReadNeighbour(record, notes, points, motion)


def _motion_from(
    neighbour: Neighbour, files: FrameFiles, points: Points, camera: Camera, *, is_compared: bool
) -> _Motion:
    """The motion from a neighbour's camera to the frame's: of poses, else of the images.

    Args:
        neighbour: The neighbour, with its motion if poses say it.
        files: Files of the frame.
        points: Points of the neighbour, in its own image.
        camera: Camera of both.
        is_compared: Whether the motion of poses is compared with that of the images.
    """
    # The motion that the images show, where it is of use.
    here = files.image
    there = neighbour.files.image
    of_images = None
    basis = ""
    if here is not None and there is not None and (neighbour.motion is None or is_compared):
        keypoints_here = _keypoints_of(here, files.part)
        keypoints_there = _keypoints_of(there, neighbour.files.part)
        of_images, basis = accumulation.motion_of_images(
            keypoints_here, keypoints_there, points, camera
        )
    if neighbour.motion is None:
        return _Motion(of_images, f"{neighbour.poses}: {basis}", basis)
    # The motion that poses say, and how far it is from the other one.
    of_poses = np.array(neighbour.motion)
    off_px = 0.0
    if of_images is not None:
        off_px = _distance_px(of_poses, of_images, points, camera)
    return _Motion(of_poses, neighbour.poses, basis, off_px)


def _contradiction_warning(neighbour: Neighbour, motion: _Motion) -> str:
    """A line on a neighbour whose poses say another motion than the images.

    Args:
        neighbour: The neighbour.
        motion: Its motion, with the distance between what poses and images say.
    """
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

    Args:
        first: (3, 4) from the points' camera to the other one.
        second: Another such motion.
        points: Points in the image of their camera.
        camera: Camera of both images.
    """
    xyz = unproject(camera, points.xy, points.depth)
    by_first = xyz @ first[:, :3].T + first[:, 3]
    by_second = xyz @ second[:, :3].T + second[:, 3]
    is_seen = (by_first[:, 2] > 0) & (by_second[:, 2] > 0)
    if not is_seen.any():
        return math.inf
    between = pixels_of(camera, by_first[is_seen]) - pixels_of(camera, by_second[is_seen])
    return float(np.median(np.linalg.norm(between, axis=1)))


def _keypoints_of(image: ImageSource, part: FramePart) -> accumulation.Keypoints:
    """The keypoints of a part of an image; those of the last images are kept."""
    return _keypoints(image, part, fingerprint(file_of(image)).sha256)


@functools.lru_cache(maxsize=_IMAGES_KEPT)
def _keypoints(image: ImageSource, part: FramePart, digest: str) -> accumulation.Keypoints:
    """The keypoints of a part of an image. The digest of its file tells when they change."""
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
