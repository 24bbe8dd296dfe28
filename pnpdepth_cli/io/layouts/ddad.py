"""`ddad`: DDAD, scenes of <scene>/ with scene_*.json, calibration/, rgb/CAMERA_*/ and point_cloud/.

One frame for each camera of each sample, with the LiDAR scan of the same sample. The structure is
that of the TRI Dataset Governance Policy: a pose is that of the sensor in the world at its own
time, so the scan is moved to the image's time. Images are those of pinhole cameras.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched
from pnpdepth_cli.io.extrinsics import Extrinsics, inverse, pose_of_quaternion
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts import Layout

_LIDAR = "LIDAR"
_CAMERA = "CAMERA_"
Row = dict[str, Any]


def matches(root: Path) -> bool:
    """Returns whether this is a scene, or a folder of scenes."""
    return bool(_scenes(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each camera of each sample, scene by scene.

    Raises:
        FileFormatError: A scene or a calibration is damaged, or lacks an entry that another names.
    """
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    for path in _scenes(root):
        try:
            for frame in _of_scene(path):
                (frames if isinstance(frame, Frame) else broken).append(frame)  # type: ignore[arg-type]
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise FileFormatError(
                f"{path} is incomplete or of another kind ({type(error).__name__}:"
                f" {one_line(error)}); download it again"
            ) from error
    return Listing(frames=frames, broken=tuple(broken))


def _scenes(root: Path) -> list[Path]:
    """The file of each scene, the first of several of one folder."""
    files = sorted((*root.glob("scene_*.json"), *root.glob("*/scene_*.json")))
    first = {path.parent: path for path in reversed(files)}
    return [first[folder] for folder in sorted(first) if (folder / "calibration").is_dir()]


def _of_scene(path: Path) -> Iterator[Frame | Unmatched]:
    """The frames of a scene, camera by camera in the order of time, and images without a scan."""
    folder, content = path.parent, _json(path)
    datums = {row["key"]: row for row in content["data"]}
    calibrations: dict[str, Row] = {}
    by_camera: dict[str, list[Frame | Unmatched]] = {}
    for sample in content["samples"]:
        key = sample["calibration_key"]
        if key not in calibrations:
            calibrations[key] = _json(folder / "calibration" / f"{key}.json")
        rows = {datums[k]["id"]["name"].upper(): datums[k]["datum"] for k in sample["datum_keys"]}
        for name in sorted(each for each in rows if each.startswith(_CAMERA)):
            frame = _frame(folder, name, rows, calibrations[key])
            by_camera.setdefault(name, []).append(frame)
    for name in sorted(by_camera):
        yield from by_camera[name]


def _frame(folder: Path, name: str, rows: dict[str, Row], calibration: Row) -> Frame | Unmatched:
    image = rows[name]["image"]
    path = folder / image["filename"]
    scan = rows.get(_LIDAR, {}).get("point_cloud")
    if scan is None or not path.is_file() or not (folder / scan["filename"]).is_file():
        return Unmatched(path=path, why="or its LiDAR scan does not exist; add it")
    camera = _pose(path, image["pose"])
    return Frame(
        name=f"{folder.name}/{name}_{path.stem}",
        image=path,
        sparse=folder / scan["filename"],
        calibration=_calibration(
            folder, name, image, calibration, (camera, _pose(path, scan["pose"]))
        ),
        pose=tuple(map(tuple, np.column_stack(camera).tolist())),
        group=f"{folder.name}/{name}",
    )


def _calibration(
    folder: Path, name: str, image: Row, calibration: Row, poses: tuple[Extrinsics, Extrinsics]
) -> Calibration:
    """The camera, and the pose of the scan in it, of (camera, scanner) in the world."""
    number = [each.upper() for each in calibration["names"]].index(name)
    values = {key: float(value) for key, value in calibration["intrinsics"][number].items()}
    others = values.keys() - {"fx", "fy", "cx", "cy"}
    known = np.isfinite(list(values.values())).all() and min(values["fx"], values["fy"]) > 0
    if not known or any(values[key] for key in others):
        raise ValueError(f"{name} of {folder.name} is no pinhole camera")
    (turn, shift), (scanner_turn, scanner_shift) = inverse(poses[0]), poses[1]
    return Calibration(
        intrinsics=np.array(
            [[values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1]]
        ),
        rotation=turn @ scanner_turn,
        translation=turn @ scanner_shift + shift,
        distortion=(),
        size=(int(image["height"]), int(image["width"])),
        has_pose=True,
        source="DDAD scene",
    )


def _pose(path: Path, row: Row) -> Extrinsics:
    """x_world = R · x_sensor + t; numbers that are 0 may be missing."""
    shift, turn = row.get("translation", {}), row.get("rotation", {})
    return pose_of_quaternion(
        path,
        [float(shift.get(axis, 0)) for axis in "xyz"],
        [float(turn.get(f"q{axis}", 0)) for axis in "xyzw"],
    )


def _json(path: Path) -> Row:
    try:
        content = json.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path} is not valid JSON ({one_line(error)})") from error
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} holds no JSON object; download it again")
    return content


LAYOUT = Layout(
    matches=matches, listing=listing, needs=("*/scene_*.json", "*/calibration", "*/point_cloud")
)
