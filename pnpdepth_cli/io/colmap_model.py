"""Sparse models of COLMAP: cameras, images and points, in text or binary.

Own readers, because pycolmap 4.2 aborts the process on truncated files and allocates what a count
claims: every count of a binary file is checked against the bytes there are.
"""

from __future__ import annotations

import functools
import struct
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.extrinsics import rotation_of
from pnpdepth_cli.io.file_bytes import (
    check_pixel_count,
    damaged,
    one_line,
    read_bytes,
    size_of_regular_file,
)

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class ColmapImage:
    """A registered image: x_camera = rotation · x_model + translation, in model units."""

    camera: int
    rotation: Floats
    translation: Floats
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
    """A sparse model: its cameras by number, and its registered images by name."""

    folder: Path
    cameras: dict[int, Camera]
    images: dict[str, ColmapImage]  # the name is a path below the image folder
    points: ColmapPoints


class _CameraModel(NamedTuple):
    number: int  # in binary files
    focals: int
    lens: str
    coefficients: int

    @property
    def parameters(self) -> int:
        return self.focals + 2 + self.coefficients


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
_NAMES = {model.number: name for name, model in MODELS.items()} | {17: "EQUIRECTANGULAR"}
_LARGEST = 1e9

MODEL_PARTS = ("cameras", "images", "points3D")
_LOCK = threading.Lock()
"""So that threads that read frames of one model wait for it instead of reading it again."""
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
    raise InputError(
        f"{path} is a folder without a COLMAP model; give the one with cameras, images and"
        " points3D as .bin or .txt, usually sparse/0"
    )


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
    # The readers, of binary files or of text.
    camera_file, image_file, point_file = (state[0] for state in states)
    if camera_file.suffix == ".bin":
        read_cameras, read_images, read_points = _binary_cameras, _binary_images, _binary_points
    else:
        read_cameras, read_images, read_points = _text_cameras, _text_images, _text_points
    # The cameras.
    cameras = {
        number: _camera(camera_file, name, size, parameters)
        for number, name, size, parameters in read_cameras(camera_file)
    }
    # The images, each of a name of its own and a camera that is there.
    images: dict[str, ColmapImage] = {}
    for name, camera, pose, points in read_images(image_file):
        if name in images:
            raise FileFormatError(
                f"{image_file}: the image {name!r} is in it twice; create it again"
            )
        if camera not in cameras:
            raise FileFormatError(
                f"{image_file}: an image has camera {camera}, which {camera_file.name} lacks;"
                " create the model again"
            )
        images[name] = _image(image_file, name, camera, pose, points)
    return ColmapModel(
        folder=camera_file.parent,
        cameras=cameras,
        images=images,
        points=_points(point_file, *read_points(point_file)),
    )


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
    if alike:
        raise InputError(
            f"{image} could be any of {_listing(alike)} of {model.folder}; give it in the image"
            " folder of the model"
        )
    raise InputError(
        f"{image} is not among the {len(model.images):,} images of {model.folder}"
        f" ({_listing(model.images)}); COLMAP did not register it, or its name has changed"
    )


def _listing(names: Iterable[str]) -> str:
    first = sorted(names)
    return ", ".join(first[:3]) + (", …" if len(first) > 3 else "")


def _parameter_count(path: Path, name: str) -> int:
    """The parameters of a camera model. Raises FileFormatError if it is unknown."""
    if name == "EQUIRECTANGULAR":
        raise FileFormatError(
            f"{path}: a camera of model EQUIRECTANGULAR has no z axis; render perspective views of"
            " its panoramas"
        )
    if name not in MODELS:
        raise FileFormatError(
            f"{path}: camera model {one_line(name)[:40]!r} is not one of {', '.join(MODELS)};"
            " `colmap image_undistorter` writes images and a model of pinhole cameras"
        )
    return MODELS[name].parameters


def _camera(path: Path, name: str, size: tuple[int, int], parameters: Sequence[float]) -> Camera:
    """The camera of a model `name` with its parameters in COLMAP's order."""
    model = MODELS[name]
    check_pixel_count(path, size[1], size[0])
    fx, fy = parameters[0], parameters[model.focals - 1]
    cx, cy = parameters[model.focals : model.focals + 2]
    if not (np.abs(parameters) < _LARGEST).all() or min(fx, fy) <= 0:
        raise FileFormatError(
            f"{path}: a {name} camera with parameters {one_line(list(parameters))[:80]} cannot"
            " exist; create the model again"
        )
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


def _image(
    path: Path, name: str, camera: int, pose: Sequence[float], points: Integers
) -> ColmapImage:
    """The image of a pose qw qx qy qz tx ty tz, with the points at its keypoints, -1 for none."""
    values = np.array(pose, np.float64)
    length = float(np.linalg.norm(values[:4]))
    if not np.isfinite(values).all() or not 1e-6 < length < 1e6:
        raise FileFormatError(
            f"{path}: the pose of {one_line(name)!r} is not made of finite numbers; create the"
            " model again"
        )
    return ColmapImage(
        camera=camera,
        rotation=rotation_of(values[:4]),
        translation=values[4:],
        points=np.unique(points[points != -1]),
    )


def _points(path: Path, number: Integers, rows: Floats, track: Integers) -> ColmapPoints:
    """The points of rows (N, 4) of x y z and reprojection error."""
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise FileFormatError(
            f"{path}: {int(bad.sum()):,} of {len(rows):,} points have no finite coordinates;"
            " create the model again"
        )
    order = np.argsort(number, kind="stable")
    return ColmapPoints(
        number=number[order], xyz=rows[order, :3], error=rows[order, 3], track=track[order]
    )


class _Reader:
    """The bytes of a file, read in order."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.position = path, read_bytes(path), 0

    def take(self, size: int) -> int:
        """Moves on by so many bytes, and returns where they begin."""
        begin = self.position
        if size > len(self.data) - begin:
            raise damaged(self.path, "COLMAP model", f"is cut short at byte {begin:,}")
        self.position += size
        return begin

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Returns the numbers of the layout."""
        return layout.unpack_from(self.data, self.take(layout.size))

    def count(self, smallest: int) -> int:
        """Returns the number of records that follow, each of at least so many bytes."""
        (count,) = self.unpack(_COUNT)
        if count * smallest > len(self.data) - self.position:
            fact = f"claims {count:,} records in {len(self.data):,} bytes; it is cut short or wrong"
            raise damaged(self.path, "COLMAP model", fact)
        return int(count)


Described = tuple[int, str, tuple[int, int], Sequence[float]]
"""Number, model, (H, W) and parameters of a camera."""
Registered = tuple[str, int, Sequence[float], Integers]
"""Name, camera, pose and points of an image."""
Table = tuple[Integers, Floats, Integers]
"""Numbers (N,), rows (N, 4) of x y z and error, and lengths of the tracks (N,) of points."""


def _binary_cameras(path: Path) -> Iterator[Described]:
    reader = _Reader(path)
    for _ in range(reader.count(_CAMERA.size)):
        number, model, width, height = reader.unpack(_CAMERA)
        name = _NAMES.get(model, f"number {model}")
        parameters = reader.unpack(struct.Struct(f"<{_parameter_count(path, name)}d"))
        yield number, name, (height, width), parameters


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
        yield name, camera, pose, seen


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


def _text_cameras(path: Path) -> Iterator[Described]:
    for line, text in _lines(path):
        words = text.split()
        if len(words) < 4:
            raise _invalid(path, line, text, "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS")
        needed = _parameter_count(path, words[1])
        if len(words) != 4 + needed:
            raise FileFormatError(
                f"{path}, line {line}: a {words[1]} camera has {needed} parameters, not"
                f" {len(words) - 4}; create the model again"
            )
        try:
            number, width, height = (int(words[i]) for i in (0, 2, 3))
            parameters = [float(word) for word in words[4:]]
        except ValueError as error:
            raise _invalid(path, line, text, "numbers of a camera") from error
        yield number, words[1], (height, width), parameters


def _text_images(path: Path) -> Iterator[Registered]:
    """Each image has two lines, of which the second may be empty."""
    lines = _lines(path, with_empty=True)
    for line, text in lines:
        if not text.strip():
            continue
        words = text.split(maxsplit=9)
        following = next(lines, None)
        if following is None and len(words) == 10:
            raise FileFormatError(
                f"{path}, line {line}: the line of keypoints after it is missing; the file is cut"
                " short"
            )
        try:
            pose, camera, name = [float(w) for w in words[1:8]], int(words[8]), words[9].strip()
            keypoints = following[1].split() if following else []
            if len(keypoints) % 3:
                raise ValueError("not triples")
            seen = np.array([int(word) for word in keypoints[2::3]], np.int64)
        except (ValueError, IndexError, OverflowError) as error:
            wanted = "an image and its keypoints (or the file is cut short)"
            raise _invalid(path, line, text, wanted) from error
        yield name, camera, pose, seen


def _text_points(path: Path) -> Table:
    numbers, rows, tracks = [], [], []
    for line, text in _lines(path):
        words = text.split()
        try:
            numbers.append(np.int64(words[0]))
            rows.append([float(words[i]) for i in (1, 2, 3, 7)])
            if len(words) % 2:
                raise ValueError("not pairs")
        except (ValueError, IndexError, OverflowError) as error:
            wanted = "a point and its track (or the file is cut short)"
            raise _invalid(path, line, text, wanted) from error
        tracks.append((len(words) - 8) // 2)
    table = np.array(rows, np.float64).reshape(-1, 4)
    return np.array(numbers, np.int64), table, np.array(tracks, np.int64)


def _lines(path: Path, *, with_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, without comments."""
    lines = read_bytes(path).decode("utf-8", "replace").split("\n")
    if lines[-1] == "":
        lines.pop()
    for number, line in enumerate(lines, start=1):
        if not line.startswith("#") and (with_empty or line.strip()):
            yield number, line


def _invalid(path: Path, line: int, text: str, wanted: str) -> FileFormatError:
    return FileFormatError(f"{path}, line {line}: {one_line(text)[:60]!r} is not {wanted}")
