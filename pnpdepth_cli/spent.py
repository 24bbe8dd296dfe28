"""What the time of a stage was spent on, noted where it is spent: `load (import 2.0, …)`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_noted: ContextVar[dict[str, float] | None] = ContextVar("_noted", default=None)
"""Seconds by part, of the stage that is running. None: nothing is noted."""


@contextmanager
def spent_on(part: str) -> Iterator[None]:
    """Inside, the time counts as spent on one part of a stage, but for that on parts inside it.

    Nothing is noted outside `parts_of`.

    Args:
        part: Name of the part, such as "import".
    """
    seconds = _noted.get()
    if seconds is None:
        yield
        return
    start = time.perf_counter()
    before = sum(seconds.values())
    try:
        yield
    finally:
        on_others = sum(seconds.values()) - before
        on_this = time.perf_counter() - start - on_others
        seconds[part] = seconds.get(part, 0.0) + on_this


@contextmanager
def parts_of(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Inside, `spent_on` notes parts of a stage; afterwards their seconds are added to a table.

    Args:
        seconds: The table, seconds by name; a part is under `STAGE: PART`.
        stage: Name of the stage, such as "load network".
    """
    parts = dict[str, float]()
    token = _noted.set(parts)
    try:
        yield
    finally:
        _noted.reset(token)
        for name, spent_s in parts.items():
            key = f"{stage}: {name}"
            seconds[key] = round(seconds.get(key, 0.0) + spent_s, 4)
