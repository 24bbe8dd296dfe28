"""How much one input file may take: bytes read and values decoded, checked before allocation.

The default follows from the machine's memory; `set_max_pixels` replaces it for the whole process,
all threads included.
"""

from __future__ import annotations

import functools
from pathlib import Path

from pnpdepth_cli.errors import InputError, ModelError

_MOST_PIXELS = 64_000_000
"""Pixels of the largest common cameras."""
_USUAL_FILE_BYTES = 1 << 30
"""Bytes that a stored file may have in any case, unless a number of pixels is set."""
_LEAST_FILE_BYTES = 1 << 20
"""Bytes that a file may have, however small the number of pixels is that is set."""
_FILE_BYTES_PER_PIXEL = 4
"""Bytes of a stored file for each pixel that an image may have."""
_DECODED_BYTES_PER_PIXEL = 8
"""Bytes of a decoded pixel: four channels of 16 bits."""
_BYTES_PER_PIXEL = 64
"""Bytes of memory for a pixel that reading and drawing an image take at most."""
_MOST_NETWORK_PIXELS = 4096 * 4096
"""The largest input of a published depth network is 1536×1536 (Depth Pro)."""
_BYTES_PER_NETWORK_PIXEL = 1024
"""Bytes of memory for a pixel: of 64 channels in float32, their gradients, and copies."""
_UNBACKED_VALUES = 1 << 25
"""Values that any file may claim to hold, however few bytes it has."""
_VALUES_PER_BYTE = 1032
"""Values that a byte of a file may claim beyond that: the highest ratio of deflate. No codec read
here is far above it."""


def max_pixels() -> int:
    """Returns how many pixels an image may have, or elements or rows any other array in a file.

    That is what `set_max_pixels` set, else what the machine's memory allows.
    """
    if _chosen_pixels:
        return _chosen_pixels
    return min(_MOST_PIXELS, _memory_bytes() // _BYTES_PER_PIXEL)


def max_network_pixels() -> int:
    """Returns how many pixels the input of a network may have whose file fixes the input's size.

    That is what `set_max_pixels` set, else what the machine's memory allows.
    """
    if _chosen_pixels:
        return _chosen_pixels
    return min(_MOST_NETWORK_PIXELS, _memory_bytes() // _BYTES_PER_NETWORK_PIXEL)


def max_file_bytes() -> int:
    """Returns how many bytes a file with an image, depth, points or text may have, as stored."""
    # A number of pixels that is set bounds small files, too.
    least = _LEAST_FILE_BYTES if _chosen_pixels else _USUAL_FILE_BYTES
    return max(least, _FILE_BYTES_PER_PIXEL * max_pixels())


def max_image_bytes() -> int:
    """Returns how many bytes an image or array may take, decoded but in its file's own type."""
    return max(_LEAST_FILE_BYTES, _DECODED_BYTES_PER_PIXEL * max_pixels())


def max_decoded_bytes() -> int:
    """Returns how many bytes one file's content may take, decoded, such as all of a checkpoint."""
    return _memory_bytes() // 2


def max_values_from(file_bytes: int) -> int:
    """Returns how many values a file may claim to hold, as no memory is taken for a false claim.

    Any file may claim 2²⁵ values: an image of one colour takes almost no bytes. More values need
    the bytes that they cannot be compressed below. No file may claim more than `max_pixels`.

    Args:
        file_bytes: Size of the file, as stored.
    """
    return min(max_pixels(), max(_UNBACKED_VALUES, _VALUES_PER_BYTE * file_bytes))


def check_claim(
    claim: str, size: int, most: int, *, error: type[Exception] = InputError, way_out: str = ""
) -> None:
    """Raises `error` if a file claims more than may be taken, or a number below 0.

    Every reader calls this with what a file claims, before memory is taken for it.

    Args:
        claim: What the file claims, as in "a.png has 9 pixels"; the message begins with it.
        size: The number that it claims, such as 9.
        most: The largest number that may be taken.
        error: Class of the error.
        way_out: What the user can do, which ends the message; empty for nothing.
    """
    if 0 <= size <= most:
        return
    if way_out:
        raise error(f"{claim}, more than {most:,}; {way_out}")
    raise error(f"{claim}, more than {most:,}")


def check_network_file(path: Path, kind: str, most: int | None = None) -> None:
    """Raises ModelError unless a file of a network, or of its weights, is there and may be read.

    A device, a pipe and an empty file may not, nor may a file that is too large.

    Args:
        path: The file.
        kind: What the message calls the file, as in "checkpoint".
        most: Most bytes that it may have. None: `max_decoded_bytes`.
    """
    if not path.exists():
        raise ModelError(f"{kind} {path} does not exist; check the path")
    if not path.is_file():
        raise ModelError(f"{kind} {path} is no regular file; save its content to a file first")
    size = path.stat().st_size
    if not size:  # also of what /proc shows as files, some of which never end
        raise ModelError(f"{kind} {path} is empty (0 bytes); copy or create it again")
    claim = f"{kind} {path} has {size:,} bytes"
    if most is None:
        most = max_decoded_bytes()
    check_claim(claim, size, most, error=ModelError)


def set_max_pixels(max_pixels: int | None) -> None:
    """Sets how many pixels an image may have, and the sizes of files in proportion to it.

    Args:
        max_pixels: Number of pixels. None: the default, by the machine's memory.
    """
    global _chosen_pixels
    _chosen_pixels = max_pixels


def max_pixels_given() -> int | None:
    """Returns what `set_max_pixels` was given; None for the default."""
    return _chosen_pixels


_chosen_pixels: int | None = None  # pixels that `set_max_pixels` was given


@functools.cache
def _memory_bytes() -> int:
    """The size of the machine's memory in bytes."""
    import psutil  # 20 ms that `--help` does not pay

    return int(psutil.virtual_memory().total)
