"""Frames through threads, in order, and what a run took: seconds, peak memory, versions."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import torch

THREADS = 2
"""Threads that read beside the computation, and that write."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(
    work: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    """Yields work(item) of each item in order, computed by several threads.

    Only a few items are taken in advance, so memory does not grow with their number. An exception
    of `work` is raised where its result would be yielded.

    Args:
        work: Function that the threads call.
        items: What it is called with, an item a call.
        workers: Number of threads.
    """
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if waiting[0].done() or len(waiting) > workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        # Where nobody takes the rest, or work has failed, what has not begun does not begin.
        finally:
            for future in waiting:
                future.cancel()


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Adds the time spent inside to `seconds[stage]`, also if it ends with an exception."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] = round(seconds.get(stage, 0.0) + time.perf_counter() - start, 4)


def peak_memory_mb(device: torch.device) -> dict[str, float]:
    """Returns the peak memory of the "process", and of the "gpu" if one is used, in 10^6 bytes."""
    peak = {"process": round(_peak_resident_bytes() / 1e6, 1)}
    if device.type == "cuda":
        import torch

        peak["gpu"] = round(torch.cuda.max_memory_allocated(device) / 1e6, 1)
    return peak


def _peak_resident_bytes() -> int:
    """The peak memory of the process in bytes; on macOS, its present memory."""
    # Linux tells the peak here, in a line such as `VmHWM:  123456 kB`.
    status = Path("/proc/self/status")
    if status.exists():
        line = next(row for row in status.read_text().splitlines() if row.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    # psutil has the peak on Windows only; on macOS it has no more than the present memory.
    import psutil

    memory = psutil.Process().memory_info()
    return int(getattr(memory, "peak_wset", memory.rss))
