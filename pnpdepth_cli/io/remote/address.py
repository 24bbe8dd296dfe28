"""Addresses of files in a store, such as s3://bucket/key, as paths. Imports no fsspec."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from pnpdepth_cli.choices import STORES
from pnpdepth_cli.errors import InputError, UsageError

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
_WITH_QUERY = ("http", "https")

if TYPE_CHECKING:
    _Path = Path
else:
    _Path = type(Path())  # Path itself cannot be subclassed before Python 3.12


class RemotePath(_Path):
    """A file in a store; made by `path_of`.

    Its names, parents and joins are those of any path. Its content is read through a local copy
    (`io.remote.store`); `str` gives the address without its query. A store has no folders or links.

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
        from pnpdepth_cli.io.remote.store import status_of

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
    query = ""
    if scheme in _WITH_QUERY:
        rest, question, query = rest.partition("?")
        query = question + query
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
    return _with_query(f"{scheme}://{'/'.join(names)}", query)


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
