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
_MOST_FILE_BYTES = 1 << 30
"""Bytes of a stored file, unless another number of pixels is set."""
_LEAST_FILE_BYTES = 1 << 20
"""Bytes that a file may have however few pixels are set."""
_FILE_BYTES_PER_PIXEL = 4
_DECODED_BYTES_PER_PIXEL = 8
"""Bytes of four channels of 16 bits."""
_BYTES_PER_PIXEL = 64
"""Memory that reading and drawing takes at most."""
_MOST_NETWORK_PIXELS = 4096 * 4096
"""The largest input of a published depth network is 1536×1536 (Depth Pro)."""
_BYTES_PER_NETWORK_PIXEL = 1024
"""Memory of 64 channels in float32, their gradients, and copies."""
_UNBACKED_VALUES = 1 << 25
"""Values that any file may claim."""
_VALUES_PER_BYTE = 1032
"""The highest ratio of deflate; no codec read here is far above it."""


def max_pixels() -> int:
    """Returns how many pixels an image may have, and rows or elements another array of numbers."""
    if _chosen:
        return _chosen
    return min(_MOST_PIXELS, _memory_bytes() // _BYTES_PER_PIXEL)


def max_network_pixels() -> int:
    """Returns how many pixels the image may have that a network takes, if its file fixes a size."""
    if _chosen:
        return _chosen
    return min(_MOST_NETWORK_PIXELS, _memory_bytes() // _BYTES_PER_NETWORK_PIXEL)


def max_file_bytes() -> int:
    """Returns how many bytes a file with an image, depth, points or text may have, as stored."""
    least = _LEAST_FILE_BYTES if _chosen else _MOST_FILE_BYTES
    return max(least, _FILE_BYTES_PER_PIXEL * max_pixels())


def max_image_bytes() -> int:
    """Returns how many bytes an image or array may take, decoded but in its file's own type."""
    return max(_LEAST_FILE_BYTES, _DECODED_BYTES_PER_PIXEL * max_pixels())


def max_decoded_bytes() -> int:
    """Returns how many bytes one file's content may take, decoded, such as all of a checkpoint."""
    return _memory_bytes() // 2


def max_values_from(file_bytes: int) -> int:
    """Returns how many values a file of so many bytes may claim to hold.

    Any file may claim 2²⁵ values: an image of one colour takes almost no bytes. More values need
    the bytes that they cannot be compressed below.
    """
    return min(max_pixels(), max(_UNBACKED_VALUES, _VALUES_PER_BYTE * file_bytes))


def check_claim(
    claim: str, size: int, most: int, *, error: type[Exception] = InputError, way_out: str = ""
) -> None:
    """Raises the error if a file claims more than may be taken, or less than nothing.

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
    """Sets the most pixels of an image, and of files in proportion; None restores the default."""
    global _chosen
    _chosen = max_pixels


def max_pixels_given() -> int | None:
    """Returns what `set_max_pixels` was given; None for the default."""
    return _chosen


_chosen: int | None = None  # pixels that `set_max_pixels` was given


@functools.cache
def _memory_bytes() -> int:
    """The machine's memory."""
    import psutil  # 20 ms that `--help` does not pay

    return int(psutil.virtual_memory().total)
