"""One run at a time in an output folder, or the shards of one run.

The locks are files of the folder that the operating system locks: they end with the process that
holds them, however it ends. A whole run holds `.batch.lock` until its end. Each shard holds a lock
of its own number, and `.batch.lock` only while it starts.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import cannot_write

_SHARD_LOCK = re.compile(r"\.batch\.(\d+)of(\d+)\.lock")
_START_S = 3.0
"""How long a shard waits for another one that is starting, and may be cleaning up."""


@contextmanager
def locked_folder(
    folder: Path, shard: tuple[int, int] | None, when_alone: Callable[[], None]
) -> Iterator[None]:
    """No other process runs the same frames in the folder while inside.

    Args:
        folder: The output folder.
        shard: (i, n) of the i-th of n shards; None for a run of all frames.
        when_alone: Called first if no other process runs in the folder.

    Raises:
        OutputError: Another process does, or the folder cannot be locked.
    """
    with ExitStack() as held:
        start = _lock(folder, ".batch.lock")
        if shard is None:
            if not _acquire(start, held) or _running_shards(folder):
                raise _refusal(folder, "another batch writes there")
            when_alone()
        else:
            with ExitStack() as starting:
                if not _acquire(start, starting, timeout_s=_START_S):
                    raise _refusal(folder, "another batch, one without --shard, writes there")
                _start_shard(folder, shard, held, when_alone)
        yield


@contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """No other shard is inside at the same time; each waits for the one before."""
    with ExitStack() as held:
        _acquire(_lock(folder, ".batch.turn.lock"), held, timeout_s=-1)
        yield


def _start_shard(
    folder: Path, shard: tuple[int, int], held: ExitStack, when_alone: Callable[[], None]
) -> None:
    number, count = shard
    if not _acquire(_lock(folder, f".batch.{number}of{count}.lock"), held):
        raise _refusal(folder, f"shard {number}/{count} is being done by another process")
    others = _running_shards(folder, but=shard)
    for other, other_count in others:
        if other_count != count:
            raise _refusal(folder, f"shard {other}/{other_count} of another division writes there")
    if not others:
        when_alone()


def _running_shards(folder: Path, but: tuple[int, int] | None = None) -> list[tuple[int, int]]:
    """The shards that other processes run; to be called by the holder of `.batch.lock`."""
    running = []
    for path in sorted(folder.iterdir()):
        name = _SHARD_LOCK.fullmatch(path.name)
        if name is None or (int(name[1]), int(name[2])) == but:
            continue
        with ExitStack() as tried:
            if not _acquire(_lock(folder, path.name), tried):
                running.append((int(name[1]), int(name[2])))
    return running


def _lock(folder: Path, name: str) -> FileLock:
    if not folder.is_dir():  # filelock would make it
        raise cannot_write(folder, FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)))
    return FileLock(folder / name)


def _acquire(lock: FileLock, held: ExitStack, *, timeout_s: float = 0) -> bool:
    """True if the lock is held until `held` ends; a negative timeout waits for ever."""
    try:
        held.enter_context(lock.acquire(timeout=timeout_s))
    except Timeout:
        return False
    except NotImplementedError as error:
        raise OutputError(
            "files in the output folder cannot be locked; choose another folder"
        ) from error
    except OSError as error:
        raise cannot_write(Path(lock.lock_file), error) from error
    return True


def _refusal(folder: Path, fact: str) -> OutputError:
    return OutputError(f"{folder}: {fact}; wait for it to end, or choose another output folder")
