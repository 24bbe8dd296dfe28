"""The points of neighbouring frames: read, with the motion to each, and added to a frame's own."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.arrays import read_image
from pnpdepth_cli.dataset.frame_files import FrameFiles, ImageSource, file_of
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.fingerprint import fingerprint
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors import NeighbourScan, Points, accumulated
from pnpdepth_cli.sensors.motion import Keypoints, MotionEstimate, keypoints_of, motion_of_images

_IN_MEMORY = 16
"""Images whose keypoints are kept."""


def read_neighbours(
    files: FrameFiles,
    used: SparsePoints,
    camera: Camera | None,
    points_of: Callable[[FrameFiles], SparsePoints],
) -> tuple[SparsePoints, list[dict[str, Any]], list[str]]:
    """Returns the points with those of the neighbours that agree with them.

    A neighbour whose motion is neither known nor can be estimated is left out.

    Args:
        files: Of the frame.
        used: Its points without those that are held out; scans are registered to them.
        camera: Of the frame.
        points_of: Returns the points of a frame's files.

    Returns:
        The points, what a record keeps of each neighbour, and warnings of those left out.

    Raises:
        InputError: The camera is unknown, a file cannot be read, or no motion is known.
        UsageError: A library that estimates motion is missing.
    """
    if not files.neighbours:
        return used, [], []
    if camera is None:
        raise InputError(
            f"{_name_of(files)}: moving points to other frames needs the camera; give --calib, or a"
            " column calib in a list"
        )
    own, scans, notes = _in_numpy(used), list[NeighbourScan](), list[str]()
    record: list[dict[str, Any]] = []
    for neighbour in files.neighbours:
        points, source = (
            _in_numpy(points_of(neighbour.files)),
            neighbour.files.sparse or neighbour.files.gt,
        )
        assert source is not None
        known = neighbour.motion
        if known is None:
            estimate = _estimated(files, neighbour.files, points, camera)
        else:
            estimate = MotionEstimate(motion=np.array(known), basis=neighbour.poses)
        entry: dict[str, Any] = {
            "path": str(source),
            "sha256": fingerprint(file_of(source)).sha256,
            "poses": neighbour.poses,
            "basis": estimate.basis if known is None else None,
        }
        if estimate.motion is None:
            notes.append(
                f"warning: {_name_of(neighbour.files)} is left out of the accumulated points, as"
                f" its motion is unknown: {estimate.basis}"
            )
        else:
            apart = neighbour.apart
            scans.append(NeighbourScan(points=points, motion=estimate.motion, apart=apart))
            entry["motion"] = estimate.motion.tolist()
        record.append(entry)
    if not scans:
        raise InputError(
            f"{_name_of(files)}: no motion to a neighbour can be estimated ({estimate.basis}); give"
            " --poses, or leave out --accumulate"
        )
    return accumulated(own, scans, camera).tensors(), record, notes


def _estimated(
    here: FrameFiles, there: FrameFiles, points: Points, camera: Camera
) -> MotionEstimate:
    assert here.image is not None
    assert there.image is not None
    return motion_of_images(
        _keypoints(here.image, here.part, fingerprint(file_of(here.image)).sha256),
        _keypoints(there.image, there.part, fingerprint(file_of(there.image)).sha256),
        points,
        camera,
    )


@functools.lru_cache(maxsize=_IN_MEMORY)
def _keypoints(image: ImageSource, part: FramePart, digest: str) -> Keypoints:
    """The keypoints of an image whose file has this digest."""
    return keypoints_of(np.ascontiguousarray(part.apply(read_image(image))))


def _name_of(files: FrameFiles) -> str:
    return str(files.sparse or files.image or files.gt)


def _in_numpy(points: SparsePoints) -> Points:
    return Points(xy=points.xy.numpy(), depth=points.depth.numpy(), size=points.size)
