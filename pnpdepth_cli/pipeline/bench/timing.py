"""Measures times and peak memory so that they can be compared."""

from __future__ import annotations

import ctypes
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch


@dataclass(frozen=True, kw_only=True)
class Quartiles:
    """Quartiles of the seconds of several runs."""

    median: float
    """Median."""
    lower: float
    """First quartile."""
    upper: float
    """Third quartile."""
    runs: int
    """Number of runs."""

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Quartiles:
        """Returns the quartiles of at least one run."""
        if len(seconds) == 1:
            return cls(median=seconds[0], lower=seconds[0], upper=seconds[0], runs=1)
        lower, median, upper = statistics.quantiles(seconds, n=4, method="inclusive")
        return cls(median=median, lower=lower, upper=upper, runs=len(seconds))


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A function to time."""

    run: Callable[[Any], object]
    """Takes the result of `prepare`; timed."""
    prepare: Callable[[], Any] = lambda: None
    """Called before each run; not timed."""


def in_turn(
    todo: Mapping[str, Timed],
    repeats: int,
    device: torch.device,
    *,
    on_round: Callable[[int, int], None] = lambda done, of: None,
) -> dict[str, list[float]]:
    """Returns the seconds of every run of each function, without a first warm-up run.

    The functions run in turn, so that other load on the machine slows all of them alike.

    Args:
        todo: The functions by name.
        repeats: Measured runs of each.
        device: Synchronised whenever the clock is read.
        on_round: Called with (done, of) after each round.
    """
    spent: dict[str, list[float]] = {name: [] for name in todo}
    for number in range(-1, repeats):
        for name, timed in todo.items():
            prepared = timed.prepare()
            synchronise(device)
            start = time.perf_counter()
            timed.run(prepared)
            synchronise(device)
            if number >= 0:
                spent[name].append(time.perf_counter() - start)
        on_round(number + 2, repeats + 1)
    return spent


def synchronise(device: torch.device) -> None:
    """Waits until the device has finished its work."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize()


def peak_mb(run: Callable[[], object], device: torch.device) -> float | None:
    """Returns the peak memory of `run` beyond what is in use before, in 10^6 bytes.

    On a GPU of its tensors, else of the process; None where the system does not measure it.
    """
    if device.type == "cuda":
        synchronise(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        run()
        synchronise(device)
        return (torch.cuda.max_memory_allocated(device) - before) / 1e6
    _release_free_memory()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak to what is in use now
        resident = _kilobytes("VmRSS")
        run()
        return max(0.0, (_kilobytes("VmHWM") - resident) * 1024 / 1e6)
    except OSError:
        return None


def _kilobytes(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def _release_free_memory() -> None:
    """Returns free memory of the C library to the system, as reuse of it would not be measured."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
