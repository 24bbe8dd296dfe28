"""Reads and writes objects of a store through fsspec, with one-line errors."""

from __future__ import annotations

import errno
import functools
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from pnpdepth_cli.budget import budget
from pnpdepth_cli.choices import STORES
from pnpdepth_cli.errors import (
    FileFormatError,
    InputError,
    PnpDepthError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.io.file_bytes import cannot_read, one_line
from pnpdepth_cli.io.remote.address import RemotePath

_VERSIONS = ("ETag", "etag", "generation", "md5Hash", "blob_id", "LastModified", "mtime")
"""What stores call the version of an object's content, the surest first."""
_NOT_LISTED = ("http", "https")
_FOLDERS = 64
"""Folders whose names are kept."""
_RETRIES = {"total_max_attempts": 3, "mode": "standard"}
_OPTIONS: dict[str, dict[str, Any]] = {
    "s3": {"config_kwargs": {"connect_timeout": 5, "read_timeout": 30, "retries": _RETRIES}}
}
_FORBIDDEN = (401, 403)
_OF_THE_DISK = {errno.ENOSPC, errno.EDQUOT}


class Status(NamedTuple):
    """What a store says of an object."""

    size: int
    """Bytes; -1 if unknown."""
    version: str
    """Equal only for equal content; empty if unknown."""


def status_of(path: RemotePath) -> Status | None:
    """Returns what the store says of an object; None if there is none.

    Raises:
        UsageError: The store's package is not installed.
        InputError: It may not be read.
        StorageError: The store cannot be reached.
    """
    info = _call_if_there(path, "info")
    return None if info is None or info.get("type") == "directory" else _status(info)


def read_object(path: RemotePath) -> bytes | None:
    """Returns the content of a small object; None if there is none. Raises as `status_of`."""
    data: bytes | None = _call_if_there(path, "cat_file")
    return data


def upload(file: Path, path: RemotePath) -> None:
    """Puts a local file into the store, whole or not at all.

    Raises:
        UsageError: The store's package is not installed.
        StorageError: It may not be written, or the store cannot be reached.
    """
    with _errors_of(path, writing=True):
        _file_system(_scheme(path)).put_file(str(file), str(path))


def remove(path: RemotePath) -> None:
    """Removes an object, if there is one. Raises as `upload`."""
    if status_of(path) is not None:
        _call(path, "rm_file", writing=True)


@contextmanager
def local_files(paths: Iterable[Path]) -> Iterator[dict[Path, Path]]:
    """Yields a temporary local copy of each path that is in a store.

    Raises:
        InputError: There is no such object, or it may not be read.
        FileFormatError: It is larger than the budget of readers.
        StorageError: The store cannot be reached, or the disk is full.
    """
    wanted = dict.fromkeys(path for path in paths if isinstance(path, RemotePath))
    if not wanted:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="pnpdepth-") as folder:
        copies = dict[Path, Path]()
        for number, path in enumerate(wanted):
            copies[path] = Path(folder, str(number), path.name)
            _download(path, copies[path])
        yield copies


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


class Listing:
    """The names in folders, on disk or in a store, each listed once.

    It does not see what changes after its first question about a folder.
    """

    def __init__(self) -> None:
        self.names = functools.lru_cache(_FOLDERS)(_listed)

    def status(self, path: RemotePath) -> Status | None:
        """Returns what the store says of an object; None if there is none. Raises as `names`."""
        if _scheme(path) in _NOT_LISTED:
            return status_of(path)
        return self.names(path.parent).get(path.name)


def _listed(folder: Path) -> Mapping[str, Status | None]:
    """The names in a folder; none if there is no such folder. Raises as `status_of`."""
    if not isinstance(folder, RemotePath):
        try:
            return dict.fromkeys(entry.name for entry in os.scandir(folder))
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise cannot_read(folder, error) from error
    infos = _call_if_there(folder, "ls", detail=True) or ()
    files = (info for info in infos if info.get("type") != "directory")
    return {info["name"].rpartition("/")[2]: _status(info) for info in files}


def forget_stores() -> None:
    """Forgets connections and their credentials; the next question reads them again."""
    _file_system.cache_clear()


def _download(path: RemotePath, copy: Path) -> None:
    status, limit = status_of(path), budget().max_file_bytes
    if status is None:
        raise InputError(f"{path}: no such object; check the address")
    if status.size < 0:
        raise FileFormatError(f"{path}: its server does not say its size; copy the file first")
    if status.size > limit:
        raise FileFormatError(
            f"{path} has {status.size:,} bytes, more than {limit:,}; make it smaller, or allow more"
            " with --max-pixels"
        )
    try:
        copy.parent.mkdir()
        _call(path, "get_file", str(copy))
    except OSError as error:
        raise StorageError(
            f"{path} cannot be copied to {copy.parent} ({error.strerror}); set TMPDIR to a larger"
            " disk"
        ) from error
    if copy.stat().st_size != status.size:
        raise InputError(f"{path} was replaced while it was read; run again")


class _MissingError(InputError):
    """There is no such object."""


@functools.cache
def _file_system(scheme: str) -> Any:
    package = STORES[scheme]
    try:
        import fsspec

        return fsspec.filesystem(
            scheme, use_listings_cache=False, skip_instance_cache=True, **_OPTIONS.get(scheme, {})
        )
    except (ImportError, ValueError):
        install = "pip install 'pnpdepth[remote]'" + ("" if scheme == "s3" else f" {package}")
        raise UsageError(f"{scheme}:// needs fsspec and {package}: {install}") from None


def _call(path: RemotePath, method: str, *more: Any, writing: bool = False, **options: Any) -> Any:
    with _errors_of(path, writing=writing):
        call = getattr(_file_system(_scheme(path)), method)
        return call(str(path) + path.query, *more, **options)


def _call_if_there(path: RemotePath, method: str, **options: Any) -> Any:
    try:
        return _call(path, method, **options)
    except _MissingError:
        return None


def _scheme(path: RemotePath) -> str:
    return path.parts[0].rstrip(":")


def _status(info: Mapping[str, Any]) -> Status:
    size = info.get("size")
    version = next((str(info[key]) for key in _VERSIONS if info.get(key)), "")
    return Status(-1 if size is None else int(size), version.strip('"'))


@contextmanager
def _errors_of(path: RemotePath, *, writing: bool) -> Iterator[None]:
    """Turns what fsspec and its stores raise into the program's own errors."""
    try:
        yield
    except PnpDepthError:
        raise
    except FileNotFoundError as error:
        if writing:
            raise StorageError(f"{_bucket(path)}: no such bucket; check the output") from error
        raise _MissingError(f"{path}: no such object; check the address") from None
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _OF_THE_DISK:
            raise
        raise _error_of(path, error, writing=writing) from None


def _error_of(path: RemotePath, error: Exception, *, writing: bool) -> PnpDepthError:
    kind = type(error).__name__
    if "Credentials" in kind or "Credential" in str(error):
        return StorageError(
            f"{_bucket(path)} needs credentials, and there are none; set them in the environment or"
            f" in the configuration of {STORES[_scheme(path)]}"
        )
    if isinstance(error, PermissionError) or getattr(error, "status", None) in _FORBIDDEN:
        verb = "written" if writing else "read"
        fact = f"{path} may not be {verb} with these credentials; check them and the address"
        return StorageError(fact) if writing else InputError(fact)
    reason = "no answer in time" if "timeout" in kind.lower() else str(error) or kind
    reason = re.sub(r"\?[^\s'\"]*", "", reason)  # a query may hold credentials
    return StorageError(
        f"{_bucket(path)} cannot be reached ({one_line(reason).rstrip('.')[:120]}); check the"
        " address and the network"
    )


def _bucket(path: RemotePath) -> str:
    return f"{path.parts[0]}//{path.parts[1]}"
