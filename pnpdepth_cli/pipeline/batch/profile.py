"""Where the time of a batch goes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

WAITING_TO_READ, NETWORK, WAITING_TO_WRITE = "waiting_for_reader", "network", "waiting_for_writer"
READING, WRITING = "reading", "writing"


class BatchProfile:
    """`with profile(NETWORK):` adds the seconds of the block, in whatever thread it runs.

    Network and waiting are times of the one thread that runs the network, and what is left of the
    wall time is Python in that thread. Reading and writing run beside it, in several threads, so
    the seconds of these are no share of the wall time.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._stages = (WAITING_TO_READ, NETWORK, WAITING_TO_WRITE, READING, WRITING)
        self._seconds = dict.fromkeys(self._stages, 0.0)
        self._wall = 0.0
        self._adding = threading.Lock()

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            with self._adding:
                self._seconds[stage] += time.perf_counter() - start

    def count(self) -> None:
        """One more frame is written."""
        with self._adding:
            self.frames += 1

    @contextmanager
    def wall(self) -> Iterator[None]:
        """The block is the whole of it."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._wall += time.perf_counter() - start

    def summary(self) -> dict[str, Any]:
        """{"frames": 24, "seconds": {"network": …, …, "wall": …}, "frames_per_second": …, …}."""
        wall = self._wall
        return {
            "frames": self.frames,
            "seconds": {stage: round(s, 4) for stage, s in self._seconds.items()}
            | {"wall": round(wall, 4)},
            "frames_per_second": round(self.frames / wall, 4) if wall else None,
            "network_busy": round(self._seconds[NETWORK] / wall, 4) if wall else None,
        }
