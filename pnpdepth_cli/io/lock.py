"""One run at a time in an output folder, or the shards of one run.

A run holds the lock file `.batch.lock`, a shard `.batch.2of8.lock`. The operating system locks it,
so that it ends with the process, however that ends.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import cannot_write

LOCKS = ".batch*.lock"
"""Pattern of the names of all lock files."""
_WHOLE = ".batch.lock"
_TRIED_S = 0.2
"""Another process that looks for running shards may hold a lock for a moment."""


@contextmanager
def locked_folder(
    folder: Path,
    shard: tuple[int, int] | None = None,
    when_alone: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """Holds the lock of a run or of a shard until the end of the block.

    Args:
        folder: The output folder.
        shard: (i, n) for one of n that run at once; None for all frames.
        when_alone: Called first in a run that is no shard.

    Raises:
        OutputError: Another run writes there, or the folder cannot be written to.
    """
    own = _WHOLE if shard is None else f".batch.{shard[0]}of{shard[1]}.lock"
    with ExitStack() as held:
        if not _acquired(folder / own, held, _TRIED_S):
            raise _in_use(folder)
        for other in sorted(folder.glob(LOCKS)) if shard is None else [folder / _WHOLE]:
            with ExitStack() as tried:
                if other.name != own and other.exists() and not _acquired(other, tried, _TRIED_S):
                    raise _in_use(folder)
        if shard is None:
            when_alone()
        yield


@contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """No other shard is inside at the same time; each waits for the one before."""
    with ExitStack() as held:
        _acquired(folder / ".batch.summary.lock", held, timeout_s=-1)
        yield


def _acquired(path: Path, held: ExitStack, timeout_s: float) -> bool:
    """True if the lock is held until `held` ends; a negative timeout waits for ever."""
    if not path.parent.is_dir():  # filelock would make it
        raise cannot_write(path.parent, FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)))
    try:
        held.enter_context(FileLock(path).acquire(timeout=timeout_s))
    except Timeout:
        return False
    except NotImplementedError as error:
        raise OutputError(
            "files in the output folder cannot be locked; choose another folder"
        ) from error
    except OSError as error:
        raise cannot_write(path, error) from error
    return True


def _in_use(folder: Path) -> OutputError:
    return OutputError(
        f"{folder}: another batch writes there; wait for it to end, or choose another output folder"
    )
