"""Local copies of files in a store: a bounded cache, which ends with the process."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pnpdepth_cli.budget import budget
from pnpdepth_cli.errors import FileFormatError, InputError, StorageError
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.io.remote.store import Status, download, status_of

_MAX_BYTES = 1 << 30
"""Of copies that nobody reads; they are kept for calibrations and neighbours."""
_PREFIX = "pnpdepth-copies-"


@dataclass(kw_only=True)
class _Copy:
    """A copy, or one that is being made."""

    file: Path
    """Where it is."""
    making: threading.Lock = field(default_factory=threading.Lock)
    """Held while it is made."""
    status: Status | None = None
    """Of the object when it was copied; None before."""
    readers: int = 0
    """How many read it."""


class Copies:
    """Local copies by their address; those not read for longest are removed first.

    Args:
        folder: Where they are.
        max_bytes: Of copies that nobody reads.
    """

    def __init__(self, folder: Path, max_bytes: int = _MAX_BYTES) -> None:
        self.folder = folder
        self._max_bytes = max_bytes
        self._copies: OrderedDict[str, _Copy] = OrderedDict()
        self._changing = threading.Lock()
        self._made = 0

    @contextmanager
    def held(self, path: RemotePath) -> Iterator[tuple[Path, Status]]:
        """Yields a copy and the status of its object; the copy stays until the block ends.

        Raises:
            InputError: There is no such object, or it may not be read.
            FileFormatError: It is larger than the budget of readers.
            StorageError: The store cannot be reached, or the disk is full.
        """
        copy = self._taken(path)
        try:
            with copy.making:
                if copy.status is None:
                    copy.status = _copied(path, copy.file)
            yield copy.file, copy.status
        finally:
            self._released(str(path), copy)

    def _taken(self, path: RemotePath) -> _Copy:
        with self._changing:
            copy = self._copies.get(str(path))
            if copy is None:
                self._made += 1
                file = self.folder / str(self._made) / path.name
                copy = self._copies[str(path)] = _Copy(file=file)
            self._copies.move_to_end(str(path))
            copy.readers += 1
            return copy

    def _released(self, key: str, copy: _Copy) -> None:
        with self._changing:
            copy.readers -= 1
            if copy.status is None and not copy.readers and self._copies.get(key) is copy:
                del self._copies[key]
            free = {k: c for k, c in self._copies.items() if not c.readers and c.status}
            total = sum(c.status.size for c in free.values() if c.status)
            for name, each in free.items():
                if total <= self._max_bytes:
                    break
                assert each.status is not None
                total -= each.status.size
                del self._copies[name]
                shutil.rmtree(each.file.parent, ignore_errors=True)


def _copied(path: RemotePath, file: Path) -> Status:
    status = status_of(path)
    if status is None:
        raise InputError(f"{path}: no such object; check the address")
    limit = budget().max_file_bytes
    if status.size < 0:
        raise FileFormatError(f"{path}: its server does not say its size; copy the file first")
    if status.size > limit:
        raise FileFormatError(
            f"{path} has {status.size:,} bytes, more than {limit:,}; make it smaller, or allow more"
            " with --max-pixels"
        )
    file.parent.mkdir(parents=True)
    try:
        download(path, file, status.size)
        size = file.stat().st_size
    except BaseException as error:
        shutil.rmtree(file.parent, ignore_errors=True)
        if not isinstance(error, OSError):
            raise
        raise StorageError(
            f"{path} cannot be copied to {file.parent} ({error.strerror}); set TMPDIR to a larger"
            " disk"
        ) from error
    if size != status.size:
        raise InputError(f"{path} was replaced while it was read; run again")
    return status


_lock = threading.Lock()
_own: Copies | None = None


def copies() -> Copies:
    """Returns the copies of this process, in a folder of TMPDIR; `remove_copies` ends them."""
    global _own
    with _lock:
        if _own is None:
            _remove_abandoned()
            _own = Copies(Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}-")))
        return _own


def remove_copies() -> None:
    """Removes the copies of this process."""
    global _own
    with _lock:
        if _own is not None:
            shutil.rmtree(_own.folder, ignore_errors=True)
        _own = None


atexit.register(remove_copies)


def _remove_abandoned() -> None:
    """Removes the folders of killed processes of this machine."""
    import psutil  # 20 ms that a run without a store does not pay

    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        number = folder.name.removeprefix(_PREFIX).partition("-")[0]
        if number.isdecimal() and not psutil.pid_exists(int(number)):
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def local_files(paths: Iterable[Path]) -> Iterator[dict[Path, Path]]:
    """Yields the local copy of each path that is in a store. Raises as `Copies.held`."""
    with ExitStack() as stack:
        wanted = dict.fromkeys(path for path in paths if isinstance(path, RemotePath))
        yield {path: stack.enter_context(copies().held(path))[0] for path in wanted}


def renamed(value: Any, names: Mapping[str, str]) -> Any:
    """Returns JSON's own types with file names in their texts replaced."""
    if isinstance(value, str):
        for old, new in names.items():
            value = value.replace(old, new)
        return value
    if isinstance(value, Mapping):
        return {key: renamed(item, names) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(renamed(item, names) for item in value)
    return value
