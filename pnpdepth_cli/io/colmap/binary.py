"""cameras.bin, images.bin and points3D.bin; every count is checked against the bytes there are."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.colmap.parts import (
    NAME_OF_NUMBER,
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    camera_of,
    image_of,
    parameter_count,
    points_of,
)
from pnpdepth_cli.io.file_bytes import damaged, read_bytes

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK_ENTRY = 8


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

    def unpack(self, layout: struct.Struct) -> tuple[float, ...]:
        """Returns the numbers of the layout."""
        return layout.unpack_from(self.data, self.take(layout.size))

    def count(self, smallest: int) -> int:
        """Returns the number of records that follow, each of at least so many bytes."""
        (count,) = _COUNT.unpack_from(self.data, self.take(_COUNT.size))
        if count * smallest > len(self.data) - self.position:
            raise damaged(
                self.path,
                "COLMAP model",
                f"claims {count:,} records in {len(self.data):,} bytes; it is cut short or wrong",
            )
        return int(count)

    def text(self) -> str:
        """Returns the text up to the next zero byte."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise damaged(self.path, "COLMAP model", "is cut short in the name of an image")
        return self.data[self.take(end + 1 - self.position) : end].decode("utf-8", "replace")


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Returns the cameras of cameras.bin by number."""
    reader = _Reader(path)
    cameras = {}
    for _ in range(reader.count(_CAMERA.size)):
        number, model, width, height = (int(value) for value in reader.unpack(_CAMERA))
        name = NAME_OF_NUMBER.get(model, f"number {model}")
        parameters = reader.unpack(struct.Struct(f"<{parameter_count(path, name)}d"))
        cameras[number] = camera_of(path, name, (height, width), parameters)
    return cameras


def read_images(path: Path) -> dict[str, ColmapImage]:
    """Returns the images of images.bin by name."""
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


def read_points(path: Path) -> ColmapPoints:
    """Returns the points of points3D.bin."""
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
