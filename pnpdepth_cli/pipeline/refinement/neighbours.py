"""The points of neighbouring frames: read, and added to a frame's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.pipeline.refinement.frame_camera import FrameCamera
from pnpdepth_cli.pipeline.refinement.request import FrameFiles
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors import Camera, NeighbourScan, Points, accumulated


def read_neighbours(
    files: FrameFiles, camera: FrameCamera | None, read: Callable[[Path], SparsePoints]
) -> tuple[NeighbourScan, ...]:
    """Returns the points of the frame's neighbours, each in its own image.

    Args:
        files: Of the frame.
        camera: Of the frame.
        read: Returns the points of one file.

    Raises:
        InputError: The camera is unknown, or a file cannot be read.
    """
    if files.neighbours and camera is None:
        raise InputError(
            f"{files.sparse}: moving points to other frames needs the camera; give --calib, or a"
            " column calib in a list"
        )
    return tuple(
        NeighbourScan(
            points=_in_numpy(read(each.sparse)), motion=np.array(each.motion), apart=each.apart
        )
        for each in files.neighbours
    )


def with_moved_points(
    points: SparsePoints, neighbours: Sequence[NeighbourScan], camera: Camera
) -> SparsePoints:
    """Returns the points, and those of the neighbours that agree with them."""
    return accumulated(_in_numpy(points), neighbours, camera).tensors()


def record_of_neighbours(files: FrameFiles) -> list[dict[str, Any]]:
    """Returns what a record keeps of the neighbours."""
    return [
        {"path": str(each.sparse), "sha256": sha256_of(each.sparse), "motion": each.motion}
        for each in files.neighbours
    ]


def _in_numpy(points: SparsePoints) -> Points:
    return Points(xy=points.xy.numpy(), depth=points.depth.numpy(), size=points.size)
