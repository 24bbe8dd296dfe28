"""Sparse models of COLMAP: cameras, images and points, in text or binary.

Own readers, because pycolmap 4.2 aborts the process on truncated files and allocates what a count
claims: every count of a binary file is checked against the bytes there are.
"""

from __future__ import annotations

import functools
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.file_bytes import (
    check_pixel_count,
    damaged,
    one_line,
    read_bytes,
    size_of_regular_file,
)
from pnpdepth_cli.io.poses import rotation_of

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class ColmapImage:
    """A registered image."""

    camera: Camera
    pose: Extrinsics  # of the model's coordinates in the camera's, in model units
    points: Integers  # numbers of the points that are observed in it, sorted and unique


@dataclass(frozen=True, kw_only=True)
class ColmapPoints:
    """The points of a model, sorted by number."""

    number: Integers  # (N,) COLMAP's numbers
    xyz: Floats  # (N, 3) in model units
    error: Floats  # (N,) mean reprojection error in pixels, negative where it was not computed
    track: Integers  # (N,) images that observe the point


@dataclass(frozen=True, kw_only=True)
class ColmapModel:
    """A sparse model."""

    folder: Path
    images: dict[str, ColmapImage]  # by name, a path below the image folder
    points: ColmapPoints


class _CameraModel(NamedTuple):
    number: int  # in binary files
    focals: int
    lens: str
    coefficients: int


_RADIAL, _FISHEYE = "radial-tangential", "fisheye"
MODELS = {
    "SIMPLE_PINHOLE": _CameraModel(0, 1, _RADIAL, 0),
    "PINHOLE": _CameraModel(1, 2, _RADIAL, 0),
    "SIMPLE_RADIAL": _CameraModel(2, 1, _RADIAL, 1),
    "RADIAL": _CameraModel(3, 1, _RADIAL, 2),
    "OPENCV": _CameraModel(4, 2, _RADIAL, 4),
    "OPENCV_FISHEYE": _CameraModel(5, 2, _FISHEYE, 4),
    "FULL_OPENCV": _CameraModel(6, 2, _RADIAL, 8),
    "SIMPLE_RADIAL_FISHEYE": _CameraModel(8, 1, _FISHEYE, 1),
    "RADIAL_FISHEYE": _CameraModel(9, 1, _FISHEYE, 2),
    "SIMPLE_FISHEYE": _CameraModel(14, 1, _FISHEYE, 0),
    "FISHEYE": _CameraModel(15, 2, _FISHEYE, 0),
}
"""COLMAP's camera models whose lenses are in `choices.LENSES`."""
_NAMES = {model.number: name for name, model in MODELS.items()}
_LARGEST = 1e9

MODEL_PARTS = ("cameras", "images", "points3D")
_LOCK = threading.Lock()  # threads that read frames of one model wait for it
_COUNT, _CAMERA = struct.Struct("<Q"), struct.Struct("<IiQQ")
_IMAGE, _POINT = struct.Struct("<I7dI"), struct.Struct("<Q3d3BdQ")
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK_ENTRY = 8


def model_files(folder: Path) -> list[Path]:
    """Returns the three files of a model; none if this is no folder with a model."""
    for suffix in (".bin", ".txt"):  # binary first, as COLMAP itself
        files = [folder / f"{part}{suffix}" for part in MODEL_PARTS]
        if all(file.is_file() for file in files):
            return files
    return []


def find_model(path: Path) -> Path:
    """Returns the folder of the model: this folder or its 0/, sparse/0/ or sparse/.

    Raises:
        InputError: There is none.
    """
    for folder in (path, path / "0", path / "sparse" / "0", path / "sparse"):
        if model_files(folder):
            return folder
    parts = ", ".join(MODEL_PARTS)
    raise InputError(f"{path} has no COLMAP model ({parts} as .bin or .txt), usually in sparse/0")


def read_model(path: Path) -> ColmapModel:
    """Returns the sparse model in a folder, or in its 0/, sparse/0/ or sparse/.

    Raises:
        InputError: There is none.
        FileFormatError: It is damaged or cut short.
    """
    files = model_files(find_model(path))
    states = tuple((file, size_of_regular_file(file), file.stat().st_mtime_ns) for file in files)
    with _LOCK:
        return _read(states)


@functools.lru_cache(maxsize=2)
def _read(states: tuple[tuple[Path, int, int], ...]) -> ColmapModel:
    """The model in files of this size and time; kept for other images of a batch."""
    camera_file, image_file, point_file = (path for path, _, _ in states)
    is_binary = camera_file.suffix == ".bin"
    # The cameras.
    cameras = dict((_binary_cameras if is_binary else _text_cameras)(camera_file))
    # The images, each of a name of its own and a camera that is there.
    images: dict[str, ColmapImage] = {}
    for name, camera, pose, seen in (_binary_images if is_binary else _text_images)(image_file):
        if name in images:
            raise _damaged(image_file, f"has two images {name!r}")
        if camera not in cameras:
            raise _damaged(image_file, f"has an image of camera {camera}, which is not described")
        points = np.unique(seen[seen != -1])
        images[name] = ColmapImage(camera=cameras[camera], pose=pose, points=points)
    # The points.
    number, rows, track = (_binary_points if is_binary else _text_points)(point_file)
    if not np.isfinite(rows).all():
        raise _damaged(point_file, "has points without finite coordinates")
    order = np.argsort(number, kind="stable")
    sorted_points = ColmapPoints(
        number=number[order], xyz=rows[order, :3], error=rows[order, 3], track=track[order]
    )
    return ColmapModel(folder=camera_file.parent, images=images, points=sorted_points)


def name_in_model(model: ColmapModel, image: Path) -> str:
    """Returns the name under which the model has a photo: the longest that ends its path.

    Raises:
        InputError: The model lacks it, or has several of its name.
    """
    whole = PurePosixPath(image.absolute().as_posix()).parts
    parts = {name: PurePosixPath(name).parts for name in model.images}
    ending = [name for name, part in parts.items() if part and whole[-len(part) :] == part]
    if ending:
        return max(ending, key=len)
    alike = [name for name, part in parts.items() if part[-1:] == (image.name,)]
    if len(alike) == 1:
        return alike[0]
    names = ", ".join(sorted(alike or parts)[:3])
    raise InputError(
        f"{image} is {len(alike)} of the {len(parts):,} images of {model.folder} ({names}, …), not"
        " one; COLMAP did not register it, or give it in the image folder of the model"
    )


def _damaged(path: Path, fact: str) -> FileFormatError:
    return damaged(path, "COLMAP model", fact)


def _parameter_count(path: Path, name: str) -> int:
    if name not in MODELS:
        raise FileFormatError(
            f"{path}: camera model {one_line(name)[:40]!r} is not one of {', '.join(MODELS)};"
            " `colmap image_undistorter` writes images and a model of pinhole cameras"
        )
    return MODELS[name].focals + 2 + MODELS[name].coefficients


def _camera(path: Path, name: str, size: tuple[int, int], parameters: Sequence[float]) -> Camera:
    """The camera of a model with its parameters in COLMAP's order."""
    model = MODELS[name]
    check_pixel_count(path, size[1], size[0])
    fx, fy = parameters[0], parameters[model.focals - 1]
    cx, cy = parameters[model.focals : model.focals + 2]
    if not (np.abs(parameters) < _LARGEST).all() or min(fx, fy) <= 0:
        raise _damaged(path, f"has a {name} camera with parameters {list(parameters)}")
    distortion = tuple(parameters[model.focals + 2 :])
    if model.lens == _RADIAL and distortion:
        distortion = (*distortion, *[0.0] * (4 - len(distortion)))
    # whole numbers are at pixel centres, where COLMAP has .5
    return Camera(
        intrinsics=np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]),
        lens=model.lens,
        distortion=distortion,
        size=size,
        source=f"{name} camera",
    )


def _pose(path: Path, name: str, numbers: Sequence[float]) -> Extrinsics:
    """The pose of qw qx qy qz tx ty tz."""
    values = np.array(numbers, np.float64)
    if not np.isfinite(values).all() or not 1e-6 < np.linalg.norm(values[:4]) < 1e6:
        raise _damaged(path, f"has no pose of finite numbers for {name!r}")
    return Extrinsics(rotation_of(values[:4]), values[4:])


class _Reader:
    """The bytes of a file, read in order."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.position = path, read_bytes(path), 0

    def take(self, size: int) -> int:
        """Moves on by so many bytes, and returns where they begin."""
        begin = self.position
        if size > len(self.data) - begin:
            raise _damaged(self.path, f"is cut short at byte {begin:,}")
        self.position += size
        return begin

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Returns the numbers of the layout."""
        return layout.unpack_from(self.data, self.take(layout.size))

    def count(self, smallest: int) -> int:
        """Returns the number of records that follow, each of at least so many bytes."""
        (count,) = self.unpack(_COUNT)
        if count * smallest > len(self.data) - self.position:
            raise _damaged(self.path, f"claims {count:,} records in {len(self.data):,} bytes")
        return int(count)


Registered = tuple[str, int, Extrinsics, Integers]
"""Name, number of the camera, pose and points of an image; -1 is no point."""
Table = tuple[Integers, Floats, Integers]
"""Numbers (N,), rows (N, 4) of x y z and error, and lengths of the tracks (N,) of points."""


def _binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    reader = _Reader(path)
    for _ in range(reader.count(_CAMERA.size)):
        number, model, width, height = reader.unpack(_CAMERA)
        name = _NAMES.get(model, f"number {model}")
        parameters = reader.unpack(struct.Struct(f"<{_parameter_count(path, name)}d"))
        yield number, _camera(path, name, (height, width), parameters)


def _binary_images(path: Path) -> Iterator[Registered]:
    reader = _Reader(path)
    for _ in range(reader.count(_IMAGE.size)):
        _, *pose, camera = reader.unpack(_IMAGE)
        end = reader.data.find(b"\0", reader.position)
        begin = reader.take((end if end >= 0 else len(reader.data)) + 1 - reader.position)
        name = reader.data[begin:end].decode("utf-8", "replace")
        observations = reader.count(_OBSERVATION.itemsize)
        begin = reader.take(observations * _OBSERVATION.itemsize)
        seen = np.frombuffer(reader.data, _OBSERVATION, observations, begin)["point"]
        yield name, camera, _pose(path, name, pose), seen


def _binary_points(path: Path) -> Table:
    reader = _Reader(path)
    count = reader.count(_POINT.size)
    rows = np.empty((count, 4))
    number, track = np.empty(count, np.int64), np.empty(count, np.int64)
    for row in range(count):
        point, x, y, z, _, _, _, error, length = reader.unpack(_POINT)
        reader.take(length * _TRACK_ENTRY)
        rows[row] = x, y, z, error
        number[row], track[row] = np.uint64(point).astype(np.int64), length
    return number, rows, track


def _text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for line, text in _lines(path):
        with _naming(path, line):
            number, name, width, height, *parameters = text.split()
            if len(parameters) != _parameter_count(path, name):
                raise ValueError(f"a {name} camera has other parameters")
            size = int(height), int(width)
            yield int(number), _camera(path, name, size, [float(word) for word in parameters])


def _text_images(path: Path) -> Iterator[Registered]:
    """Each image has two lines, of which the second may be empty."""
    lines = _lines(path, with_empty=True)
    for line, text in lines:
        if not text.strip():
            continue
        with _naming(path, line):
            _, *pose, camera, name = text.split(maxsplit=9)
            keypoints = next(lines)[1].split()
            if len(pose) != 7 or len(keypoints) % 3:
                raise ValueError("a pose has 7 numbers, and each keypoint 3")
            seen = np.array([int(word) for word in keypoints[2::3]], np.int64)
            name = name.strip()
            yield name, int(camera), _pose(path, name, [float(word) for word in pose]), seen


def _text_points(path: Path) -> Table:
    numbers, rows, tracks = [], [], []
    for line, text in _lines(path):
        words = text.split()
        with _naming(path, line):
            if len(words) < 8 or len(words) % 2:
                raise ValueError("a point has 8 numbers, and each observation 2")
            numbers.append(np.int64(words[0]))
            rows.append([float(words[i]) for i in (1, 2, 3, 7)])
        tracks.append(len(words) // 2 - 4)
    table = np.array(rows, np.float64).reshape(-1, 4)
    return np.array(numbers, np.int64), table, np.array(tracks, np.int64)


def _lines(path: Path, *, with_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, without comments."""
    lines = read_bytes(path).decode("utf-8", "replace").removesuffix("\n").split("\n")
    for number, line in enumerate(lines, start=1):
        if not line.startswith("#") and (with_empty or line.strip()):
            yield number, line


@contextmanager
def _naming(path: Path, line: int) -> Iterator[None]:
    """Names the line in an error of the numbers in it."""
    try:
        yield
    except (ValueError, OverflowError, StopIteration) as error:
        fact = one_line(error) or "the file is cut short"
        raise _damaged(path, f"has a wrong line {line} ({fact})") from error
