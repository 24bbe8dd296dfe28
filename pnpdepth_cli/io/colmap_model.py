"""Sparse models of COLMAP: cameras, images and points, in text or binary.

Own readers, because pycolmap 4.2 aborts the process on truncated files and allocates what a count
claims: every count of a binary file is checked against the bytes there are.
"""

from __future__ import annotations

import functools
import io
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged, numbered_lines, read_bytes
from pnpdepth_cli.io.poses import rotation_of

Integers = NDArray[np.int64]
_Kind = TypeVar("_Kind", bound=np.generic)


@dataclass(frozen=True, kw_only=True)
class ColmapImage:
    """A registered image."""

    camera: Camera
    pose: Extrinsics  # of the model's coordinates in the camera's, in model units
    points: Integers  # numbers of the points that are observed in it, sorted and unique


@dataclass(frozen=True, kw_only=True)
class ColmapModel:
    """A sparse model."""

    folder: Path
    images: dict[str, ColmapImage]  # by name, a path below the image folder
    points: NDArray[np.void]
    """(N,) of type `POINT`, sorted by number. The error is the mean reprojection error in pixels,
    negative where it was not computed; the track, the number of images that observe the point."""


_RADIAL, _FISHEYE = "radial-tangential", "fisheye"
MODELS = {
    "SIMPLE_PINHOLE": (0, 1, _RADIAL, 0),
    "PINHOLE": (1, 2, _RADIAL, 0),
    "SIMPLE_RADIAL": (2, 1, _RADIAL, 1),
    "RADIAL": (3, 1, _RADIAL, 2),
    "OPENCV": (4, 2, _RADIAL, 4),
    "OPENCV_FISHEYE": (5, 2, _FISHEYE, 4),
    "FULL_OPENCV": (6, 2, _RADIAL, 8),
    "SIMPLE_RADIAL_FISHEYE": (8, 1, _FISHEYE, 1),
    "RADIAL_FISHEYE": (9, 1, _FISHEYE, 2),
    "SIMPLE_FISHEYE": (14, 1, _FISHEYE, 0),
    "FISHEYE": (15, 2, _FISHEYE, 0),
}
"""COLMAP's camera models whose lenses are in `choices.LENSES`: the number in binary files, how many
focal lengths, the lens, and how many of its coefficients."""
_NAMES = {number: name for name, (number, *_) in MODELS.items()}
_LARGEST = 1e9

MODEL_PARTS = ("cameras", "images", "points3D")
_LOCK = threading.Lock()  # threads that read frames of one model wait for it
# Records of binary files.
_COUNT, _NUMBER, _BYTE, _TRACK_ENTRY = (np.dtype(kind) for kind in ("<u8", "<f8", "u1", "<i8"))
_CAMERA = np.dtype("<u4, <i4, <u8, <u8")
_IMAGE = np.dtype([("id", "<u4"), ("pose", "<f8", 7), ("camera", "<u4")])
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
POINT = np.dtype(
    [("number", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
)


def model_files(folder: Path) -> list[Path]:
    """Returns the three files of a model; none if this is no folder with a model."""
    for suffix in (".bin", ".txt"):  # binary first, as COLMAP itself
        files = [folder / f"{name}{suffix}" for name in MODEL_PARTS]
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
        InputError: There is none, or it is damaged or cut short.
    """
    files = model_files(find_model(path))
    states = tuple((file, file.stat().st_size, file.stat().st_mtime_ns) for file in files)
    with _LOCK:
        return _read(states)


@functools.lru_cache(maxsize=2)
def _read(states: tuple[tuple[Path, int, int], ...]) -> ColmapModel:
    """The model in files of this size and time; kept for other images of a batch."""
    camera_file, image_file, point_file = (path for path, _, _ in states)
    is_binary = camera_file.suffix == ".bin"
    with _naming(camera_file):
        cameras = dict((_binary_cameras if is_binary else _text_cameras)(camera_file))
    # The images, each of a name of its own and a camera that is there.
    images: dict[str, ColmapImage] = {}
    with _naming(image_file):
        for name, camera, pose, seen in (_binary_images if is_binary else _text_images)(image_file):
            if name in images or camera not in cameras:
                raise ValueError(f"the name or the camera of {name!r}")
            points = np.unique(seen[seen != -1])
            images[name] = ColmapImage(camera=cameras[camera], pose=pose, points=points)
    # The points.
    with _naming(point_file):
        found = (_binary_points if is_binary else _text_points)(point_file)
        if not np.isfinite(np.column_stack([found["xyz"], found["error"]])).all():
            raise ValueError("points without finite coordinates")
    found = found[np.argsort(found["number"], kind="stable")]
    return ColmapModel(folder=camera_file.parent, images=images, points=found)


def name_in_model(model: ColmapModel, image: Path) -> str:
    """Returns the name under which the model has a photo: the longest that ends its path.

    Raises:
        InputError: The model lacks it, or has several of its name.
    """
    # A name of the model is a path below its image folder, so it ends the photo's path.
    path = image.absolute().as_posix()
    at_the_end = [name for name in model.images if path.endswith(f"/{name}")]
    if at_the_end:
        return max(at_the_end, key=len)
    # A photo elsewhere is told by its file name alone.
    alike = [name for name in model.images if name.rpartition("/")[2] == image.name]
    if len(alike) == 1:
        return alike[0]
    raise InputError(
        f"{image} is {len(alike)} of the {len(model.images):,} images of {model.folder}, not one;"
        " COLMAP did not register it, or give it in the image folder of the model"
    )


def _parameter_count(name: str) -> int:
    """How many numbers a camera of this model has. ValueError for an unknown model."""
    if name not in MODELS:
        raise ValueError(
            f"camera model {name[:40]!r} is unknown; `colmap image_undistorter` writes pinhole"
            " cameras"
        )
    _, focals, _, coefficients = MODELS[name]
    return focals + 2 + coefficients


def _camera(path: Path, name: str, width: int, height: int, parameters: Sequence[float]) -> Camera:
    """The camera of a model with its parameters in COLMAP's order."""
    check_pixel_count(path, width, height)
    if len(parameters) != _parameter_count(name):
        raise ValueError(f"a {name} camera has other parameters")
    _, focals, lens, _ = MODELS[name]
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy = parameters[focals : focals + 2]
    if not (np.abs(parameters) < _LARGEST).all() or min(fx, fy) <= 0:
        raise ValueError(f"a {name} camera with parameters {list(parameters)}")
    distortion = tuple(parameters[focals + 2 :])
    if lens == _RADIAL and distortion:
        distortion = (*distortion, *[0.0] * (4 - len(distortion)))
    # Whole numbers are at pixel centres, where COLMAP has .5.
    intrinsics = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    return Camera(
        intrinsics=intrinsics,
        lens=lens,
        distortion=distortion,
        size=(height, width),
        source=f"{name} camera",
    )


def _pose(numbers: Sequence[float] | Sequence[str]) -> Extrinsics:
    """The pose of qw qx qy qz tx ty tz."""
    values = np.array(numbers, np.float64)
    if not np.isfinite(values).all() or not 1e-6 < np.linalg.norm(values[:4]) < 1e6:
        raise ValueError("a pose that is not made of finite numbers")
    return Extrinsics(rotation_of(values[:4]), values[4:])


def _records(stream: io.BytesIO, layout: np.dtype[_Kind], count: int = 1) -> NDArray[_Kind]:
    """The next `count` records of a file, which must hold them."""
    begin = stream.tell()
    size = count * layout.itemsize
    data = stream.read(min(size, sys.maxsize))
    if len(data) < size:
        raise ValueError(f"it is cut short at byte {begin:,}")
    return np.frombuffer(data, layout)


def _count(stream: io.BytesIO) -> int:
    return int(_records(stream, _COUNT).item())


def _binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    """Number and camera of each entry of cameras.bin."""
    stream = io.BytesIO(read_bytes(path))
    for _ in range(_count(stream)):
        number, model, width, height = _records(stream, _CAMERA).item()
        name = _NAMES.get(model, f"number {model}")
        parameters = _records(stream, _NUMBER, _parameter_count(name)).tolist()
        yield number, _camera(path, name, width, height, parameters)


def _binary_images(path: Path) -> Iterator[tuple[str, int, Extrinsics, Integers]]:
    """Yields name, number of the camera, pose and points of each image; -1 is no point."""
    data = read_bytes(path)
    stream = io.BytesIO(data)
    for _ in range(_count(stream)):
        _, pose, camera = _records(stream, _IMAGE)[0]
        end = data.find(b"\0", stream.tell())
        length = (len(data) if end < 0 else end) - stream.tell()
        name = _records(stream, _BYTE, length + 1)[:-1].tobytes().decode("utf-8", "replace")
        observations = _records(stream, _OBSERVATION, _count(stream))
        yield name, int(camera), _pose(pose), observations["point"]


def _binary_points(path: Path) -> NDArray[np.void]:
    """The points of points3D.bin, each of which is followed by its track."""
    stream = io.BytesIO(read_bytes(path))
    points = [np.empty(0, POINT)]
    for _ in range(_count(stream)):
        points.append(_records(stream, POINT))
        _records(stream, _TRACK_ENTRY, int(points[-1]["track"].item()))
    return np.concatenate(points)


def _text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for _, text in numbered_lines(read_bytes(path)):
        number, name, width, height, *words = text.split()
        parameters = [float(word) for word in words]
        yield int(number), _camera(path, name, int(width), int(height), parameters)


def _text_images(path: Path) -> Iterator[tuple[str, int, Extrinsics, Integers]]:
    """Each image has two lines, of which the second may be empty."""
    whole = read_bytes(path).decode("utf-8", "replace").removesuffix("\n").split("\n")
    lines = (line for line in whole if not line.startswith("#"))
    for text in lines:
        if not text.strip():
            continue
        _, *pose, camera, name = text.strip().split(maxsplit=9)
        keypoints = next(lines, "cut short").split()  # these two words are no keypoints
        if len(pose) != 7 or len(keypoints) % 3:
            raise ValueError("a pose has 7 numbers, and each keypoint 3")
        yield name, int(camera), _pose(pose), np.array(keypoints[2::3], np.int64)


def _text_points(path: Path) -> NDArray[np.void]:
    points = []
    for _, text in numbered_lines(read_bytes(path)):
        words = text.split()
        if len(words) < 8 or len(words) % 2:
            raise ValueError("a point has 8 numbers, and each observation 2")
        points.append((words[0], tuple(words[1:4]), 0, words[7], len(words) // 2 - 4))
    return np.array(points, POINT)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Names the file in an error of what is in it."""
    try:
        yield
    except (ValueError, OverflowError) as error:
        raise damaged(path, "COLMAP model", f"holds what is wrong: {error}") from error
