"""What the time of a stage was spent on, noted where it is spent: `load (import 2.0, …)`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_noted: ContextVar[dict[str, float] | None] = ContextVar("_noted", default=None)


@contextmanager
def spent_on(part: str) -> Iterator[None]:
    """Notes the time inside as spent on this part, but for what is noted of other parts inside."""
    parts = _noted.get()
    if parts is None:
        yield
        return
    start = time.perf_counter()
    before = sum(parts.values())
    try:
        yield
    finally:
        others = sum(parts.values()) - before
        parts[part] = parts.get(part, 0.0) + time.perf_counter() - start - others


@contextmanager
def parts_of(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Adds the seconds of the parts noted inside under `STAGE: PART`."""
    parts = dict[str, float]()
    token = _noted.set(parts)
    try:
        yield
    finally:
        _noted.reset(token)
        for name, spent in parts.items():
            key = f"{stage}: {name}"
            seconds[key] = round(seconds.get(key, 0.0) + spent, 4)
