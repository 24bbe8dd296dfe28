"""Images opened by Pillow or decoded by OpenCV, after what they claim is checked."""

from __future__ import annotations

import io
import struct
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged, one_line
from pnpdepth_cli.io.quiet import SharedContext, quiet_libraries

if TYPE_CHECKING:
    import PIL.Image

_LETTER_OF_TYPE = {1: "B", 2: "B", 3: "H", 4: "I", 5: "Q", 7: "B", 10: "q", 11: "f", 12: "d"}

_BASELINE_TAGS = range(254, 340)
_MOST_NUMBERS = 1 << 20
"""Of a tag; 64 megapixels have fewer strips or tiles."""


def read_tags(data: bytes) -> defaultdict[int, tuple[int, ...]]:
    """Returns the numbers of the first page's baseline tags; none for one that is absent.

    Thousands of tags can share the same bytes, which libraries copy for each.

    Raises:
        ValueError: The tags together claim more bytes than there are, or one has too many numbers.
        struct.error: A tag points outside the data.
    """
    order = "<" if data[:2] == b"II" else ">"
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, start)
    end = start + 2 + 12 * count
    struct.unpack_from(f"{order}I", data, end)  # where the next page is: the list is complete
    tags: defaultdict[int, tuple[int, ...]] = defaultdict(tuple)
    claimed = 0
    for entry in range(start + 2, end, 12):
        tag, kind, number = struct.unpack_from(f"{order}HHI", data, entry)
        layout = f"{order}{number}{_LETTER_OF_TYPE.get(kind, 'B')}"
        size = struct.calcsize(layout)
        claimed += size
        if claimed > len(data):
            raise ValueError(f"its tags claim more than {len(data):,} bytes")
        if not _BASELINE_TAGS.start <= tag < _BASELINE_TAGS.stop:
            continue
        if number > _MOST_NUMBERS:
            raise ValueError(f"tag {tag} has {number:,} numbers")
        (where,) = (entry + 8,) if size <= 4 else struct.unpack_from(f"{order}I", data, entry + 8)
        tags[tag] = struct.unpack_from(layout, data, where)
    return tags


_EXIF_ORIENTATION = 0x0112
_END_OF_PNG = b"\xaeB`\x82"
"""The checksum of the last chunk, which Pillow does not read."""


@contextmanager
def opened_image(path: Path, data: bytes, kind: str) -> Iterator[PIL.Image.Image]:
    """Yields the image of a file, not yet decoded; errors inside the block become ours.

    The checksums of a PNG and the size that the header claims are checked.

    Args:
        path: Named in messages.
        data: Content of the file.
        kind: "PNG", "JPEG", "TIFF" or "WEBP".

    Raises:
        FileFormatError: The file is damaged or cut short, or exceeds the budget.
    """
    from PIL import Image

    stream = io.BytesIO(data)
    try:
        with QUIET_PILLOW:
            if kind == "PNG":
                with Image.open(stream, formats=[kind]) as image:
                    image.verify()
                if stream.read(4) != _END_OF_PNG:
                    raise damaged(path, kind, f"is cut short after {len(data):,} bytes")
            with Image.open(stream, formats=[kind]) as image:
                width, height = image.size
                # Pillow decodes three channels into four bytes
                channels = 1 if len(image.getbands()) == 1 else 4
                wide = ";16" in raw_mode(image)
                check_pixel_count(
                    path, width, height, channels=channels, value_bytes=1 + wide,
                    file_bytes=len(data),
                )  # fmt: skip
                yield image
    except FileFormatError:
        raise
    except Exception as error:  # Pillow's plugins raise many kinds on damaged files
        kinds = {"truncated": "is cut short", "checksum": "has a wrong checksum"}
        text = str(error).lower()
        fact = next((f for word, f in kinds.items() if word in text), "cannot be decoded")
        raise damaged(path, kind, f"{fact} ({_reason(error)})") from error


def raw_mode(image: PIL.Image.Image) -> str:
    """Returns how a file that is not yet decoded stores its pixels, such as "RGB;16B"."""
    tiles = getattr(image, "tile", [])
    arguments = tiles[0].args if tiles else ""
    return str(arguments[0] if isinstance(arguments, tuple) else arguments)


def orientation_of(image: PIL.Image.Image) -> int:
    """Returns the EXIF orientation 1..8, or another number that means nothing."""
    try:
        exif = image.info.get("exif", b"")
        if exif:
            read_tags(exif.removeprefix(b"Exif\0\0") + bytes(4))  # without a next page
        return int(image.getexif().get(_EXIF_ORIENTATION, 1))
    except Exception:  # unreadable EXIF in a valid image says nothing of its rotation
        return 1


def _reason(error: Exception) -> str:
    text = one_line(error)
    # Pillow names the in-memory buffer, which means nothing to a reader.
    return "unknown content" if "BytesIO" in text else text or type(error).__name__


@contextmanager
def _quiet_pillow() -> Iterator[None]:
    """Pillow neither warns of damaged EXIF nor refuses large images, which the budget does."""
    from PIL import Image

    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


QUIET_PILLOW = SharedContext(_quiet_pillow)
"""While it is open, in any number of threads, Pillow does not warn."""


def decode_with_opencv(path: Path, data: bytes, kind: str) -> NDArray[Any]:
    """Returns the pixels in the file's own type, (H, W) or (H, W, C) with blue first.

    Args:
        path: Named in messages.
        data: Content of the file.
        kind: The kind of file that messages name.

    Raises:
        FileFormatError: OpenCV cannot decode it.
    """
    import cv2

    buffer = np.frombuffer(data, dtype=np.uint8)
    try:
        with _SILENT_OPENCV, quiet_libraries():
            pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise damaged(path, kind, f"cannot be decoded ({error})") from error
    if pixels is None:
        raise damaged(path, kind, "cannot be decoded")
    return pixels


@contextmanager
def _silent_opencv() -> Iterator[None]:
    """OpenCV does not print several lines of its own about a damaged file."""
    import cv2

    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


_SILENT_OPENCV = SharedContext(_silent_opencv)
