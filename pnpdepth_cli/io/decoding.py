"""Images opened by Pillow, after what they claim is checked."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

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

warnings.filterwarnings("ignore", module=r"PIL\.")  # of damaged files, which are errors here


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

    The tags of a TIFF, the checksums of a PNG and the size that the header claims are checked. The
    kind is "PNG", "JPEG", "TIFF", "WEBP" or "HEIF".

    Raises:
        FileFormatError: The file is damaged or cut short, or exceeds the budget.
    """
    from PIL import Image

    stream = io.BytesIO(data)
    try:
        if kind == "TIFF":
            check_tags(data)
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
    except (*IMAGE_ERRORS, Image.DecompressionBombError) as error:
        # Pillow names the in-memory buffer, which means nothing to a reader
        reason = "unknown content or type of pixels" if "BytesIO" in str(error) else error
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
