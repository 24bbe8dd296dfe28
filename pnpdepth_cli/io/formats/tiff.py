"""TIFF: one channel of float metres or 16-bit codes, of its first page."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.decoding import check_tags, decode_with_opencv, silence
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged
from pnpdepth_cli.io.formats import DepthFormat, StoredArray, eight_bits, scale_in_text

_WIDTH, _HEIGHT, _BITS, _DESCRIPTION, _SAMPLES, _FORMAT = 256, 257, 258, 270, 277, 339
_BLOCK_TAGS = ((273, 279), (324, 325))  # offsets and byte counts, of strips or of tiles
_NUMBERS = {2: "int", 3: "float"}


class TiffFacts(NamedTuple):
    """Tags of the first page."""

    bits: int
    """Bits of one sample."""
    number: str
    """Kind of the samples: "uint", "int" or "float"."""
    samples: int
    """Channels of a pixel."""
    description: str
    """The image description; empty without one."""


def read_tiff_facts(path: Path, data: bytes) -> TiffFacts:
    """Returns the tags of the first page, also of pixels that Pillow does not open.

    Raises:
        FileFormatError: Tags or pixels lie outside the file, or the image exceeds the budget.
    """
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    try:
        check_tags(data)
        with silence():
            tags: Any = ImageFileDirectory_v2(data[:8])
            stream = io.BytesIO(data)
            stream.seek(tags.next)
            tags.load(stream)
        width, height, samples = tags[_WIDTH], tags[_HEIGHT], tags.get(_SAMPLES, 1)
        bits, number = (tags.get(tag, (1,))[0] for tag in (_BITS, _FORMAT))
        blocks = [zip(tags[a], tags[b], strict=True) for a, b in _BLOCK_TAGS if a in tags]
        end = max(sum(block) for of_kind in blocks for block in of_kind)
        description = str(tags.get(_DESCRIPTION, ""))
        if end > len(data):
            raise damaged(path, "TIFF", f"is cut short: {len(data):,} of {end:,} bytes")
        check_pixel_count(
            path, int(width), int(height), channels=int(samples),
            value_bytes=max(1, int(bits) // 8), file_bytes=len(data),
        )  # fmt: skip
    except FileFormatError:
        raise
    except Exception as error:  # Pillow raises many kinds on damaged tags
        raise damaged(path, "TIFF", f"is cut short or corrupt ({error})") from error
    return TiffFacts(int(bits), _NUMBERS.get(number, "uint"), int(samples), description)


def _read(path: Path, data: bytes, channel: str | None) -> StoredArray:
    facts = read_tiff_facts(path, data)
    if facts.samples != 1:
        raise FileFormatError(
            f"{path} is a TIFF with {facts.samples} channels; depth is one channel, save it so"
        )
    if (facts.number, facts.bits) not in (("uint", 16), ("float", 32), ("float", 64)):
        if facts.bits <= 8:
            raise eight_bits(path, "TIFF")
        raise FileFormatError(
            f"{path} is a {facts.bits}-bit {facts.number} TIFF; save depth as float32 or uint16"
        )
    values = decode_with_opencv(path, data, "TIFF")  # Pillow has no 64-bit floats
    if values.ndim != 2 or values.dtype.itemsize * 8 != facts.bits:
        raise damaged(path, "TIFF", "cannot be decoded as one channel")
    description = f"{facts.bits}-bit {'float ' if facts.number == 'float' else ''}TIFF"
    scale = scale_in_text(path, facts.description)
    return StoredArray(values=values, description=description, scale=scale)


def _write(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    from PIL import Image

    Image.fromarray(metres).save(file, "TIFF", compression="tiff_adobe_deflate")


FORMAT = DepthFormat(
    name="TIFF",
    suffixes=(".tif", ".tiff"),
    magic=(b"II*\x00", b"MM\x00*"),
    read=_read,
    write=_write,
)
