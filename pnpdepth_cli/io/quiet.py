"""Silences what libraries print about damaged files, and not what other threads say.

OpenEXR's binding prints to sys.stdout, where data of a command belongs, and OpenEXR, libpng and
libtiff to the standard error of the process.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any


class SharedContext:
    """A context that is entered by the first thread and left by the last.

    The state before all of them is restored, in whichever order they leave.

    Args:
        make: Returns the context.
    """

    def __init__(self, make: Callable[[], AbstractContextManager[object]]) -> None:
        self._make = make
        self._inside = 0
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._context = self._make()
                self._context.__enter__()
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._context.__exit__(None, None, None)


_SILENT: set[int] = set()
"""Identifiers of the silent threads."""


class _OthersOnly:
    """A stream that passes on what all but the silent threads write."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        if threading.get_ident() in _SILENT:
            return len(text)
        return int(self._stream.write(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def silent_thread() -> Iterator[None]:
    """Drops what this thread prints to sys.stdout inside the block; blocks must not be nested.

    What libraries print to standard error is dropped as well while no other thread runs, because
    theirs would be lost too.
    """
    with _REPLACED, quiet_libraries():
        _SILENT.add(threading.get_ident())
        try:
            yield
        finally:
            _SILENT.discard(threading.get_ident())


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Drops what libraries print to standard error inside the block, if no other thread runs."""
    if threading.active_count() > 1:
        yield
        return
    try:
        kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:  # standard error is closed
        yield
        return
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


@contextmanager
def _replaced_stdout() -> Iterator[None]:
    before = sys.stdout
    ours: Any = _OthersOnly(before)
    sys.stdout = ours
    try:
        yield
    finally:
        if sys.stdout is ours:
            sys.stdout = before


_REPLACED = SharedContext(_replaced_stdout)
