"""Images opened by Pillow, after what they claim is checked."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged, one_line
from pnpdepth_cli.io.shared_context import SharedContext
from pnpdepth_cli.io.tiff_tags import read_tags

if TYPE_CHECKING:
    import PIL.Image

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
                    file_bytes=len(data) * channels,
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
