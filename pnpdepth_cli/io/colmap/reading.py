"""Sparse models of COLMAP from their folder, in binary or text, kept for other images of a batch.

Every count of a binary file is checked against the bytes there are.
"""

from __future__ import annotations

import functools
import struct
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.colmap.model import (
    NAME_OF_NUMBER,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    camera_of,
    image_of,
    parameter_count,
    points_of,
)
from pnpdepth_cli.io.file_bytes import damaged, one_line, read_bytes, size_of_regular_file

_PARTS = ("cameras", "images", "points3D")
_LOCK = threading.Lock()
"""So that threads that read frames of one model wait for it instead of reading it again."""
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK_ENTRY = 8
_LONGEST_NUMBER = 18
"""Digits of a whole number in a text that fits 64 bits."""


def model_files(folder: Path) -> list[Path]:
    """Returns the three files of a model; none if this is no folder with a model."""
    for suffix in (".bin", ".txt"):  # binary first, as COLMAP itself
        files = [folder / f"{part}{suffix}" for part in _PARTS]
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
    cameras, images, points = (state[0] for state in states)
    binary = cameras.suffix == ".bin"
    model = ColmapModel(
        folder=cameras.parent,
        cameras=(_binary_cameras if binary else _text_cameras)(cameras),
        images=(_binary_images if binary else _text_images)(images),
        points=(_binary_points if binary else _text_points)(points),
    )
    lost = next((i for i in model.images.values() if i.camera not in model.cameras), None)
    if lost is not None:
        raise FileFormatError(
            f"{images}: an image has camera {lost.camera}, which {cameras.name} lacks; create the"
            " model again"
        )
    return model


def name_in_model(model: ColmapModel, image: Path) -> str:
    """Returns the name under which the model has a photo: the longest that ends its path.

    Raises:
        InputError: The model lacks it, or has several of its name.
    """
    whole = PurePosixPath(image.absolute().as_posix()).parts
    ending = [n for n in model.images if _ends(whole, PurePosixPath(n).parts)]
    if ending:
        return max(ending, key=len)
    alike = [name for name in model.images if PurePosixPath(name).name == image.name]
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


def _ends(whole: tuple[str, ...], part: tuple[str, ...]) -> bool:
    return bool(part) and whole[-len(part) :] == part


def _listing(names: Iterable[str]) -> str:
    first = sorted(names)
    return ", ".join(first[:3]) + (", …" if len(first) > 3 else "")


class _Reader:
    """The bytes of a file, read in order."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.position = path, read_bytes(path), 0

    def take(self, size: int) -> int:
        """Moves on by so many bytes, and returns where they begin."""
        begin = self.position
        if size > len(self.data) - begin:
            raise self._damaged(f"is cut short at byte {begin:,}")
        self.position += size
        return begin

    def unpack(self, layout: struct.Struct) -> tuple[float, ...]:
        """Returns the numbers of the layout."""
        return layout.unpack_from(self.data, self.take(layout.size))

    def count(self, smallest: int) -> int:
        """Returns the number of records that follow, each of at least so many bytes."""
        (count,) = _COUNT.unpack_from(self.data, self.take(_COUNT.size))
        if count * smallest > len(self.data) - self.position:
            size = f"{count:,} records in {len(self.data):,} bytes"
            raise self._damaged(f"claims {size}; it is cut short or wrong")
        return int(count)

    def text(self) -> str:
        """Returns the text up to the next zero byte."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise self._damaged("is cut short in the name of an image")
        return self.data[self.take(end + 1 - self.position) : end].decode("utf-8", "replace")

    def _damaged(self, fact: str) -> FileFormatError:
        return damaged(self.path, "COLMAP model", fact)


def _binary_cameras(path: Path) -> dict[int, ColmapCamera]:
    reader = _Reader(path)
    cameras = {}
    for _ in range(reader.count(_CAMERA.size)):
        number, model, width, height = (int(value) for value in reader.unpack(_CAMERA))
        name = NAME_OF_NUMBER.get(model, f"number {model}")
        parameters = reader.unpack(struct.Struct(f"<{parameter_count(path, name)}d"))
        cameras[number] = camera_of(path, name, (height, width), parameters)
    return cameras


def _binary_images(path: Path) -> dict[str, ColmapImage]:
    reader = _Reader(path)
    images: dict[str, ColmapImage] = {}
    for _ in range(reader.count(_IMAGE.size)):
        _, *pose, camera = reader.unpack(_IMAGE)
        name = reader.text()
        observations = reader.count(_OBSERVATION.itemsize)
        begin = reader.take(observations * _OBSERVATION.itemsize)
        seen = np.frombuffer(reader.data, _OBSERVATION, observations, begin)["point"]
        if name in images:
            raise FileFormatError(f"{path}: the image {name!r} is in it twice; create it again")
        images[name] = image_of(path, name, int(camera), pose, seen)
    return images


def _binary_points(path: Path) -> ColmapPoints:
    reader = _Reader(path)
    count = reader.count(_POINT.size)
    rows = np.empty((count, 4))
    number, track = np.empty(count, np.int64), np.empty(count, np.int64)
    for row in range(count):
        begin = reader.take(_POINT.size)
        point, x, y, z, _, _, _, error, length = _POINT.unpack_from(reader.data, begin)
        reader.take(length * _TRACK_ENTRY)
        rows[row] = x, y, z, error
        number[row], track[row] = np.uint64(point).astype(np.int64), length
    return points_of(path, number, rows, track)


def _text_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for line, text in _lines(path):
        words = text.split()
        if len(words) < 4:
            raise _invalid(path, line, text, "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS")
        needed = parameter_count(path, words[1])
        if len(words) != 4 + needed:
            raise FileFormatError(
                f"{path}, line {line}: a {words[1]} camera has {needed} parameters, not"
                f" {len(words) - 4}; create the model again"
            )
        try:
            number, width, height = (_whole(words[i]) for i in (0, 2, 3))
            parameters = [float(word) for word in words[4:]]
        except ValueError as error:
            raise _invalid(path, line, text, "numbers of a camera") from error
        cameras[number] = camera_of(path, words[1], (height, width), parameters)
    return cameras


def _text_images(path: Path) -> dict[str, ColmapImage]:
    """Each image has two lines, of which the second may be empty."""
    images: dict[str, ColmapImage] = {}
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
            pose, camera, name = [float(w) for w in words[1:8]], _whole(words[8]), words[9].strip()
            keypoints = following[1].split() if following else []
            if len(keypoints) % 3:
                raise ValueError("not triples")
            seen = np.array([int(word) for word in keypoints[2::3]], np.int64)
        except (ValueError, IndexError, OverflowError) as error:
            raise _invalid(
                path, line, text, "an image and its keypoints (or the file is cut short)"
            ) from error
        if name in images:
            raise FileFormatError(f"{path}: the image {name!r} is in it twice; create it again")
        images[name] = image_of(path, name, camera, pose, seen)
    return images


def _text_points(path: Path) -> ColmapPoints:
    numbers, rows, tracks = [], [], []
    for line, text in _lines(path):
        words = text.split()
        if len(words) < 8 or len(words) % 2:
            raise _invalid(path, line, text, "a point and its track (or the file is cut short)")
        try:
            numbers.append(_whole(words[0]))
            rows.append([float(words[i]) for i in (1, 2, 3, 7)])
        except ValueError as error:
            raise _invalid(path, line, text, "a point and its track") from error
        tracks.append((len(words) - 8) // 2)
    return points_of(
        path,
        np.array(numbers, np.int64),
        np.array(rows, np.float64).reshape(-1, 4),
        np.array(tracks, np.int64),
    )


def _lines(path: Path, *, with_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, without comments."""
    lines = read_bytes(path).decode("utf-8", "replace").split("\n")
    if lines[-1] == "":
        lines.pop()
    for number, line in enumerate(lines, start=1):
        if not line.startswith("#") and (with_empty or line.strip()):
            yield number, line


def _whole(text: str) -> int:
    if len(text) > _LONGEST_NUMBER:
        raise ValueError("too many digits")
    return int(text)


def _invalid(path: Path, line: int, text: str, wanted: str) -> FileFormatError:
    return FileFormatError(f"{path}, line {line}: {one_line(text)[:60]!r} is not {wanted}")
