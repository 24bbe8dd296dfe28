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
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched
from pnpdepth_cli.io.extrinsics import Extrinsics, inverse, pose_of_quaternion
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


def _calibration(
    path: Path, intrinsics: Floats, image: Row, pose: Extrinsics, source: str
) -> Calibration:
    """The camera of an image, with the pose of the scan in it."""
    if not (np.abs(intrinsics) < _LARGEST_PX).all() or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise ValueError("no pinhole camera")
    size = int(image["height"]), int(image["width"])
    check_pixel_count(path, size[1], size[0])
    return Calibration(
        intrinsics=intrinsics,
        rotation=pose[0],
        translation=pose[1],
        distortion=(),
        size=size,
        has_pose=True,
        source=source,
    )


def _chained(*poses: Extrinsics) -> Extrinsics:
    rotation, translation = np.eye(3), np.zeros(3)
    for turn, shift in poses:
        translation = rotation @ shift + translation
        rotation = rotation @ turn
    return rotation, translation


def _missing(image: Path) -> Unmatched:
    return Unmatched(path=image, why="or its LiDAR scan does not exist; add it")


def _version(root: Path) -> Path | None:
    """The folder of nuScenes' tables, the first of several."""
    folders = sorted(p.parent for p in root.glob("v1.0-*/sample_data.json"))
    return folders[0] if folders else None


def _nuscenes(root: Path) -> Listing:
    """One frame for each camera image of a key frame."""
    version = _version(root)
    assert version is not None
    with _as_our_errors(version):
        tables = {
            name: {_text(row, "token"): row for row in _json(version / f"{name}.json")}
            for name in _TABLES
        }
        found = list(_of_tables(root, tables))
    frames = sorted((each for each in found if isinstance(each, Frame)), key=lambda f: f.name)
    return Listing(
        frames=frames, broken=tuple(each for each in found if isinstance(each, Unmatched))
    )


def _of_tables(root: Path, tables: dict[str, dict[str, Row]]) -> Iterator[Frame | Unmatched]:
    samples: dict[str, dict[str, Row]] = {}
    for row in tables["sample_data"].values():
        if row["is_key_frame"]:
            sensor = tables["calibrated_sensor"][row["calibrated_sensor_token"]]["sensor_token"]
            channel = _text(tables["sensor"][sensor], "channel")
            samples.setdefault(row["sample_token"], {})[channel] = row
    for sample, rows in samples.items():
        scan = rows.get("LIDAR_TOP")
        scene = _text(tables["scene"][tables["sample"][sample]["scene_token"]], "name")
        for channel in sorted(name for name in rows if name.startswith("CAM_")):
            row = rows[channel]
            image = root / _text(row, "filename")
            sparse = None if scan is None else root / _text(scan, "filename")
            if scan is None or not image.is_file() or sparse is None or not sparse.is_file():
                yield _missing(image)
                continue
            camera, scanner = (
                tables["calibrated_sensor"][each["calibrated_sensor_token"]] for each in (row, scan)
            )
            car, car_at_scan = (tables["ego_pose"][each["ego_pose_token"]] for each in (row, scan))
            poses = [_car_pose(root, each) for each in (camera, car, car_at_scan, scanner)]
            matrix = np.array(camera["camera_intrinsic"], np.float64).reshape(3, 3)
            pose = _chained(inverse(poses[0]), inverse(poses[1]), *poses[2:])
            yield Frame(
                name=f"{scene}/{image.stem}",
                image=image,
                sparse=sparse,
                calibration=_calibration(image, matrix, row, pose, "nuScenes tables"),
                group=f"{scene}/{channel}",
            )


def _car_pose(root: Path, row: Row) -> Extrinsics:
    """x_parent = R · x + t; nuScenes writes quaternions w x y z."""
    w, x, y, z = (float(value) for value in row["rotation"])
    return pose_of_quaternion(root, [float(v) for v in row["translation"]], [x, y, z, w])


NUSCENES = Layout(
    matches=lambda root: (root / "samples").is_dir() and _version(root) is not None,
    listing=_nuscenes,
    needs=("v1.0-*/sample_data.json", "samples"),
)


def _scenes(root: Path) -> list[Path]:
    """The file of each scene of DDAD, the first of several of one folder."""
    files = sorted((*root.glob("scene_*.json"), *root.glob("*/scene_*.json")))
    first = {path.parent: path for path in reversed(files)}
    return [first[folder] for folder in sorted(first) if (folder / "calibration").is_dir()]


def _ddad(root: Path) -> Listing:
    """One frame for each camera of each sample, scene by scene and camera by camera."""
    found: list[Frame | Unmatched] = []
    for path in _scenes(root):
        with _as_our_errors(path):
            found += _of_scene(path)
    return Listing(
        frames=[each for each in found if isinstance(each, Frame)],
        broken=tuple(each for each in found if isinstance(each, Unmatched)),
    )


def _of_scene(path: Path) -> list[Frame | Unmatched]:
    folder, content = path.parent, _json(path)
    datums = {row["key"]: row for row in content["data"]}
    calibrations: dict[str, Row] = {}
    by_camera: dict[str, list[Frame | Unmatched]] = {}
    for sample in content["samples"]:
        key = _text(sample, "calibration_key")
        if key not in calibrations:
            calibrations[key] = _json(folder / "calibration" / f"{key}.json")
        rows = {datums[k]["id"]["name"].upper(): datums[k]["datum"] for k in sample["datum_keys"]}
        for name in sorted(each for each in rows if each.startswith("CAMERA_")):
            frame = _of_sample(folder, name, rows, calibrations[key])
            by_camera.setdefault(name, []).append(frame)
    return [frame for name in sorted(by_camera) for frame in by_camera[name]]


def _of_sample(
    folder: Path, name: str, rows: dict[str, Row], calibration: Row
) -> Frame | Unmatched:
    image = rows[name]["image"]
    path = folder / _text(image, "filename")
    scan = rows.get("LIDAR", {}).get("point_cloud")
    if scan is None or not path.is_file() or not (folder / _text(scan, "filename")).is_file():
        return _missing(path)
    camera, scanner = _sensor_pose(path, image["pose"]), _sensor_pose(path, scan["pose"])
    pose = _chained(inverse(camera), scanner)
    return Frame(
        name=f"{folder.name}/{name}_{path.stem}",
        image=path,
        sparse=folder / _text(scan, "filename"),
        calibration=_calibration(path, _pinhole(name, calibration), image, pose, "DDAD scene"),
        pose=tuple(map(tuple, np.column_stack(camera).tolist())),
        group=f"{folder.name}/{name}",
    )


def _pinhole(name: str, calibration: Row) -> Floats:
    number = [each.upper() for each in calibration["names"]].index(name)
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
    matches=lambda root: bool(_scenes(root)),
    listing=_ddad,
    needs=("*/scene_*.json", "*/calibration", "*/point_cloud"),
)
