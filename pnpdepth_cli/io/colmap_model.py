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


_RADIAL = "radial-tangential"
_FISHEYE = "fisheye"
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
"""Names of the camera models by their numbers in binary files."""
_LARGEST = 1e9  # parameter of a camera, in pixels or of distortion; beyond it, products overflow
_QUATERNION_LENGTHS = (1e-6, 1e6)  # beyond which four numbers are no quaternion
_NO_POINT = -1  # number of the point of a keypoint that observes none
_TEXT_POINT_WORDS = 8  # number, x y z, r g b and error; the track follows

MODEL_PARTS = ("cameras", "images", "points3D")
"""Names of the three files of a model, without suffix."""
_LOCK = threading.Lock()  # threads that read frames of one model wait for it
# Records of binary files.
_COUNT = np.dtype("<u8")
_NUMBER = np.dtype("<f8")
_BYTE = np.dtype("u1")
_TRACK_ENTRY = np.dtype("<i8")
"""Numbers of an image and of a keypoint in it, 4 bytes each."""
_CAMERA = np.dtype("<u4, <i4, <u8, <u8")
"""Number, camera model, width and height."""
_IMAGE = np.dtype([("id", "<u4"), ("pose", "<f8", 7), ("camera", "<u4")])
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
POINT = np.dtype(
    [("number", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
)


def model_files(folder: Path) -> list[Path]:
    """Returns the files of cameras, images and points in a folder; [] if one is missing."""
    for suffix in (".bin", ".txt"):  # binary first, as COLMAP itself
        files = [folder / f"{name}{suffix}" for name in MODEL_PARTS]
        if all(file.is_file() for file in files):
            return files
    return []


def find_model(path: Path) -> Path:
    """Returns the folder of a COLMAP model: this folder or its 0/, sparse/0/ or sparse/.

    Raises:
        InputError: No such folder has a model.
    """
    for folder in (path, path / "0", path / "sparse" / "0", path / "sparse"):
        if model_files(folder):
            return folder
    parts = ", ".join(MODEL_PARTS)
    raise InputError(f"{path} has no COLMAP model ({parts} as .bin or .txt), usually in sparse/0")


def read_model(path: Path) -> ColmapModel:
    """Returns the sparse model in a folder, or in its 0/, sparse/0/ or sparse/.

    A model is read once for all images of a batch, and again if its files change.

    Raises:
        InputError: There is no model, or it is damaged or cut short.
    """
    files = model_files(find_model(path))
    states = tuple((file, file.stat().st_size, file.stat().st_mtime_ns) for file in files)
    with _LOCK:
        return _read(states)


@functools.lru_cache(maxsize=2)
def _read(states: tuple[tuple[Path, int, int], ...]) -> ColmapModel:
    """The model in three files, of cameras, images and points.

    Args:
        states: Path, size and time of the last change of each file, by which the cache knows it.
    """
    camera_file, image_file, point_file = (path for path, _, _ in states)
    is_binary = camera_file.suffix == ".bin"
    # The cameras, by their numbers.
    read_cameras = _binary_cameras if is_binary else _text_cameras
    with _wrap_errors(camera_file):
        cameras = dict(read_cameras(camera_file))
    # The images, each of a name of its own and a camera that is there.
    read_images = _binary_images if is_binary else _text_images
    images: dict[str, ColmapImage] = {}
    with _wrap_errors(image_file):
        for name, camera_number, pose, observed in read_images(image_file):
            if name in images or camera_number not in cameras:
                raise ValueError(f"the name or the camera of {name!r}")
            point_numbers = np.unique(observed[observed != _NO_POINT])
            images[name] = ColmapImage(
                camera=cameras[camera_number], pose=pose, points=point_numbers
            )
    # The points.
    read_points = _binary_points if is_binary else _text_points
    with _wrap_errors(point_file):
        points = read_points(point_file)
        if not np.isfinite(np.column_stack([points["xyz"], points["error"]])).all():
            raise ValueError("points without finite coordinates")
    by_number = np.argsort(points["number"], kind="stable")
    return ColmapModel(folder=camera_file.parent, images=images, points=points[by_number])


def name_in_model(model: ColmapModel, image: Path) -> str:
    """Returns the name under which a COLMAP model has a photo.

    It is the longest name of the model that the photo's path ends with, or else the only one with
    the name of the photo's file.

    Raises:
        InputError: The model lacks the photo, or has several of its name.
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
    """How many parameters a camera of this COLMAP model has. ValueError for an unknown model."""
    if name not in MODELS:
        raise ValueError(
            f"camera model {name[:40]!r} is unknown; `colmap image_undistorter` writes pinhole"
            " cameras"
        )
    _, focals, _, coefficients = MODELS[name]
    return focals + 2 + coefficients  # with the principal point, cx and cy


def _camera(path: Path, name: str, width: int, height: int, parameters: Sequence[float]) -> Camera:
    """The camera that an entry of COLMAP's list describes.

    Args:
        path: The file, for messages.
        name: Name of the camera model, one of `MODELS`.
        width: Width of the images in pixels.
        height: Height of the images in pixels.
        parameters: One or two focal lengths, the principal point and the coefficients of the lens.

    Raises:
        ValueError: The model is unknown, or the parameters are not those of a camera.
        InputError: The images have no pixels, or more than the budget allows.
    """
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
        while len(distortion) < 4:  # k1 k2 p1 p2, which OpenCV has at least
            distortion = (*distortion, 0.0)
    # Whole numbers are at pixel centres here, where COLMAP has .5.
    intrinsics = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    return Camera(
        intrinsics=intrinsics,
        lens=lens,
        distortion=distortion,
        size=(height, width),
        source=f"{name} camera",
    )


def _pose(numbers: Sequence[float] | Sequence[str]) -> Extrinsics:
    """The pose of the model's coordinates in the camera's, in model units.

    Args:
        numbers: qw qx qy qz tx ty tz. The quaternion need not be of length 1.

    Raises:
        ValueError: A number is not finite, or the quaternion is far too short or long to be one.
    """
    qw_to_tz = np.array(numbers, np.float64)
    if not np.isfinite(qw_to_tz).all():
        raise ValueError("a pose that is not made of finite numbers")
    quaternion, translation = np.split(qw_to_tz, [4])
    shortest, longest = _QUATERNION_LENGTHS
    length = np.linalg.norm(quaternion)
    if not shortest < length < longest:
        raise ValueError(f"a quaternion of length {length:.2g}")
    return Extrinsics(rotation_of(quaternion), translation)


def _records(stream: io.BytesIO, layout: np.dtype[_Kind], count: int = 1) -> NDArray[_Kind]:
    """The next records of a binary file, (count,). ValueError if the file ends before.

    Args:
        stream: The file, at the first of the records.
        layout: NumPy type of a record.
        count: Number of records, as the file claims it.
    """
    begin = stream.tell()
    size = count * layout.itemsize
    data = stream.read(min(size, sys.maxsize))
    if len(data) < size:
        raise ValueError(f"it is cut short at byte {begin:,}")
    return np.frombuffer(data, layout)


def _count(stream: io.BytesIO) -> int:
    """The next number of a binary file, which says how many records follow."""
    return int(_records(stream, _COUNT).item())


def _binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    """Yields number and camera of each entry of cameras.bin. ValueError if it is damaged."""
    stream = io.BytesIO(read_bytes(path))
    for _ in range(_count(stream)):
        number, model, width, height = _records(stream, _CAMERA).item()
        name = _NAMES.get(model, f"number {model}")
        parameters = _records(stream, _NUMBER, _parameter_count(name)).tolist()
        yield number, _camera(path, name, width, height, parameters)


def _binary_images(path: Path) -> Iterator[tuple[str, int, Extrinsics, Integers]]:
    """Yields name, number of the camera, pose and observed points of each entry of images.bin.

    Points are given by their numbers, `_NO_POINT` for a keypoint that observes none.

    Raises:
        ValueError: The file is damaged.
    """
    data = read_bytes(path)
    stream = io.BytesIO(data)
    for _ in range(_count(stream)):
        _, pose, camera = _records(stream, _IMAGE)[0]
        # The name ends with a null byte; without one, more bytes are asked for than there are.
        end = data.find(b"\0", stream.tell())
        length = (len(data) if end < 0 else end) - stream.tell()
        name = _records(stream, _BYTE, length + 1)[:-1].tobytes().decode("utf-8", "replace")
        observations = _records(stream, _OBSERVATION, _count(stream))
        yield name, int(camera), _pose(pose), observations["point"]


def _binary_points(path: Path) -> NDArray[np.void]:
    """The points of points3D.bin, (N,) of type `POINT`. ValueError if it is damaged."""
    stream = io.BytesIO(read_bytes(path))
    points = [np.empty(0, POINT)]
    for _ in range(_count(stream)):
        point = _records(stream, POINT)
        points.append(point)
        _records(stream, _TRACK_ENTRY, int(point["track"].item()))  # the track, which is left out
    return np.concatenate(points)


def _text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    """Yields number and camera of each line of cameras.txt. ValueError if it is damaged."""
    for _, text in numbered_lines(read_bytes(path)):
        number, name, width, height, *words = text.split()
        parameters = [float(word) for word in words]
        yield int(number), _camera(path, name, int(width), int(height), parameters)


def _text_images(path: Path) -> Iterator[tuple[str, int, Extrinsics, Integers]]:
    """Yields name, number of the camera, pose and observed points of each image in images.txt.

    Points are given by their numbers, `_NO_POINT` for a keypoint that observes none. An image has
    two lines. The second one has its keypoints, x y and point of each, and may be empty.

    Raises:
        ValueError: The file is damaged.
    """
    text = read_bytes(path).decode("utf-8", "replace")
    all_lines = text.removesuffix("\n").split("\n")
    lines = (line for line in all_lines if not line.startswith("#"))
    for line in lines:
        if not line.strip():
            continue
        _, *pose, camera, name = line.strip().split(maxsplit=9)
        # Without a second line, these two words are refused, as keypoints have three each.
        keypoints = next(lines, "cut short").split()
        if len(pose) != 7 or len(keypoints) % 3:
            raise ValueError("a pose has 7 numbers, and each keypoint 3")
        yield name, int(camera), _pose(pose), np.array(keypoints[2::3], np.int64)


def _text_points(path: Path) -> NDArray[np.void]:
    """The points of points3D.txt, (N,) of type `POINT` without colours. ValueError if damaged."""
    points = []
    for _, text in numbered_lines(read_bytes(path)):
        words = text.split()
        # After the point itself, its track: an image and a keypoint in it for each observation.
        if len(words) < _TEXT_POINT_WORDS or len(words) % 2:
            raise ValueError("a point has 8 numbers, and each observation 2")
        number, *xyz = words[:4]
        error = words[_TEXT_POINT_WORDS - 1]
        observations = (len(words) - _TEXT_POINT_WORDS) // 2
        points.append((number, tuple(xyz), 0, error, observations))
    return np.array(points, POINT)


@contextmanager
def _wrap_errors(path: Path) -> Iterator[None]:
    """Turns a ValueError or OverflowError inside the block into an InputError that names a file.

    They are raised by the readers above, and by Python where a text is no number or a number is too
    large.
    """
    try:
        yield
    except (ValueError, OverflowError) as error:
        raise damaged(path, "COLMAP model", f"holds what is wrong: {error}") from error
