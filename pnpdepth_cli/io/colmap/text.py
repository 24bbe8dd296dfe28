"""cameras.txt, images.txt and points3D.txt."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.colmap.parts import (
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    camera_of,
    image_of,
    parameter_count,
    points_of,
)
from pnpdepth_cli.io.file_bytes import one_line, read_bytes

_LONGEST_NUMBER = 18
"""Digits of a whole number that fits 64 bits."""


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Returns the cameras of cameras.txt by number."""
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


def read_images(path: Path) -> dict[str, ColmapImage]:
    """Returns the images of images.txt by name; each has two lines, of which one may be empty."""
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


def read_points(path: Path) -> ColmapPoints:
    """Returns the points of points3D.txt."""
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
