"""Silences what the calling thread prints to sys.stdout, and no other thread.

OpenEXR's binding prints its warnings there, where data of a command belongs.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pnpdepth_cli.io.shared_context import SharedContext

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
    """Drops what this thread prints to sys.stdout inside the block; blocks must not be nested."""
    with _REPLACED:
        _SILENT.add(threading.get_ident())
        try:
            yield
        finally:
            _SILENT.discard(threading.get_ident())


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
