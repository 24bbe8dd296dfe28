"""The bytes of an input file, and what kind of file they are."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.shared_context import Together

_MAGIC = (
    (b"\x89PNG\r\n\x1a\n", "PNG"),
    (b"\xff\xd8\xff", "JPEG"),
    (b"II*\x00", "TIFF"),
    (b"MM\x00*", "TIFF"),
    (b"v/1\x01", "EXR"),
    (b"\x93NUMPY", "NPY"),
    (b"PK\x03\x04", "NPZ"),
    (b"PK\x05\x06", "NPZ"),  # without any array
    (b"Pf", "PFM"),
    (b"PF", "PFM"),
)

MAX_PIXELS = 1 << 28
"""Larger pictures are refused before memory is set aside for them (16384 x 16384)."""


def read_bytes(path: Path) -> bytes:
    """The whole file. Raises InputError when there is none, or nothing in it."""
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except IsADirectoryError as error:
        raise InputError(f"{path} is a folder; give one file") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path} cannot be read ({reason.lower()}); check the path") from error
    if not data:
        raise FileFormatError(f"{path} is empty (0 bytes); copy or create it again")
    return data


def kind_of(data: bytes) -> str | None:
    """`PNG`, `JPEG`, `TIFF`, `WEBP`, `EXR`, `NPY`, `NPZ`, `PFM`, or None; by content alone."""
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WEBP"
    return next((kind for magic, kind in _MAGIC if data.startswith(magic)), None)


def damaged(path: Path, kind: str, fact: str) -> FileFormatError:
    """The error for a file that ends early or is corrupt."""
    return FileFormatError(f"{path}: {kind} {one_line(fact)}; copy or create the file again")


def one_line(text: object) -> str:
    """The text with runs of white space made single spaces, cut to a readable length."""
    line = " ".join(str(text).split())
    return line if len(line) <= 160 else line[:159] + "…"


def check_pixel_count(path: Path, width: int, height: int) -> None:
    """Raises FileFormatError for an empty picture or one beyond `MAX_PIXELS`."""
    if width < 1 or height < 1:
        raise FileFormatError(f"{path} has no pixels ({width}x{height}); create it again")
    if width * height > MAX_PIXELS:
        raise FileFormatError(
            f"{path} is {width}x{height} pixels, more than {MAX_PIXELS:,}; make it smaller"
        )


@contextmanager
def _silent_opencv() -> Iterator[None]:
    """OpenCV does not print several lines of its own about a damaged file."""
    import cv2

    loudness = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(loudness)


_SILENT_OPENCV = Together(_silent_opencv)


def decode_with_opencv(path: Path, data: bytes, kind: str) -> NDArray[Any]:
    """The pixels as stored, (H, W) or (H, W, C) with blue first, in the file's own type."""
    import cv2

    buffer = np.frombuffer(data, dtype=np.uint8)
    try:
        with _SILENT_OPENCV:
            pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise damaged(path, kind, f"cannot be decoded ({error})") from error
    if pixels is None:
        raise damaged(path, kind, "cannot be decoded")
    return pixels
