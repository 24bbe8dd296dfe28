"""Measures where the time of a batch goes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

WAITING_TO_READ, NETWORK, WAITING_TO_WRITE = "waiting_for_reader", "network", "waiting_for_writer"
READING, WRITING = "reading", "writing"


class BatchProfile:
    """`with profile(NETWORK):` adds the seconds of the block, in any thread.

    Network and waiting are times of the one thread that runs the network; the rest of the wall time
    is Python in that thread. Reading and writing run in parallel in other threads, so their seconds
    do not add up to the wall time.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._stages = (WAITING_TO_READ, NETWORK, WAITING_TO_WRITE, READING, WRITING)
        self._seconds = dict.fromkeys(self._stages, 0.0)
        self._wall = 0.0
        self._workers: list[dict[str, Any]] = []
        self._adding = threading.Lock()

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Adds the time spent inside to the stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            with self._adding:
                self._seconds[stage] += time.perf_counter() - start

    def count(self) -> None:
        """Counts one more written frame."""
        with self._adding:
            self.frames += 1

    @contextmanager
    def wall(self) -> Iterator[None]:
        """Measures the block as the wall time."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._wall += time.perf_counter() - start

    def add_workers(self, figures: Sequence[dict[str, Any]]) -> None:
        """Adds what `summary` gave in each worker of a cluster."""
        for each in figures:
            self.frames += each.get("frames", 0)
            for stage in self._stages:
                self._seconds[stage] += each.get("seconds", {}).get(stage, 0.0)
        self._workers = list(figures)

    def summary(self) -> dict[str, Any]:
        """Returns {"frames": 24, "seconds": {"network": …, "wall": …}, …}."""
        wall, devices = self._wall, max(1, len(self._workers))
        return {
            "frames": self.frames,
            "seconds": {stage: round(s, 4) for stage, s in self._seconds.items()}
            | {"wall": round(wall, 4)},
            "frames_per_second": round(self.frames / wall, 4) if wall else None,
            "network_busy": round(self._seconds[NETWORK] / wall / devices, 4) if wall else None,
            **({"workers": self._workers} if self._workers else {}),
        }
