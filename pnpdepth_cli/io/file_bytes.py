"""The bytes of an input file, within the budget of `pnpdepth_cli.budget`, and their digest."""

from __future__ import annotations

import functools
import hashlib
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.budget import budget, check_claim
from pnpdepth_cli.errors import FileFormatError, InputError

_LONGEST_TEXT = 1 << 20
"""Bytes of a calibration or a pose; one has a few thousand."""
_SMALLER = "make it smaller, or allow more with --max-pixels"


def read_bytes(path: Path) -> bytes:
    """Returns the whole content of a regular file.

    Raises:
        InputError: There is no such file, or it is a folder, a device or a pipe.
        FileFormatError: It is empty, or larger than the budget.
    """
    size, limit = size_of_regular_file(path), budget().max_file_bytes
    check_claim(f"{path} has {size:,} bytes", size, limit, way_out=_SMALLER)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise cannot_read(path, error) from error
    if not data:
        raise FileFormatError(f"{path} is empty (0 bytes); copy or create it again")
    return data


def numbered_lines(data: bytes) -> Iterator[tuple[int, str]]:
    """Yields the lines of a text that hold more than a comment after #, with their numbers."""
    for number, line in enumerate(data.decode("utf-8-sig", "replace").splitlines(), 1):
        text = line.partition("#")[0].strip()
        if text:
            yield number, text


def read_text(path: Path) -> str:
    """Returns a calibration or the like. Raises FileFormatError if it is larger than any is."""
    size = size_of_regular_file(path)
    check_claim(f"{path} has {size:,} bytes", size, _LONGEST_TEXT, way_out="give another file")
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is not a text file; give another") from error


def size_of_regular_file(path: Path) -> int:
    """Returns the size of a file in bytes.

    Raises:
        InputError: There is no such file, or it is a folder, a device or a pipe.
    """
    status = _status(path)
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path} is a folder; give one file")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is a device or a pipe; save its content to a file first")
    return status.st_size


def _status(path: Path) -> os.stat_result:
    try:
        return path.stat()
    except (OSError, ValueError) as error:
        raise cannot_read(path, error) from error


def cannot_read(path: Path, error: OSError | ValueError) -> InputError:
    """Returns the error that says why a file cannot be read."""
    if isinstance(error, (FileNotFoundError, NotADirectoryError)):
        return InputError(f"{path}: no such file; check the path")
    reason = one_line(getattr(error, "strerror", None) or error).lower()
    return InputError(f"{one_line(path)} cannot be read ({reason}); check the path")


def damaged(path: Path, kind: str, fact: str) -> FileFormatError:
    """Returns the error for a file that ends early or is corrupt."""
    return FileFormatError(f"{path}: {kind} {one_line(fact)}; copy or create the file again")


def one_line(text: object) -> str:
    """Returns the text with runs of white space made single spaces, cut to a readable length."""
    line = " ".join(str(text).split())
    return line if len(line) <= 160 else line[:159] + "…"


def check_pixel_count(
    path: Path,
    width: int,
    height: int,
    *,
    channels: int = 1,
    value_bytes: int = 1,
    file_bytes: int | None = None,
) -> None:
    """Raises FileFormatError for an image without pixels, or with more than the budget.

    To be called with what the header of a file claims, before `channels` values of `value_bytes`
    are decoded for each pixel; with `file_bytes` where few bytes of the format claim any size.
    """
    if width < 1 or height < 1:
        raise FileFormatError(f"{path} has no pixels ({width}x{height}); create it again")
    what, pixel_bytes = f"{width}x{height} pixels", channels * value_bytes
    check_value_count(path, width * height, file_bytes, value_bytes=pixel_bytes, what=what)


def check_value_count(
    path: Path,
    count: int,
    file_bytes: int | None = None,
    *,
    value_bytes: int = 1,
    what: str | None = None,
) -> None:
    """Raises FileFormatError for an array of more values than the budget."""
    what = what or f"{count:,} values"
    limits, decoded = budget(), count * value_bytes
    check_claim(f"{path} has {what}", count, limits.max_pixels, way_out=_SMALLER)
    as_bytes = f"{path} has {what} in {decoded:,} bytes"
    check_claim(as_bytes, decoded, limits.max_image_bytes, way_out=_SMALLER)
    if file_bytes is not None:
        claim = f"{path} claims {what} in {file_bytes:,} bytes"
        check_claim(claim, count, limits.max_values_from(file_bytes), way_out="create it again")


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """Size in bytes, times and digest of a file when it was read."""

    size: int
    sha256: str
    mtime_ns: int  # when the content was changed last, as programs may set it
    ctime_ns: int  # when content or properties were changed last, which programs cannot set


def fingerprint(path: Path) -> Fingerprint:
    """Returns the fingerprint of a file. Raises InputError if it cannot be read."""
    size, mtime_ns, ctime_ns = now = _size_and_times(path)
    return Fingerprint(size=size, mtime_ns=mtime_ns, ctime_ns=ctime_ns, sha256=_digest(path, *now))


def is_unchanged(path: Path, known: Fingerprint) -> bool:
    """Returns whether the file is there with that content; it is read unless no time differs."""
    try:
        now = _size_and_times(path)
        if now == (known.size, known.mtime_ns, known.ctime_ns):
            return True
        return now[0] == known.size and _digest(path, *now) == known.sha256
    except InputError:
        return False


def _size_and_times(path: Path) -> tuple[int, int, int]:
    status = _status(path)
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


# Several frames may share one file: a calibration, a list, or a video.
@functools.lru_cache(maxsize=64)
def _digest(path: Path, size: int, mtime_ns: int, ctime_ns: int) -> str:
    return sha256_of(path)


def sha256_of(path: Path) -> str:
    """Returns the SHA-256 of the file's content, 64 hexadecimal digits.

    Of a folder, that of its files' names and digests, in the order of the names.

    Raises:
        InputError: The file cannot be read, or is a device or a pipe.
    """
    digest = hashlib.sha256()
    if path.is_dir():
        for inside in sorted(path.iterdir()):
            if inside.is_file():
                digest.update(f"{inside.name} {sha256_of(inside)}\n".encode())
        return digest.hexdigest()
    size_of_regular_file(path)
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise cannot_read(path, error) from error
    return digest.hexdigest()
