"""Output files that are written whole or not at all."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
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

    The yielded path is an empty file in the same folder with the same suffix. A link is not
    followed: it is replaced itself. OSErrors become OutputErrors.
    """
    _check_target(path)
    temporary = _empty_file_beside(path)
    try:
        yield temporary
        temporary.replace(path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise cannot_write(path, error) from error
        raise


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Adds what is written to the yielded empty folder to `folder`; untouched if anything fails.

    Files of the same name are replaced, others stay. The yielded folder is in `folder`, which is
    created, and removed again if the block fails. OSErrors become OutputErrors.
    """
    existed = folder.exists()
    make_folder(folder)
    temporary = folder / f".{secrets.token_hex(6)}"
    try:
        temporary.mkdir()
        yield temporary
        for directory, _, names in os.walk(temporary, topdown=False):
            target = folder / Path(directory).relative_to(temporary)
            target.mkdir(exist_ok=True)
            for name in names:
                Path(directory, name).replace(target / name)
    except OutputError as error:  # of a file in the temporary folder
        raise type(error)(str(error).replace(str(temporary), str(folder))) from error
    except OSError as error:
        raise cannot_write(folder, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if not existed:
            with suppress(OSError):
                folder.rmdir()  # fails where files are in it: then they are complete


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


def make_folder(folder: Path, *, below: Path | None = None) -> None:
    """Creates the folder and those above it.

    Args:
        folder: The folder.
        below: The folder that the user named; none between the two may be a link.

    Raises:
        OutputError: It cannot be created, or a link leads out of the folder that the user named.
    """
    inside = () if below is None else folder.relative_to(below).parts
    for count in range(1, len(inside) + 1):
        path = Path(below or "", *inside[:count])
        if path.is_symlink():
            raise OutputError(f"{path} is a link; remove it, as outputs stay in {below}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def remove_leftovers(folder: Path) -> int:
    """Removes what killed writers left, while nobody writes there; returns how many there were."""
    names = [entry.name for entry in os.scandir(folder)] if folder.is_dir() else []
    leftovers = [folder / name for name in names if _TEMPORARY.fullmatch(name)]
    for path in leftovers:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    return len(leftovers)


def cannot_write(path: Path, error: OSError) -> OutputError:
    """Returns the error that says why; a StorageError where no other file name would help."""
    reason = one_line(error.strerror or error).lower()
    kind = OutputError if error.errno in _OF_THE_NAME else StorageError
    room = "make room, or " if error.errno in _FULL else ""
    return kind(f"{path} cannot be written ({reason}); {room}choose another output folder")


def _check_target(target: Path) -> None:
    try:
        mode = target.stat().st_mode  # behind a link: nobody wants /dev/stdout replaced
    except FileNotFoundError:
        return
    except OSError as error:
        raise cannot_write(target, error) from error
    if stat.S_ISDIR(mode):
        raise OutputError(f"{target} is a folder; give the name of a file to write")
    if not stat.S_ISREG(mode):
        raise OutputError(f"{target} is not a regular file; choose another output file")


def _empty_file_beside(target: Path) -> Path:
    # The name does not contain the target's, so a name of the longest length still works.
    temporary = target.with_name(f".{secrets.token_hex(6)}{target.suffix}")
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        if not target.parent.exists():
            message = f"{target}: its folder does not exist; create it first"
            raise OutputError(message) from error
        raise cannot_write(target, error) from error
    return temporary
