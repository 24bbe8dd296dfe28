"""One run at a time in an output folder, or the shards of one run.

The locks are flock(2) on files of the folder: they end with the process that holds them, however
it ends, so nothing is left to clear up after a crash. A whole run holds `.batch.lock` alone; shards
share it, and each holds a lock of its own number.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import cannot_write

_LOCK_FILE = re.compile(r"\.batch(?:\.(\d+)of(\d+))?\.lock")
_CLEANING_S = 3.0
"""For how long a shard waits for another one that is alone for a moment, to clean up."""


@contextmanager
def locked_folder(
    folder: Path, shard: tuple[int, int] | None, when_alone: Callable[[], None]
) -> Iterator[None]:
    """Nobody else runs what we run in the folder while inside. OutputError if somebody does.

    shard: (i, n) of the i-th of n shards, None for a run of everything. when_alone is called first
    if nobody else is in the folder at all.
    """
    with ExitStack() as held:
        whole = _opened(held, folder / ".batch.lock")
        alone = _taken(whole, fcntl.LOCK_EX)
        if shard is None and not alone:
            raise _refusal(folder, "another batch writes there")
        if shard is not None:
            number, of = shard
            own = _opened(held, folder / f".batch.{number}of{of}.lock")
            if not _taken(own, fcntl.LOCK_EX):
                raise _refusal(folder, f"shard {number}/{of} is being done by another process")
        if alone:
            when_alone()
        if shard is not None:
            _share(whole, folder)
            # Only after its own lock is held: of two that start at once, one sees the other.
            _refuse_other_divisions(folder, of)
        yield


@contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """Inside, no other shard is inside; one waits for the other."""
    with ExitStack() as held:
        turn = _opened(held, folder / ".batch.turn.lock")
        fcntl.flock(turn, fcntl.LOCK_EX)
        yield


def _opened(held: ExitStack, path: Path) -> int:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise cannot_write(path, error) from error
    held.callback(os.close, descriptor)
    return descriptor


def _taken(descriptor: int, how: int) -> bool:
    try:
        fcntl.flock(descriptor, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise OutputError(
            f"files in the output folder cannot be locked ({error.strerror}); choose another folder"
        ) from error
    return True


def _share(descriptor: int, folder: Path) -> None:
    until = time.monotonic() + _CLEANING_S
    while not _taken(descriptor, fcntl.LOCK_SH):
        if time.monotonic() > until:
            raise _refusal(folder, "another batch, one without --shard, writes there")
        time.sleep(0.05)


def _refuse_other_divisions(folder: Path, of: int) -> None:
    for path in sorted(folder.iterdir()):
        name = _LOCK_FILE.fullmatch(path.name)
        if name is None or name[2] is None or int(name[2]) == of:
            continue
        with ExitStack() as held:
            if not _taken(_opened(held, path), fcntl.LOCK_SH):
                raise _refusal(
                    folder, f"shard {name[1]}/{name[2]} of another division writes there"
                )


def _refusal(folder: Path, fact: str) -> OutputError:
    return OutputError(f"{folder}: {fact}; wait for it to end, or choose another output folder")
