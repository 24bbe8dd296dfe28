"""Reads and writes objects of a store through fsspec, in bounded time, with one-line errors."""

from __future__ import annotations

import errno
import functools
import re
from collections import Counter, OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from pnpdepth_cli.choices import STORES
from pnpdepth_cli.errors import InputError, PnpDepthError, StorageError, UsageError
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.remote.address import RemotePath

_CONNECT_S, _READ_S = 5, 30
_ATTEMPTS = 3
_ASK_S = 60.0
"""Limit of a question such as for the size of an object."""
_BYTES_PER_S = 1e5
"""A transfer may be as slow as this."""
_VERSIONS = ("ETag", "etag", "generation", "md5Hash", "blob_id")
"""What stores call the version of an object's content."""
_NOT_LISTED = ("http", "https")
_FEW = 8
"""Objects of one folder that are asked for one by one; then the folder is listed."""
_MAX_LISTED = 2_000_000
"""Objects of listings in memory, about 200 bytes each."""
_OPTIONS: dict[str, dict[str, Any]] = {
    "s3": {
        "config_kwargs": {
            "connect_timeout": _CONNECT_S,
            "read_timeout": _READ_S,
            "retries": {"total_max_attempts": _ATTEMPTS, "mode": "standard"},
        }
    }
}
_FORBIDDEN = (401, 403)
_OF_THE_DISK = {errno.ENOSPC, errno.EDQUOT}


@dataclass(frozen=True, kw_only=True)
class Status:
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
    try:
        with _errors_of(path):
            info = _call(path, "info", _ASK_S)
    except _MissingError:
        return None
    return None if info.get("type") == "directory" else _status(info)


def download(path: RemotePath, file: Path, size: int) -> None:
    """Writes an object of this size to a local file. Raises as `status_of`, and if it is gone."""
    with _errors_of(path):
        _call(path, "get_file", _ASK_S + size / _BYTES_PER_S, str(file))


def upload(file: Path, path: RemotePath) -> Status:
    """Puts a local file into the store, whole or not at all; returns what the store has then.

    Raises:
        UsageError: The store's package is not installed.
        StorageError: It may not be written, or the store cannot be reached.
    """
    with _errors_of(path, writing=True):
        limit = _ASK_S + file.stat().st_size / _BYTES_PER_S
        _call(path, "put_file", limit, source=file)
        return _status(_call(path, "info", _ASK_S))


def create(path: RemotePath, data: bytes) -> bool:
    """Puts a new object into the store; returns False if there is one already.

    Raises:
        UsageError: The store's package is not installed.
        StorageError: It may not be written, or the store cannot be reached.
    """
    limit = _ASK_S + len(data) / _BYTES_PER_S
    try:
        with _errors_of(path, writing=True):
            _call(path, "pipe_file", limit, data, mode="create")
    except _ThereError:
        return False
    return True


def remove(path: RemotePath) -> None:
    """Removes an object, if there is one. Raises as `upload`."""
    if status_of(path) is not None:
        with _errors_of(path, writing=True):
            _call(path, "rm_file", _ASK_S)


def listed(folder: RemotePath) -> dict[str, Status]:
    """Returns the objects directly below a folder by name; none if there is no such folder.

    Raises:
        UsageError: The store's package is not installed.
        InputError: It may not be listed.
        StorageError: The store cannot be reached.
    """
    try:
        with _errors_of(folder):
            infos = _call(folder, "ls", 20 * _ASK_S, detail=True)
    except _MissingError:
        return {}
    return {
        info["name"].rpartition("/")[2]: _status(info)
        for info in infos
        if info.get("type") != "directory"
    }


class StatusIndex:
    """The status of many objects, with one listing for each folder; for planning only.

    It does not see what changes after its first question about a folder.
    """

    def __init__(self) -> None:
        self._asked = Counter[RemotePath]()
        self._listed: OrderedDict[RemotePath, dict[str, Status]] = OrderedDict()

    def status(self, path: RemotePath) -> Status | None:
        """Returns what the store says of an object; None if there is none. Raises as `listed`."""
        folder = path.parent
        if folder not in self._listed:
            self._asked[folder] += 1
            scheme = folder.parts[0].rstrip(":")
            if self._asked[folder] <= _FEW or scheme in _NOT_LISTED:
                return status_of(path)
            self._listed[folder] = listed(folder)
            while sum(map(len, self._listed.values())) > _MAX_LISTED and len(self._listed) > 1:
                self._listed.popitem(last=False)
        return self._listed[folder].get(path.name)


def forget_stores() -> None:
    """Forgets connections and their credentials; the next question reads them again."""
    _file_system.cache_clear()


class _MissingError(InputError):
    """There is no such object."""


class _ThereError(StorageError):
    """There is such an object already."""


@functools.cache
def _file_system(scheme: str) -> Any:
    package = STORES[scheme]
    extra = "pip install 'pnpdepth[remote]'"
    install = extra if scheme == "s3" else f"{extra} {package}"
    try:
        import fsspec

        return fsspec.filesystem(
            scheme, use_listings_cache=False, skip_instance_cache=True, **_OPTIONS.get(scheme, {})
        )
    except (ImportError, ValueError):
        raise UsageError(f"{scheme}:// needs fsspec and {package}: {install}") from None


def _call(
    path: RemotePath,
    method: str,
    limit_s: float,
    *more: Any,
    source: Path | None = None,
    **options: Any,
) -> Any:
    """What a method of the path's file system returns; a `source` goes before the path."""
    from fsspec.asyn import AsyncFileSystem

    system = _file_system(path.parts[0].rstrip(":"))
    address = str(path) + path.query
    if isinstance(system, AsyncFileSystem):
        options["timeout"] = limit_s
    first = () if source is None else (str(source),)
    return getattr(system, method)(*first, address, *more, **options)


def _status(info: dict[str, Any]) -> Status:
    size = info.get("size")
    version = next((str(info[key]) for key in _VERSIONS if info.get(key)), "")
    changed = info.get("LastModified") or info.get("mtime")
    if not version and isinstance(changed, datetime):
        version = changed.isoformat()
    return Status(size=-1 if size is None else int(size), version=version.strip('"'))


@contextmanager
def _errors_of(path: RemotePath, *, writing: bool = False) -> Iterator[None]:
    """Turns what fsspec and its stores raise into the program's own errors."""
    try:
        yield
    except PnpDepthError:
        raise
    except FileNotFoundError as error:
        if writing:
            raise StorageError(f"{_bucket(path)}: no such bucket; check the output") from error
        raise _MissingError(f"{path}: no such object; check the address") from None
    except FileExistsError as error:
        raise _ThereError(f"{path} exists") from error
    except OSError as error:
        if error.errno in _OF_THE_DISK:
            raise
        raise _error_of(path, error, writing=writing) from None
    except Exception as error:
        raise _error_of(path, error, writing=writing) from None


def _error_of(path: RemotePath, error: Exception, *, writing: bool) -> PnpDepthError:
    kind = type(error).__name__
    scheme = path.parts[0].rstrip(":")
    if "Credentials" in kind or "Credential" in str(error):
        return StorageError(
            f"{_bucket(path)} needs credentials, and there are none; set them in the environment or"
            f" in the configuration of {STORES[scheme]}"
        )
    if isinstance(error, PermissionError) or getattr(error, "status", None) in _FORBIDDEN:
        verb = "written" if writing else "read"
        fact = f"{path} may not be {verb} with these credentials; check them and the address"
        return StorageError(fact) if writing else InputError(fact)
    return StorageError(
        f"{_bucket(path)} cannot be reached ({_reason(error)}); check the address and the network"
    )


def _bucket(path: RemotePath) -> str:
    return f"{path.parts[0]}//{path.parts[1]}"


def _reason(error: Exception) -> str:
    """What an error says, without the query of an address, which may hold credentials."""
    text = str(error) or type(error).__name__
    if "timeout" in type(error).__name__.lower():
        text = "no answer in time"
    return one_line(re.sub(r"\?[^\s'\"]*", "", text)).rstrip(".")[:120]
