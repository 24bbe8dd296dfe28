"""nuScenes and DDAD: a frame for each camera of each sample, with the sample's LiDAR scan.

Both have the pose of each sensor at its own time, so the scan is moved to the image's time.

`nuscenes`: v1.0-*/ with its tables, and samples/ with cameras and LIDAR_TOP. The tables are read
whole: those of the complete data set need memory and --max-pixels.

`ddad`: scenes of <scene>/ with scene_*.json, calibration/, rgb/CAMERA_*/ and point_cloud/, as the
TRI Dataset Governance Policy has them. Images are those of pinhole cameras.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.calibration import Calibration, Floats
from pnpdepth_cli.io.dataset import Frame, Unmatched, as_pose
from pnpdepth_cli.io.extrinsics import Extrinsics, chained, inverse, pose_of_quaternion
from pnpdepth_cli.io.file_bytes import check_pixel_count, one_line, read_bytes
from pnpdepth_cli.io.layouts.layout import Layout

_TABLES = ("sample_data", "calibrated_sensor", "ego_pose", "sensor", "sample", "scene")
_LARGEST_PX = 1e9
Row = dict[str, Any]


@contextmanager
def _as_our_errors(path: Path) -> Iterator[None]:
    """Turns what damaged tables raise into a FileFormatError."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise FileFormatError(
            f"{path} is incomplete or of another kind ({type(error).__name__}: {one_line(error)});"
            " download it again"
        ) from error


def _json(path: Path) -> Any:
    try:
        return json.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path} is not valid JSON ({one_line(error)})") from error


def _text(row: Row, key: str) -> str:
    """A name in a row. Raises TypeError for anything but text."""
    if not isinstance(row[key], str):
        raise TypeError(f"{key} is {one_line(json.dumps(row[key]))[:40]}, not a name")
    return str(row[key])


def _frame(
    image: Path,
    scan: Path | None,
    row: Row,
    intrinsics: Floats,
    motion: Extrinsics,
    source: str,
    **fields: Any,
) -> Frame | Unmatched:
    """The frame of an image of the size in `row`; the motion is from the scan to the camera."""
    if scan is None or not image.is_file() or not scan.is_file():
        return Unmatched(path=image, why="or its LiDAR scan does not exist; add it")
    if not (np.abs(intrinsics) < _LARGEST_PX).all() or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise ValueError("no pinhole camera")
    size = int(row["height"]), int(row["width"])
    check_pixel_count(image, size[1], size[0])
    calibration = Calibration(
        intrinsics=intrinsics,
        rotation=motion[0],
        translation=motion[1],
        distortion=(),
        size=size,
        has_pose=True,
        source=source,
    )
    return Frame(image=image, sparse=scan, calibration=calibration, **fields)


def _version(root: Path) -> Path | None:
    """The folder of nuScenes' tables, the first of several."""
    return min((p.parent for p in root.glob("v1.0-*/sample_data.json")), default=None)


def _of_nuscenes(root: Path) -> list[Frame | Unmatched]:
    """One frame for each camera image of a key frame."""
    version = _version(root)
    assert version is not None
    with _as_our_errors(version):
        tables = {
            name: {_text(row, "token"): row for row in _json(version / f"{name}.json")}
            for name in _TABLES
        }
        found = list(_of_tables(root, tables))
    return sorted(found, key=lambda each: each.name if isinstance(each, Frame) else "")


def _of_tables(root: Path, tables: dict[str, dict[str, Row]]) -> Iterator[Frame | Unmatched]:
    def in_parent(row: Row, table: str) -> Extrinsics:
        """x_parent = R · x + t; nuScenes writes quaternions w x y z."""
        pose = tables[table][row[f"{table}_token"]]
        w, x, y, z = (float(value) for value in pose["rotation"])
        return pose_of_quaternion(root, [float(v) for v in pose["translation"]], [x, y, z, w])

    samples: dict[str, dict[str, Row]] = {}
    for row in tables["sample_data"].values():
        if row["is_key_frame"]:
            sensor = tables["calibrated_sensor"][row["calibrated_sensor_token"]]["sensor_token"]
            channel = _text(tables["sensor"][sensor], "channel")
            samples.setdefault(row["sample_token"], {})[channel] = row
    for sample, rows in samples.items():
        scene = _text(tables["scene"][tables["sample"][sample]["scene_token"]], "name")
        scan = rows.get("LIDAR_TOP")
        for channel in sorted(name for name in rows if name.startswith("CAM_")):
            row, image = rows[channel], root / _text(rows[channel], "filename")
            camera = tables["calibrated_sensor"][row["calibrated_sensor_token"]]
            to_camera = [
                inverse(in_parent(row, table)) for table in ("calibrated_sensor", "ego_pose")
            ]
            of_scan = [in_parent(scan or row, table) for table in ("ego_pose", "calibrated_sensor")]
            yield _frame(
                image,
                None if scan is None else root / _text(scan, "filename"),
                row,
                np.array(camera["camera_intrinsic"], np.float64).reshape(3, 3),
                chained(*to_camera, *of_scan),
                "nuScenes tables",
                name=f"{scene}/{image.stem}",
                group=f"{scene}/{channel}",
            )


NUSCENES = Layout(
    matches=lambda root: (root / "samples").is_dir() and _version(root) is not None,
    frames=_of_nuscenes,
    needs=("v1.0-*/sample_data.json", "samples"),
)


def _scenes(root: Path) -> list[Path]:
    """The file of each scene of DDAD, the first of several of one folder."""
    files = sorted((*root.glob("scene_*.json"), *root.glob("*/scene_*.json")))
    first = {path.parent: path for path in reversed(files)}
    return [first[folder] for folder in sorted(first) if (folder / "calibration").is_dir()]


def _of_ddad(root: Path) -> Iterator[Frame | Unmatched]:
    """One frame for each camera of each sample, scene by scene and camera by camera."""
    for path in _scenes(root):
        with _as_our_errors(path):
            found = list(_of_scene(path))
        yield from (frame for _, frame in sorted(found, key=lambda pair: pair[0]))


def _of_scene(path: Path) -> Iterator[tuple[str, Frame | Unmatched]]:
    """Yields the camera and the frame, sample by sample."""
    folder, content = path.parent, _json(path)
    datums = {row["key"]: row for row in content["data"]}
    calibrations: dict[str, Row] = {}
    for sample in content["samples"]:
        key = _text(sample, "calibration_key")
        if key not in calibrations:
            calibrations[key] = _json(folder / "calibration" / f"{key}.json")
        rows = {datums[k]["id"]["name"].upper(): datums[k]["datum"] for k in sample["datum_keys"]}
        scan = rows.get("LIDAR", {}).get("point_cloud")
        for name in (each for each in rows if each.startswith("CAMERA_")):
            row = rows[name]["image"]
            image = folder / _text(row, "filename")
            camera = _sensor_pose(image, row["pose"])
            of_scan = [] if scan is None else [_sensor_pose(image, scan["pose"])]
            yield (
                name,
                _frame(
                    image,
                    None if scan is None else folder / _text(scan, "filename"),
                    row,
                    _pinhole(name, calibrations[key]),
                    chained(inverse(camera), *of_scan),
                    "DDAD scene",
                    name=f"{folder.name}/{name}_{image.stem}",
                    pose=as_pose(np.column_stack(camera)),
                    group=f"{folder.name}/{name}",
                ),
            )


def _pinhole(name: str, calibration: Row) -> Floats:
    number = [camera.upper() for camera in calibration["names"]].index(name)
    values = {key: float(value) for key, value in calibration["intrinsics"][number].items()}
    if any(value for key, value in values.items() if key not in ("fx", "fy", "cx", "cy")):
        raise ValueError(f"{name} is no pinhole camera")
    return np.array([[values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1]])


def _sensor_pose(path: Path, row: Row) -> Extrinsics:
    """x_world = R · x_sensor + t; numbers that are 0 may be missing."""
    shift, turn = row.get("translation", {}), row.get("rotation", {})
    return pose_of_quaternion(
        path,
        [float(shift.get(axis, 0)) for axis in "xyz"],
        [float(turn.get(f"q{axis}", 0)) for axis in "xyzw"],
    )


DDAD = Layout(
    matches=_scenes,
    frames=_of_ddad,
    needs=("*/scene_*.json", "*/calibration", "*/point_cloud"),
)
