"""What identifies a file's content: size and time, which are quick to read, and its digest."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import cannot_read
from pnpdepth_cli.io.json_file import sha256_of


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
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        raise cannot_read(path, error) from error
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


# Several frames may share one file: a calibration, or gigabytes of HDF5.
@functools.lru_cache(maxsize=64)
def _digest(path: Path, size: int, mtime_ns: int, ctime_ns: int) -> str:
    return sha256_of(path)
