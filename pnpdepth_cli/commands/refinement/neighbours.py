"""The points of neighbouring frames: read, with the motion to each, and added to a frame's own."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pnpdepth_cli.commands.refinement.frame_camera import FrameCamera
from pnpdepth_cli.commands.refinement.request import FrameFiles
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.dataset import Frame, Protocol, Source, file_of
from pnpdepth_cli.io.dataset.reading import read_frame_image
from pnpdepth_cli.io.fingerprint import fingerprint
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors import Camera, NeighbourScan, Points, accumulated
from pnpdepth_cli.sensors.motion import (
    Keypoints,
    MotionEstimate,
    keypoints_of,
    motion_of_images,
    motion_of_scans,
)

_IN_MEMORY = 16
"""Images whose keypoints are kept."""


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """What a frame takes over from the other frames of its sequence."""

    scans: tuple[NeighbourScan, ...] = ()
    """Their points, each in its own image."""
    record: tuple[dict[str, Any], ...] = ()
    """What a record keeps of them."""
    notes: tuple[str, ...] = ()
    """Warnings of those that are left out."""


def read_neighbours(
    files: FrameFiles,
    used: SparsePoints,
    camera: FrameCamera | None,
    points_of: Callable[[FrameFiles], SparsePoints],
) -> Neighbours:
    """Returns the points of the frame's neighbours, with the motion from each to the frame.

    A neighbour whose motion is neither known nor can be estimated is left out.

    Args:
        files: Of the frame.
        used: Its points without those that are held out; scans are registered to them.
        camera: Of the frame.
        points_of: Returns the points of a frame's files.

    Raises:
        InputError: The camera is unknown, a file cannot be read, or no motion is known.
        UsageError: A library that estimates motion is missing.
    """
    if not files.neighbours:
        return Neighbours()
    if camera is None:
        raise InputError(
            f"{_name_of(files)}: moving points to other frames needs the camera; give --calib, or a"
            " column calib in a list"
        )
    scans, record, notes = [], [], []
    for each in files.neighbours:
        points, entry = _in_numpy(points_of(each.files)), _record_of(each.files)
        known = each.motion
        estimate = MotionEstimate(
            motion=None if known is None else np.array(known), basis=each.poses
        )
        if known is None:
            estimate = _estimated(files, each.files, _in_numpy(used), points, camera.camera)
        entry |= {"poses": each.poses, "basis": estimate.basis if known is None else None}
        if estimate.motion is None:
            notes.append(
                f"warning: {_name_of(each.files)} is left out of the accumulated points, as its"
                f" motion is unknown: {estimate.basis}"
            )
        else:
            scans.append(NeighbourScan(points=points, motion=estimate.motion, apart=each.apart))
            entry["motion"] = estimate.motion.tolist()
        record.append(entry)
    if not scans:
        raise InputError(
            f"{_name_of(files)}: no motion to a neighbour can be estimated ({estimate.basis}); give"
            " --poses, or leave out --accumulate"
        )
    return Neighbours(scans=tuple(scans), record=tuple(record), notes=tuple(notes))


def with_moved_points(
    points: SparsePoints, neighbours: Sequence[NeighbourScan], camera: Camera
) -> SparsePoints:
    """Returns the points, and those of the neighbours that agree with them."""
    return accumulated(_in_numpy(points), neighbours, camera).tensors()


def _estimated(
    here: FrameFiles, there: FrameFiles, used: Points, points: Points, camera: Camera
) -> MotionEstimate:
    if here.image is None or there.image is None:
        return motion_of_scans(used, points, camera)
    keypoints = _keypoints(here.image, here.protocol), _keypoints(there.image, there.protocol)
    return motion_of_images(*keypoints, points, camera)


def _keypoints(image: Source, protocol: Protocol) -> Keypoints:
    digest = fingerprint(file_of(image)).sha256
    return _keypoints_of_content(image, protocol, digest)


@functools.lru_cache(maxsize=_IN_MEMORY)
def _keypoints_of_content(image: Source, protocol: Protocol, digest: str) -> Keypoints:
    """The keypoints of an image whose file has this digest."""
    return keypoints_of(read_frame_image(Frame(name=str(image), image=image, protocol=protocol)))


def _record_of(files: FrameFiles) -> dict[str, Any]:
    source = files.sparse or files.gt
    assert source is not None
    return {"path": str(source), "sha256": fingerprint(file_of(source)).sha256}


def _name_of(files: FrameFiles) -> str:
    return str(files.sparse or files.image or files.gt)


def _in_numpy(points: SparsePoints) -> Points:
    return Points(xy=points.xy.numpy(), depth=points.depth.numpy(), size=points.size)
