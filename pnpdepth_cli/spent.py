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
    """Adds the seconds of the block to those of one part of the stage that `parts_of` times.

    Blocks may be nested: the seconds of an inner one count for its own part alone. Outside
    `parts_of` nothing is timed.

    Args:
        part: Name of the part, such as "import".
    """
    seconds = _noted.get()
    if seconds is None:  # outside `parts_of`
        yield
        return
    start_s = time.perf_counter()
    noted_before_s = sum(seconds.values())  # of parts that ended before this one began
    try:
        yield
    finally:
        # What inner blocks noted meanwhile is theirs alone.
        on_inner_s = sum(seconds.values()) - noted_before_s
        on_this_s = time.perf_counter() - start_s - on_inner_s
        seconds[part] = seconds.get(part, 0.0) + on_this_s


@contextmanager
def parts_of(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Adds to a table the seconds that the block's parts took, as `spent_on` times them.

    Args:
        seconds: The table, seconds by name; a part is under `STAGE: PART`. It is changed.
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
