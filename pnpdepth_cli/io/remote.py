"""Files in a store, such as s3://bucket/key: their addresses as paths, and their content.

fsspec reads and writes them; it is imported when a store is first asked.
"""

from __future__ import annotations

import errno
import functools
import os
import posixpath
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import unquote, urlsplit

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

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
_WEB = ("http", "https")
"""Addresses that may have a query, in stores that list no folders."""
_VERSIONS = ("ETag", "etag", "generation", "md5Hash", "blob_id", "LastModified", "mtime")
"""What stores call the version of an object's content, the surest first."""
_CONNECT_S, _READ_S, _TOTAL_S = 5, 30, 300
"""Seconds until a store must accept, until it must go on, and, on the web, for one file."""
_OPTIONS: dict[str, dict[str, Any]] = {
    "s3": {
        "config_kwargs": {
            "connect_timeout": _CONNECT_S,
            "read_timeout": _READ_S,
            "retries": {"total_max_attempts": 3, "mode": "standard"},
        }
    }
}

if TYPE_CHECKING:
    _Path = Path
else:
    _Path = type(Path())  # Path itself cannot be subclassed before Python 3.12


class RemotePath(_Path):
    """A file in a store; made by `path_of`.

    Its names, parents and joins are those of any path. Its content is read through a local copy
    (`local_files`); `str` gives the address without its query. A store has no folders or links.

    Attributes:
        query: Of a presigned address, with its question mark. Joins and parents do not have it.
    """

    query: str = ""

    def __str__(self) -> str:
        first, *others = self.parts or (".",)
        return "/".join([f"{first}/" if first.endswith(":") else first, *others])

    def __fspath__(self) -> str:
        return str(self)

    def __reduce__(self) -> Any:
        return _with_query, (str(self), self.query)

    def exists(self, **_: Any) -> bool:
        """Returns whether the store has the file."""
        return status_of(self) is not None

    is_file = exists

    def is_dir(self, **_: Any) -> bool:
        """Returns False."""
        return False

    is_symlink = is_dir

    def resolve(self, strict: bool = False) -> RemotePath:
        """Returns the path itself."""
        return self

    absolute = resolve

    def glob(self, *_: Any, **__: Any) -> Any:
        """Yields nothing."""
        return iter(())

    def stat(self, **_: Any) -> Any:
        """Raises InputError: only a local copy can be read."""
        raise InputError(f"{self} is in a store, which only `batch` reads; copy the file first")


def path_of(text: str) -> Path:
    """Returns the path of an address, or of a local file.

    Args:
        text: A local path, file:///PATH, or SCHEME://BUCKET/KEY of a store in `choices.STORES`.

    Raises:
        UsageError: The scheme is unknown, or the address has a password, an empty or a relative
            part.
    """
    match = _SCHEME.match(text)
    if match is None:
        return Path(text)
    scheme, rest = match[1].lower(), text[match.end() :]
    if scheme == "file":
        parts = urlsplit(text)
        if parts.netloc not in ("", "localhost"):
            raise UsageError(f"{text[:100]} names a host; give file:///PATH")
        return Path(unquote(parts.path))
    if scheme not in STORES:
        raise UsageError(f"{scheme}:// is no known store; stores are {', '.join(STORES)}")
    question = query = ""
    if scheme in _WEB:
        rest, question, query = rest.partition("?")
    names = rest.rstrip("/").split("/")
    if "@" in names[0]:
        raise UsageError(
            f"an address of {scheme}:// has a user name in it; leave it out, and give credentials"
            " in the environment"
        )
    if any(name in ("", ".", "..") for name in names):
        raise UsageError(
            f"{scheme}://{rest[:100]} has an empty or relative part; give SCHEME://BUCKET/KEY"
        )
    return _with_query(f"{scheme}://{'/'.join(names)}", question + query)


def joined(folder: Path, text: str) -> Path:
    """Returns the path of a file that a list in this folder names. Raises UsageError as `path_of`.

    Args:
        folder: Of the list.
        text: An address, an absolute path, or a path below the folder.
    """
    if _SCHEME.match(text) or Path(text).is_absolute():
        return path_of(text)
    if not isinstance(folder, RemotePath):
        return folder / text
    scheme, _, rest = str(folder).partition("://")
    return path_of(f"{scheme}://{posixpath.normpath(f'{rest}/{text}')}")


def _with_query(text: str, query: str) -> RemotePath:
    path = RemotePath(text)
    if query:
        path.query = query
    return path


class Status(NamedTuple):
    """What a store says of an object."""

    size: int  # bytes; -1 if unknown
    version: str  # equal only for equal content; empty if unknown


def status_of(path: RemotePath) -> Status | None:
    """Returns what the store says of an object; None if there is none.

    Raises:
        UsageError: The store's package is not installed.
        InputError: It may not be read.
        StorageError: The store cannot be reached.
    """
    info = _call(path, "info")
    return None if info is None or info.get("type") == "directory" else _status(info)


def _status(info: Mapping[str, Any]) -> Status:
    size = info.get("size")
    version = next((str(info[key]) for key in _VERSIONS if info.get(key)), "")
    return Status(-1 if size is None else int(size), version.strip('"'))


def read_object(path: RemotePath) -> bytes | None:
    """Returns the content of a small object; None if there is none. Raises as `status_of`."""
    data: bytes | None = _call(path, "cat_file")
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
        with _errors_of(path, writing=True):
            _file_system(_scheme(path)).rm_file(str(path))


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
        copies: dict[Path, Path] = {
            path: Path(folder, str(number), path.name) for number, path in enumerate(wanted)
        }
        for path in wanted:
            _download(path, copies[path])
        yield copies


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
    if not copy.is_file() or copy.stat().st_size != status.size:
        raise InputError(f"{path} was replaced while it was read; run again")


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
        self.names = functools.lru_cache(maxsize=64)(_listed)

    def status(self, path: RemotePath) -> Status | None:
        """Returns what the store says of an object; None if there is none. Raises as `names`."""
        if _scheme(path) in _WEB:
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
    infos = _call(folder, "ls", detail=True) or ()
    files = (info for info in infos if info.get("type") != "directory")
    return {info["name"].rpartition("/")[2]: _status(info) for info in files}


@functools.cache
def _file_system(scheme: str) -> Any:
    package = STORES[scheme]
    try:
        import fsspec

        options = _OPTIONS.get(scheme, {})
        if scheme in _WEB:
            from aiohttp import ClientTimeout

            timeout = ClientTimeout(total=_TOTAL_S, sock_connect=_CONNECT_S, sock_read=_READ_S)
            options = {"client_kwargs": {"timeout": timeout}}
        file_system = fsspec.filesystem(
            scheme, use_listings_cache=False, skip_instance_cache=True, **options
        )
        file_system.retries = 1  # s3fs would repeat what botocore has repeated
        return file_system
    except (ImportError, ValueError):
        install = "pip install 'pnpdepth[remote]'" + ("" if scheme == "s3" else f" {package}")
        raise UsageError(f"{scheme}:// needs fsspec and {package}: {install}") from None


def _call(path: RemotePath, method: str, *more: Any, **options: Any) -> Any:
    """What the method returns; None if there is no such object."""
    with _errors_of(path):
        try:
            file_system = _file_system(_scheme(path))
            return getattr(file_system, method)(str(path) + path.query, *more, **options)
        except FileNotFoundError as error:
            # On the web, fsspec says so of whatever happens.
            cause = error.__cause__ if _scheme(path) in _WEB else None
            missing = isinstance(cause, FileNotFoundError) or getattr(cause, "status", 0) == 404
            if cause is not None and not missing:
                raise cause from None
    return None


def _scheme(path: RemotePath) -> str:
    return path.parts[0].rstrip(":")


@contextmanager
def _errors_of(path: RemotePath, *, writing: bool = False) -> Iterator[None]:
    """Turns what fsspec and its stores raise into the program's own errors."""
    bucket = f"{path.parts[0]}//{path.parts[1]}"
    try:
        yield
    except PnpDepthError:
        raise
    except FileNotFoundError as error:  # of writing
        raise StorageError(f"{bucket}: no such bucket; check the output") from error
    except Exception as error:
        if isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT}:
            raise
        kind = type(error).__name__
        if "Credentials" in kind or "Credential" in str(error):
            raise StorageError(
                f"{bucket} needs credentials, and there are none; set them in the environment or in"
                f" the configuration of {STORES[_scheme(path)]}"
            ) from None
        if isinstance(error, PermissionError) or getattr(error, "status", None) in (401, 403):
            verb, our_error = ("written", StorageError) if writing else ("read", InputError)
            raise our_error(
                f"{path} may not be {verb} with these credentials; check them and the address"
            ) from None
        reason = "no answer in time" if "timeout" in kind.lower() else str(error) or kind
        reason = re.sub(r"\?[^\s'\"]*", "", reason)  # a query may hold credentials
        raise StorageError(
            f"{bucket} cannot be reached ({one_line(reason).rstrip('.')[:120]}); check the address"
            " and the network"
        ) from None
