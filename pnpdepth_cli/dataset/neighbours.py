"""The points of neighbouring frames: read, with the motion to each, and added to a frame's own."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pnpdepth_cli.camera import Camera, Floats
from pnpdepth_cli.dataset.arrays import read_image, record_of
from pnpdepth_cli.dataset.frame_files import FrameFiles, ImageSource, file_of
from pnpdepth_cli.errors import InputError, NoPointsError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.file_bytes import fingerprint
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors import accumulation
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.projection import Points

_CONTRADICTION = 0.0075
"""Fraction of the image's width by which contradicting poses move points off what images show. On a
KITTI drive the inertial system is off by 0.0006 to 0.0021, poses of another drive by 0.010 to
0.027."""


def read_neighbours(
    files: FrameFiles,
    used: SparsePoints,
    camera: Camera | None,
    points_of: Callable[[FrameFiles], Points],
) -> tuple[SparsePoints, list[FileRecord], list[str]]:
    """Returns the points with those of the neighbours that agree with them.

    A neighbour is left out if its motion is unknown and cannot be estimated. A known motion to the
    frame before, or after, is compared with the motion that the images show.

    Args:
        files: Files of the frame.
        used: Points of the frame without the held-out ones; scans are registered to them.
        camera: Camera of the frame.
        points_of: Function of a frame's files that returns their points.

    Returns:
        The points, what a record keeps of each neighbour, and warnings.

    Raises:
        InputError: The camera is unknown, a file cannot be read, or no motion is known.
    """
    if not files.neighbours:
        return used, [], []
    if camera is None:
        raise InputError(
            f"{_name_of(files)}: moving points to other frames needs the camera; give --calib, or a"
            " column calib in a list"
        )
    own = Points(xy=used.xy.numpy(), depth=used.depth.numpy(), size=used.size)
    scans, records, notes = dict[int, list[accumulation.Scan]](), list[FileRecord](), list[str]()
    basis, estimated = "", list[str]()
    for each in files.neighbours:
        # The neighbour's points, and the motion that the images show where it is of use.
        source = each.files.sparse or each.files.gt
        assert source is not None
        try:
            points = points_of(each.files)
        except NoPointsError as error:
            notes.append(f"warning: a neighbour adds no points: {error}")
            records.append(record_of(source, kind="neighbour"))
            continue
        here, there, shown, basis = files.image, each.files.image, None, ""
        is_nearest = each.apart == 1 and 1 not in scans
        if here is not None and there is not None and (each.motion is None or is_nearest):
            seen = _keypoints_of(here, files.part), _keypoints_of(there, each.files.part)
            shown, basis = accumulation.motion_of_images(*seen, points, camera)
        # Its motion is that, or of poses, which must not contradict the images.
        motion, poses, off_px = shown, f"{each.poses}: {basis}", 0.0
        if each.motion is None and motion is not None:
            estimated.append(f"{_name_of(each.files)} ({basis})")
        if each.motion is not None:
            motion, poses = np.array(each.motion), each.poses
            off_px = 0.0 if shown is None else _distance_px(motion, shown, points, camera)
        off = not off_px <= _CONTRADICTION * points.size[1]
        if off:
            moved = f"puts points {off_px:.0f} px elsewhere"
            if not math.isfinite(off_px):
                moved = "puts points in view that the poses put behind the camera"
            notes.append(
                f"warning: the poses contradict the images: the motion from {_name_of(each.files)}"
                f" on, by {basis}, {moved}; give poses of these frames, or none"
            )
        # A neighbour of known motion joins.
        if motion is None:
            notes.append(
                f"warning: {_name_of(each.files)} is left out of the accumulated points, as its"
                f" motion is unknown: {basis}"
            )
        else:
            scans.setdefault(each.apart, []).append((points, motion))
        record = replace(
            record_of(source, kind="neighbour"),
            poses=poses,
            motion=None if motion is None else motion.tolist(),
            contradicts_images=off,
        )
        records.append(record)
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
    return accumulation.accumulate(own, scans, camera).tensors(), records, notes


def _distance_px(one: Floats, other: Floats, points: Points, camera: Camera) -> float:
    """The median distance in the image between where two motions put points.

    It is infinite where no point is in front of the camera by both motions.
    """
    xyz = unproject(camera, points.xy, points.depth)
    moved = [xyz @ motion[:, :3].T + motion[:, 3] for motion in (one, other)]
    seen = (moved[0][:, 2] > 0) & (moved[1][:, 2] > 0)
    if not seen.any():
        return math.inf
    pixels = [pixels_of(camera, each[seen]) for each in moved]
    return float(np.median(np.linalg.norm(pixels[0] - pixels[1], axis=1)))


def _keypoints_of(image: ImageSource, part: FramePart) -> accumulation.Keypoints:
    return _keypoints(image, part, fingerprint(file_of(image)).sha256)


@functools.lru_cache(maxsize=16)  # images
def _keypoints(image: ImageSource, part: FramePart, digest: str) -> accumulation.Keypoints:
    """The keypoints of an image whose file has this digest."""
    return accumulation.keypoints_of(np.ascontiguousarray(part.apply(read_image(image))))


def _name_of(files: FrameFiles) -> str:
    return str(files.sparse or files.image or files.gt)
