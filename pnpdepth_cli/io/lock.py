"""One run at a time in an output folder, or the shards of one run.

A run holds the lock file `.batch.lock`, a shard `.batch.2of8.lock`. The operating system locks it,
so that it ends with the process, however that ends.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import cannot_write

LOCKS = ".batch*.lock"
"""Pattern of the names of all lock files."""
_WHOLE = ".batch.lock"
_TRIED_S = 0.2
"""Longest wait for a lock; another process that looks for shards holds it for a moment."""


@contextmanager
def lock_folder(
    folder: Path,
    shard: tuple[int, int] | None = None,
    when_alone: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """Holds the lock of a run or of a shard until the end of the block.

    Args:
        shard: Number i of n that run at once, (i, n); None for all frames.
        when_alone: Callback at the beginning of a run that is no shard.

    Raises:
        OutputError: Another run writes there, or the folder cannot be written to.
    """
    own = folder / (_WHOLE if shard is None else f".batch.{shard[0]}of{shard[1]}.lock")
    with _hold(own):
        for other in sorted(folder.glob(LOCKS)) if shard is None else [folder / _WHOLE]:
            if other != own and other.exists():
                with _hold(other):
                    pass
        if shard is None:
            when_alone()
        yield


@contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """No other shard is inside at the same time; each waits for the one before."""
    with _hold(folder / ".batch.summary.lock", timeout_s=-1):
        yield


@contextmanager
def _hold(path: Path, timeout_s: float | None = None) -> Iterator[None]:
    """Holds a lock; a negative timeout waits for ever. OutputError if another process does."""
    if not path.parent.is_dir():  # filelock would make it
        raise cannot_write(path.parent, FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)))
    lock = FileLock(path)
    try:
        lock.acquire(timeout=_TRIED_S if timeout_s is None else timeout_s)
    except Timeout:
        raise OutputError(
            f"{path.parent}: another batch writes there; wait for it to end, or choose another"
            " output folder"
        ) from None
    except NotImplementedError as error:
        raise OutputError(
            "files in the output folder cannot be locked; choose another folder"
        ) from error
    except OSError as error:
        raise cannot_write(path, error) from error
    try:
        yield
    finally:
        lock.release()
