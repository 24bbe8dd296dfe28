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
_FULL = {errno.ENOSPC, errno.EDQUOT}
_OF_THE_NAME = {errno.ENAMETOOLONG, errno.EILSEQ, errno.EINVAL, errno.EISDIR, errno.ENOTDIR}
LOCKS = ".batch*.lock"
"""Pattern of the names of all lock files."""
_WHOLE = ".batch.lock"


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

    The yielded folder is beside it. OSErrors become OutputErrors.
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
    for path in (folder, *folder.parents):
        if below in path.parents and path.is_symlink():
            raise OutputError(f"{path} is a link; remove it, as outputs stay in {below}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def remove_leftovers(folder: Path) -> int:
    """Removes what killed writers left in it and below, while nobody writes; returns how many."""
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
    """Returns the error that says why; a StorageError where no other file name would help."""
    reason = " ".join(str(error.strerror or error).split()).lower()
    kind = OutputError if error.errno in _OF_THE_NAME else StorageError
    room = "make room, or " if error.errno in _FULL else ""
    return kind(f"{path} cannot be written ({reason}); {room}choose another output folder")


@contextmanager
def lock_folder(folder: Path, shard: tuple[int, int] | None = None) -> Iterator[None]:
    """Holds the lock of a run or of a shard until the end of the block.

    The operating system locks the file, so that the lock ends with the process, however that ends.

    Args:
        folder: The output folder.
        shard: Number i of n that run at once, (i, n); None for all frames.

    Raises:
        OutputError: Another run writes there, or the folder cannot be written to.
    """
    lock = folder / _WHOLE
    if shard is not None:
        number, shards = shard
        lock = folder / f".batch.{number}of{shards}.lock"
    with _hold(lock):
        # A run of all frames excludes every shard, and a shard only such a run. Whether another
        # process holds a lock is found out by holding it for a moment.
        excluded = sorted(folder.glob(LOCKS)) if shard is None else [folder / _WHOLE]
        for other_lock in excluded:
            if other_lock != lock and other_lock.exists():
                with _hold(other_lock):
                    pass
        yield


@contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """No other shard is inside at the same time; each waits for the one before."""
    with _hold(folder / ".batch.summary.lock", timeout_s=-1):
        yield


@contextmanager
def _hold(path: Path, timeout_s: float = 0.2) -> Iterator[None]:
    """Holds a lock; a negative timeout waits for ever. OutputError if another process does."""
    # The default is longer than another process holds it that looks for shards.
    from filelock import FileLock, Timeout  # it imports asyncio

    if not path.parent.is_dir():  # filelock would make it
        raise cannot_write(path.parent, FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)))
    try:
        held = FileLock(path).acquire(timeout=timeout_s)
    except Timeout:
        raise OutputError(f"another batch writes to {path.parent}; wait for it to end") from None
    except OSError as error:
        raise cannot_write(path, error) from error
    with held:
        yield
