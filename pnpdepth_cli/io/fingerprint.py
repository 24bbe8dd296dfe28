"""What identifies a file's content: size and times, which are quick to read, and its digest."""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.io.remote.copies import copies
from pnpdepth_cli.io.remote.store import Status, StatusIndex, status_of


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

    version: str = ""
    """Of an object in a store, as the store calls it; empty for a file."""

    def as_record(self) -> dict[str, Any]:
        """Returns the fields for a journal, without an empty version."""
        return {name: value for name, value in asdict(self).items() if value != ""}


def fingerprint(path: Path) -> Fingerprint:
    """Returns the fingerprint of a file. Raises InputError if it cannot be read."""
    if isinstance(path, RemotePath):
        with copies().held(path) as (file, status):
            return fingerprint_of_object(file, status)
    size, mtime_ns, ctime_ns = _status(path)
    digest = _digest(path, size, mtime_ns, ctime_ns)
    return Fingerprint(size=size, mtime_ns=mtime_ns, ctime_ns=ctime_ns, sha256=digest)


def fingerprint_of_object(copy: Path, status: Status) -> Fingerprint:
    """Returns the fingerprint of an object in a store, from a local copy of it."""
    return Fingerprint(
        size=status.size, mtime_ns=0, version=status.version, sha256=fingerprint(copy).sha256
    )


def is_unchanged(path: Path, known: Fingerprint, index: StatusIndex | None = None) -> bool:
    """Returns whether the file is there with that content; it is read unless no time differs.

    Args:
        path: The file.
        known: As it was.
        index: Of objects in a store; None asks the store.

    Raises:
        StorageError: The store cannot be reached.
    """
    if isinstance(path, RemotePath):
        return _is_unchanged_object(path, known, index)
    try:
        size, mtime_ns, ctime_ns = _status(path)
        if size != known.size:
            return False
        if (mtime_ns, ctime_ns) == (known.mtime_ns, known.ctime_ns):
            return True
        return _digest(path, size, mtime_ns, ctime_ns) == known.sha256
    except InputError:
        return False


def _is_unchanged_object(path: RemotePath, known: Fingerprint, index: StatusIndex | None) -> bool:
    status = status_of(path) if index is None else index.status(path)
    if status is None or status.size != known.size:
        return False
    if known.version and status.version == known.version:
        return True
    try:
        return fingerprint(path).sha256 == known.sha256
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
