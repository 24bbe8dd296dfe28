"""What identifies a file's content: size and time, which are quick to read, and its digest."""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import cannot_read
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.remote import Listing, RemotePath, local_files, status_of


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """Size in bytes, times and digest of a file when it was read."""

    size: int
    sha256: str
    mtime_ns: int = 0
    """When the content was changed last, as programs may set it; 0 of an object in a store."""
    ctime_ns: int = 0  # when content or properties were changed last, which programs cannot set
    version: str = ""  # of an object in a store, as the store calls it; empty for a file

    def as_record(self) -> dict[str, Any]:
        """Returns the fields that are known."""
        return {name: value for name, value in asdict(self).items() if value}


def fingerprint(path: Path, copy: Path | None = None) -> Fingerprint:
    """Returns the fingerprint of a file, or of an object from a local copy of it.

    Raises:
        InputError: It cannot be read.
        StorageError: The store cannot be reached.
    """
    if isinstance(path, RemotePath):
        status = status_of(path)
        if copy is None or status is None:
            raise InputError(f"{path} is in a store; copy the file first")
        return Fingerprint(size=status.size, version=status.version, sha256=sha256_of(copy))
    size, mtime_ns, ctime_ns = now = _size_and_times(path)
    return Fingerprint(size=size, mtime_ns=mtime_ns, ctime_ns=ctime_ns, sha256=_digest(path, *now))


def is_unchanged(path: Path, known: Fingerprint, listing: Listing) -> bool:
    """Returns whether the file is there with that content; it is read unless no time differs.

    Raises:
        StorageError: The store cannot be reached.
    """
    try:
        if isinstance(path, RemotePath):
            status = listing.status(path)
            if status is None or status.version:
                return status is not None and status.version == known.version
            with local_files([path]) as copies:
                return sha256_of(copies[path]) == known.sha256
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
