"""Images opened by Pillow or decoded by OpenCV, after what they claim is checked, in silence.

On damaged files OpenEXR's binding prints to sys.stdout, where data of a command belongs, Pillow
warns, and OpenCV, OpenEXR, libpng and libtiff print to the standard error of the process.
"""

from __future__ import annotations

import io
import os
import struct
import sys
import threading
import warnings
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged

if TYPE_CHECKING:
    import PIL.Image

_BYTES_OF_TYPE = {3: 2, 4: 4, 5: 8, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
_POINTERS = (34665, 34853, 40965)  # to further tags: Exif, GPS and interoperability
IMAGE_ERRORS = (
    *(OSError, SyntaxError, ValueError, EOFError, LookupError, ArithmeticError),
    *(RuntimeError, struct.error, zlib.error),  # RuntimeError: libheif
)
"""What Pillow and its plugins raise on damaged files."""
_END_OF_PNG = b"\xaeB`\x82"
"""The checksum of the last chunk, which Pillow does not read."""


def check_tags(data: bytes) -> None:
    """Checks the tags of all pages of a TIFF, or of EXIF, before a library copies them.

    Thousands of tags can share the same bytes, and so can pages.

    Raises:
        ValueError: The tags, or the pages, together claim more bytes than there are.
        struct.error: A page or a tag lies outside the data.
    """
    order = "<" if data[:2] == b"II" else ">"
    pages, seen = list(struct.unpack_from(f"{order}I", data, 4)), set[int]()
    claimed = of_pages = 0
    while pages:
        start = pages.pop()
        if start == 0 or start in seen:
            continue
        seen.add(start)
        end = start + 2 + 12 * struct.unpack_from(f"{order}H", data, start)[0]
        pages += struct.unpack_from(f"{order}I", data, end)  # the list of tags is complete
        of_pages += end - start
        if of_pages > len(data):
            raise ValueError("its pages overlap")
        for tag, kind, number, value in struct.iter_unpack(f"{order}HHII", data[start + 2 : end]):
            claimed += number * _BYTES_OF_TYPE.get(kind, 1)
            if claimed > len(data):
                raise ValueError(f"its tags claim more than {len(data):,} bytes")
            pages += [value] if tag in _POINTERS else []


def check_exif(image: PIL.Image.Image) -> None:
    """Raises the errors of `check_tags` for an image's EXIF, which may end without a next page."""
    exif = image.info.get("exif")
    if exif:
        check_tags(exif.removeprefix(b"Exif\0\0") + bytes(4))


@contextmanager
def open_image(path: Path, data: bytes, kind: str) -> Iterator[PIL.Image.Image]:
    """Yields the image of a file, not yet decoded; errors inside the block become ours.

    The checksums of a PNG and the size that the header claims are checked. The kind is "PNG",
    "JPEG", "TIFF", "WEBP" or "HEIF".

    Raises:
        FileFormatError: The file is damaged or cut short, or exceeds the budget.
    """
    from PIL import Image

    stream = io.BytesIO(data)
    try:
        with silence():
            if kind == "PNG":
                with Image.open(stream, formats=[kind]) as image:
                    image.verify()
                if stream.read(4) != _END_OF_PNG:
                    raise damaged(path, kind, f"is cut short after {len(data):,} bytes")
            with Image.open(stream, formats=[kind]) as image:
                # Pillow decodes three channels into four bytes
                channels = 1 if len(image.getbands()) == 1 else 4
                value_bytes = 4 if image.mode in "IF" else 2 if ";16" in raw_mode(image) else 1
                check_pixel_count(
                    path, *image.size, channels=channels, value_bytes=value_bytes,
                    file_bytes=len(data),
                )  # fmt: skip
                yield image
    except IMAGE_ERRORS as error:
        # Pillow names the in-memory buffer, which means nothing to a reader
        reason = "unknown content" if "BytesIO" in str(error) else error
        raise damaged(path, kind, f"cannot be decoded ({reason})") from error


def raw_mode(image: PIL.Image.Image) -> str:
    """Returns how a file that is not yet decoded stores its pixels, such as "RGB;16B"."""
    tiles = getattr(image, "tile", [])
    arguments = tiles[0][3] if tiles else ""  # no named tuple before Pillow 11
    return str(arguments[0] if isinstance(arguments, tuple) else arguments)


def orientation_of(image: PIL.Image.Image) -> int:
    """Returns the EXIF orientation 1..8, or another number that means nothing."""
    from PIL.ExifTags import Base

    try:
        check_exif(image)
        return int(image.getexif().get(Base.Orientation, 1))
    except IMAGE_ERRORS:  # unreadable EXIF in a valid image says nothing of its rotation
        return 1


def decode_with_opencv(path: Path, data: bytes, kind: str) -> NDArray[Any]:
    """Returns the pixels in the file's own type, (H, W) or (H, W, C) with blue first.

    Pillow cuts colours of 16 bits to 8.

    Raises:
        FileFormatError: OpenCV cannot decode it.
    """
    import cv2

    buffer = np.frombuffer(data, dtype=np.uint8)
    try:
        with silence():
            pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise damaged(path, kind, f"cannot be decoded ({error})") from error
    if pixels is None:
        raise damaged(path, kind, "cannot be decoded")
    return pixels


_lock = threading.Lock()
_silent: list[int] = []
"""Identifiers of the silent threads, as often as each has entered."""
_before = ExitStack()
"""What the last of them restores."""


@contextmanager
def silence() -> Iterator[None]:
    """Drops what libraries say inside the block, in any number of threads; may be nested.

    What they print to standard error is dropped only while no other thread runs, because theirs
    would be lost too. Pillow accepts images of any size, which the budget bounds.
    """
    with _lock:
        if not _silent:
            _before.enter_context(_state_for_silence())
        _silent.append(threading.get_ident())
    try:
        with _without_standard_error():
            yield
    finally:
        with _lock:
            _silent.remove(threading.get_ident())
            if not _silent:
                _before.close()


@contextmanager
def _state_for_silence() -> Iterator[None]:
    """Sets what all threads share: sys.stdout, warnings, limits and log levels."""
    import cv2
    from PIL import Image

    stdout, limit = sys.stdout, Image.MAX_IMAGE_PIXELS
    log: Any = getattr(cv2.utils, "logging", cv2)  # cv2 itself before OpenCV 4.13
    level = log.setLogLevel(0)
    ours: Any = _OthersOnly(stdout)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sys.stdout, Image.MAX_IMAGE_PIXELS = ours, None
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = limit
            if sys.stdout is ours:
                sys.stdout = stdout
            log.setLogLevel(level)


class _OthersOnly:
    """A stream that passes on what all but the silent threads write."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        return len(text) if threading.get_ident() in _silent else int(self._stream.write(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def _without_standard_error() -> Iterator[None]:
    with ExitStack() as after:
        if threading.active_count() == 1:
            with suppress(OSError):  # it is closed
                kept = os.dup(2)
                after.callback(os.close, kept)
                after.callback(os.dup2, kept, 2)
                nothing = os.open(os.devnull, os.O_WRONLY)
                after.callback(os.close, nothing)
                os.dup2(nothing, 2)
        yield
