"""Recordings of phones with a LiDAR, whose depth is of the image's view but smaller.

`stray-scanner`: the folder of the app Stray Scanner: rgb.mp4, depth/ in millimetres, confidence/
(0 to 2), camera_matrix.csv, and odometry.csv with a row of time, frame, position and quaternion for
each frame, in axes x right, y down, z forward.
`record3d`: the folder EXR_RGBD of Record3D's export "EXR + RGB": rgb/, depth/ in metres, and
metadata.json with K and w, h of the images and a row of quaternion and position for each frame, in
ARKit's axes x right, y up, z backwards.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.dataset.frame_files import Pose, as_pose
from pnpdepth_cli.dataset.layouts.layout import Files, row
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.extrinsics import rotation_of
from pnpdepth_cli.io.file_bytes import read_bytes
from pnpdepth_cli.io.text_files import read_json

_ODOMETRY, _METADATA = "odometry.csv", "metadata.json"


def _of_stray_scanner(place: Path) -> Callable[[Files], Mapping[str, Any]]:
    path, poses = place / _ODOMETRY, dict[int, Pose]()
    lines = read_bytes(path).decode("utf-8", "replace").splitlines()
    for number, line in enumerate(lines[1:], start=2):
        try:
            _, frame, *values = map(float, line.split(",")[:9])
            poses[int(frame)] = _pose(values[:3], values[3:])
        except (ValueError, OverflowError):
            raise FileFormatError(
                f"{path}, line {number}: not timestamp, frame, x, y, z, qx, qy, qz, qw"
            ) from None
    return lambda files: {"pose": poses.get(int(files["sparse"].stem))}


def _of_record3d(place: Path) -> Callable[[Files], Mapping[str, Any]]:
    path = place / _METADATA
    try:
        rows = [[float(value) for value in row] for row in read_json(path).get("poses", [])]
        poses = [_pose(values[4:], values[:4], y_up=True) for values in rows]
    except (TypeError, ValueError):
        raise FileFormatError(f"{path}: poses are not rows of qx qy qz qw x y z") from None

    def fields_of(files: Files) -> Mapping[str, Any]:
        number = int(files["image"].stem)
        return {"pose": poses[number] if number < len(poses) else None}

    return fields_of


def _pose(position: list[float], xyzw: list[float], y_up: bool = False) -> Pose:
    """The pose with the axes x right, y down, z forward. ValueError for none."""
    x, y, z, w = xyzw
    turn = rotation_of(np.array([w, x, y, z]))
    pose = np.column_stack([turn * (1, -1, -1) if y_up else turn, position])
    if pose.shape != (3, 4) or not np.isfinite(pose).all():
        raise ValueError
    return as_pose(pose)


STRAY_SCANNER = row(
    {
        "sparse": r"depth/(\d+).DEPTH",
        "image": "rgb/*.IMAGE",
        "sparse_mask": r"confidence/(\d+).png?",
    },
    marks=("camera_matrix.csv", _ODOMETRY),
    name=lambda root, place, stem: stem,
    calib="camera_matrix.csv",
    more=_of_stray_scanner,
    sparse_scale=1000.0,
    one_view=True,
)
RECORD3D = row(
    {"image": r"rgb/(\d+).IMAGE", "sparse": r"depth/(\d+).exr"},
    marks=(_METADATA,),
    name=lambda root, place, stem: stem,
    calib=_METADATA,
    more=_of_record3d,
    one_view=True,
)
