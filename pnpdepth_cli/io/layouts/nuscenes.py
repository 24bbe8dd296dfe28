"""`nuscenes`: nuScenes, v1.0-*/ with its tables, and samples/ with cameras and LIDAR_TOP.

One frame for each camera of each key frame, with the LiDAR scan of the same sample. The pose of the
scan is that of the car at the scan's time, moved to the image's time by the poses of the car. The
tables are read whole: those of the complete data set need memory and --max-pixels.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched
from pnpdepth_cli.io.extrinsics import Extrinsics, inverse, pose_of_quaternion
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts import Layout

_TABLES = ("sample_data", "calibrated_sensor", "ego_pose", "sensor", "sample", "scene")
_LIDAR = "LIDAR_TOP"
Row = dict[str, Any]


def matches(root: Path) -> bool:
    """Returns whether there are the tables of one version and samples/."""
    return (root / "samples").is_dir() and _version(root) is not None


def listing(root: Path) -> Listing:
    """Returns one frame for each camera image of a key frame.

    Raises:
        FileFormatError: A table is damaged, or lacks an entry that another names.
    """
    version = _version(root)
    assert version is not None
    try:
        return _listing(root, {name: _table(version / f"{name}.json") for name in _TABLES})
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise FileFormatError(
            f"{version}: the tables are incomplete or of another kind ({type(error).__name__}:"
            f" {one_line(error)}); download them again"
        ) from error


def _listing(root: Path, tables: dict[str, dict[str, Row]]) -> Listing:
    channels: dict[str, dict[str, Row]] = {}
    for row in tables["sample_data"].values():
        if row["is_key_frame"]:
            sensor = tables["calibrated_sensor"][row["calibrated_sensor_token"]]["sensor_token"]
            channel = tables["sensor"][sensor]["channel"]
            channels.setdefault(row["sample_token"], {})[channel] = row
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    for sample, rows in channels.items():
        scan = rows.get(_LIDAR)
        scene = tables["scene"][tables["sample"][sample]["scene_token"]]["name"]
        for channel in sorted(name for name in rows if name.startswith("CAM_")):
            image = root / rows[channel]["filename"]
            if scan is None or not image.is_file() or not (root / scan["filename"]).is_file():
                broken.append(Unmatched(path=image, why="or its LiDAR scan does not exist; add it"))
                continue
            frames.append(
                Frame(
                    name=f"{scene}/{image.stem}",
                    image=image,
                    sparse=root / scan["filename"],
                    calibration=_calibration(root, tables, rows[channel], scan),
                    group=f"{scene}/{channel}",
                )
            )
    frames.sort(key=lambda frame: frame.name)
    return Listing(frames=frames, broken=tuple(broken))


def _calibration(
    root: Path, tables: dict[str, dict[str, Row]], image: Row, scan: Row
) -> Calibration:
    """The camera, and the pose of the scan in it by way of the car's poses at both times."""
    camera = tables["calibrated_sensor"][image["calibrated_sensor_token"]]
    scanner = tables["calibrated_sensor"][scan["calibrated_sensor_token"]]
    chain = [
        inverse(_pose(root, camera)),
        inverse(_pose(root, tables["ego_pose"][image["ego_pose_token"]])),
        _pose(root, tables["ego_pose"][scan["ego_pose_token"]]),
        _pose(root, scanner),
    ]
    rotation, translation = np.eye(3), np.zeros(3)
    for turn, shift in chain:
        translation = rotation @ shift + translation
        rotation = rotation @ turn
    return Calibration(
        intrinsics=np.array(camera["camera_intrinsic"], np.float64).reshape(3, 3),
        rotation=rotation,
        translation=translation,
        distortion=(),
        size=(int(image["height"]), int(image["width"])),
        has_pose=True,
        source="nuScenes tables",
    )


def _pose(root: Path, row: Row) -> Extrinsics:
    """x_parent = R · x + t; nuScenes writes quaternions w x y z."""
    w, x, y, z = (float(value) for value in row["rotation"])
    return pose_of_quaternion(root, [float(v) for v in row["translation"]], [x, y, z, w])


def _version(root: Path) -> Path | None:
    """The folder of tables, the first of several."""
    folders = sorted(p.parent for p in root.glob("v1.0-*/sample_data.json"))
    return folders[0] if folders else None


def _table(path: Path) -> dict[str, Row]:
    try:
        rows = json.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path} is not valid JSON ({one_line(error)})") from error
    return {row["token"]: row for row in rows}


LAYOUT = Layout(matches=matches, listing=listing, needs=("v1.0-*/sample_data.json", "samples"))
