"""Output files that are written whole or not at all."""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pnpdepth_cli.errors import OutputError, StorageError
from pnpdepth_cli.io.file_bytes import one_line

_TEMPORARY = re.compile(r"\.[0-9a-f]{12}(\.[A-Za-z0-9]+)?")
_FULL = {errno.ENOSPC, errno.EDQUOT}
_OF_THE_NAME = {errno.ENAMETOOLONG, errno.EILSEQ, errno.EINVAL, errno.EISDIR, errno.ENOTDIR}


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Replaces `path` by what is written to the yielded path; untouched if anything fails.

    The yielded path is an empty file in the same folder with the same suffix. A link is
    followed, so the file it points to is the one replaced.

    Raises:
        OutputError: The folder cannot be written to, also when that shows only inside the block.
    """
    target = Path(os.path.realpath(path))
    _check_target(target, named=path)
    temporary = _empty_file_beside(target, named=path)
    try:
        yield temporary
        temporary.replace(target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise cannot_write(path, error) from error
        raise


@contextmanager
def all_or_none(paths: Iterable[Path]) -> Iterator[None]:
    """Removes those of the files that did not exist before, if anything inside fails."""
    new = [path for path in paths if not path.exists()]
    try:
        yield
    except BaseException:
        for path in new:
            with suppress(OSError):
                path.unlink()
        raise


def make_folder(folder: Path) -> None:
    """Creates the folder and those above it. Raises OutputError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def remove_leftovers(folder: Path) -> int:
    """Removes temporary files of killed writers and returns how many there were.

    To be called only while nobody writes to the folder.
    """
    leftovers = [p for p in folder.iterdir() if _TEMPORARY.fullmatch(p.name) and p.is_file()]
    for path in leftovers:
        path.unlink(missing_ok=True)
    return len(leftovers)


def cannot_write(path: Path, error: OSError) -> OutputError:
    """Returns the error that says why; a StorageError where no other file name would help."""
    reason = one_line(error.strerror or error).lower()
    kind = OutputError if error.errno in _OF_THE_NAME else StorageError
    room = "make room, or " if error.errno in _FULL else ""
    return kind(f"{path} cannot be written ({reason}); {room}choose another output folder")


def _check_target(target: Path, *, named: Path) -> None:
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return
    except OSError as error:
        raise cannot_write(named, error) from error
    if stat.S_ISDIR(mode):
        raise OutputError(f"{named} is a folder; give the name of a file to write")
    if not stat.S_ISREG(mode):
        raise OutputError(f"{named} is not a regular file; choose another output file")


def _empty_file_beside(target: Path, *, named: Path) -> Path:
    # The name does not contain the target's, so a name of the longest length still works.
    temporary = target.with_name(f".{secrets.token_hex(6)}{target.suffix}")
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        if not target.parent.exists():
            message = f"{named}: its folder does not exist; create it first"
            raise OutputError(message) from error
        raise cannot_write(named, error) from error
    return temporary
