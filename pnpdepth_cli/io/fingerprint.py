"""What identifies a file's content: size and times, which are quick to read, and its digest."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.record import sha256_of


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """Size, times and digest of a file when it was read or written."""

    size: int
    """Bytes."""

    mtime_ns: int
    """When the content was changed last, as programs may set it."""

    sha256: str
    """Of the content, hexadecimal."""

    ctime_ns: int = 0
    """When content or properties were changed last, which programs cannot set; 0 if unknown."""


def fingerprint(path: Path) -> Fingerprint:
    """Returns the fingerprint of a file. Raises InputError if it cannot be read."""
    size, mtime_ns, ctime_ns = _status(path)
    digest = _digest(path, size, mtime_ns, ctime_ns)
    return Fingerprint(size=size, mtime_ns=mtime_ns, ctime_ns=ctime_ns, sha256=digest)


def is_unchanged(path: Path, known: Fingerprint) -> bool:
    """Returns whether the file is there with that content; it is read unless no time differs."""
    try:
        size, mtime_ns, ctime_ns = _status(path)
        if size != known.size:
            return False
        if (mtime_ns, ctime_ns) == (known.mtime_ns, known.ctime_ns):
            return True
        return _digest(path, size, mtime_ns, ctime_ns) == known.sha256
    except InputError:
        return False


def _status(path: Path) -> tuple[int, int, int]:
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        reason = one_line(getattr(error, "strerror", None) or error).lower()
        raise InputError(f"{path} cannot be read ({reason}); check the path") from error
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


# Several frames may share one file: a calibration, or gigabytes of HDF5.
@functools.lru_cache(maxsize=64)
def _digest(path: Path, size: int, mtime_ns: int, ctime_ns: int) -> str:
    return sha256_of(path)
