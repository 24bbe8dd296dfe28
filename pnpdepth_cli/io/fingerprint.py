"""What a file is known by: size and time of change, which are quick to see, and its digest."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.record import sha256_of


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """size: in bytes. mtime_ns: when it was changed last. sha256: of its content, hexadecimal."""

    size: int
    mtime_ns: int
    sha256: str


def fingerprint(path: Path) -> Fingerprint:
    """What the file is known by. InputError if it cannot be read."""
    size, mtime_ns = _seen(path)
    return Fingerprint(size=size, mtime_ns=mtime_ns, sha256=_digest(path, size, mtime_ns))


def is_unchanged(path: Path, known: Fingerprint) -> bool:
    """True if the file is there and has that content; only a file with a new time is read."""
    try:
        size, mtime_ns = _seen(path)
        if size != known.size:
            return False
        return mtime_ns == known.mtime_ns or _digest(path, size, mtime_ns) == known.sha256
    except InputError:
        return False


def _seen(path: Path) -> tuple[int, int]:
    try:
        found = path.stat()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{path} cannot be read ({reason}); check the path") from error
    return found.st_size, found.st_mtime_ns


# Several frames may share one file: a calibration, or gigabytes of HDF5.
@functools.lru_cache(maxsize=64)
def _digest(path: Path, size: int, mtime_ns: int) -> str:
    return sha256_of(path)
