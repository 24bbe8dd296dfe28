"""Output files that are written whole or not at all, by one run at a time in a folder."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pnpdepth_cli.errors import OutputError, StorageError

_TEMPORARY = re.compile(r"\.[0-9a-f]{12}(\.[A-Za-z0-9]+)?")
"""Names of the temporary files and folders that `atomic_path` and `atomic_folder` make."""
_FULL = {errno.ENOSPC, errno.EDQUOT}
"""Error numbers of a full disk, and of a user's full share of it."""
_OF_THE_NAME = {errno.ENAMETOOLONG, errno.EILSEQ, errno.EINVAL, errno.EISDIR, errno.ENOTDIR}
"""Error numbers that another file name would avoid."""
LOCKS = ".batch*.lock"
"""Pattern of the names of all lock files."""
_WHOLE = ".batch.lock"
"""Name of the lock of a run of all frames."""
_LOCK_TIMEOUT_S = 0.2
"""Longer than another process holds a lock only to find out whether it is free."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Replaces `path` by what is written to the yielded path; untouched if anything fails.

    The yielded path is an empty file in the same folder with the same suffix. A link is not
    followed: it is replaced itself. OSErrors become OutputErrors.
    """
    # The name does not contain the target's, so a name of the longest length still works.
    temporary = path.with_name(f".{secrets.token_hex(6)}{path.suffix}")
    try:
        if path.exists() and not path.is_file():  # nobody wants /dev/stdout replaced
            raise OutputError(f"{path} is no regular file; give the name of a file to write")
        temporary.touch(exist_ok=False)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Replaces `folder` by what is written to the yielded one; untouched if anything fails.

    The yielded folder is empty and beside `folder`. OSErrors become OutputErrors.
    """
    target = Path(os.path.realpath(folder))
    make_folder(target.parent)
    temporary = target.with_name(f".{secrets.token_hex(6)}")
    try:
        temporary.mkdir()
        yield temporary
        if target.exists():
            shutil.rmtree(target)
        temporary.rename(target)
    except OSError as error:
        raise cannot_write(folder, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def all_or_none(paths: Iterable[Path]) -> Iterator[None]:
    """Removes the files again if the block fails, except those that were there before it."""
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
        OutputError: It cannot be created, or a folder on the way is a link, which may lead out of
            the folder that the user named.
    """
    for path in (folder, *folder.parents):
        if below in path.parents and path.is_symlink():
            raise OutputError(f"{path} is a link; remove it, as outputs stay in {below}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def remove_leftovers(folder: Path) -> int:
    """Removes the temporary files and folders that killed processes left in a folder.

    Those in its subfolders are removed too. Nobody may write to the folder at the same time.

    Returns:
        How many there were.

    Raises:
        OutputError: One cannot be removed.
    """
    leftovers = [path for path in folder.rglob(".*") if _TEMPORARY.fullmatch(path.name)]
    try:
        for path in leftovers:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    return len(leftovers)


def remove_file(path: Path) -> None:
    """Removes the file if it exists. Raises OutputError if it cannot be removed."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error


def cannot_write(path: Path, error: OSError) -> OutputError:
    """Returns the error that says why a path cannot be written.

    It is a StorageError where another file name would not help, as on a full disk.
    """
    reason = " ".join(str(error.strerror or error).split()).lower()
    kind = OutputError if error.errno in _OF_THE_NAME else StorageError
    room = "make room, or " if error.errno in _FULL else ""
    return kind(f"{path} cannot be written ({reason}); {room}choose another output folder")


@contextmanager
def lock_folder(folder: Path, shard: tuple[int, int] | None = None) -> Iterator[None]:
    """Keeps other runs that would write the same frames out of a folder during the block.

    A run of all frames keeps all others out. A shard, which is a run of every n-th frame, keeps
    out runs of all frames and the same shard. The operating system locks the file, so that the
    lock ends with the process, however that ends.

    Args:
        folder: The output folder.
        shard: Number of this shard and number of shards, (i, n); None for a run of all frames.

    Raises:
        OutputError: Another run writes there, or the folder cannot be written to.
    """
    lock = folder / _WHOLE
    if shard is not None:
        number, shards = shard
        lock = folder / f".batch.{number}of{shards}.lock"
    with _hold(lock):
        # The locks that nobody else may hold. Whether one is free is found out by holding it for a
        # moment.
        excluded = sorted(folder.glob(LOCKS)) if shard is None else [folder / _WHOLE]
        for other_lock in excluded:
            if other_lock != lock and other_lock.exists():
                with _hold(other_lock):
                    pass
        yield


@contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """Lets one process that writes to a folder at a time into the block; the others wait for it."""
    with _hold(folder / ".batch.summary.lock", timeout_s=-1):
        yield


@contextmanager
def _hold(path: Path, timeout_s: float = _LOCK_TIMEOUT_S) -> Iterator[None]:
    """Holds the lock of a file until the end of the block.

    Args:
        path: The lock file, in an existing folder.
        timeout_s: Longest wait for a process that holds the lock; below 0, without end.

    Raises:
        OutputError: Another process holds the lock, or the file cannot be written.
    """
    from filelock import FileLock, Timeout  # here, as it imports asyncio

    if not path.parent.is_dir():  # filelock would make the folder
        raise cannot_write(path.parent, FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)))
    try:
        held = FileLock(path).acquire(timeout=timeout_s)
    except Timeout:
        raise OutputError(f"another batch writes to {path.parent}; wait for it to end") from None
    except OSError as error:
        raise cannot_write(path, error) from error
    with held:
        yield
