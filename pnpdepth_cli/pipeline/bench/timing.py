"""How long things take and how much memory they need, measured so that they can be compared."""

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
class Spread:
    """Seconds of a number of runs: their median and quartiles."""

    median: float
    lower: float
    upper: float
    runs: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Spread:
        """That of at least one run."""
        if len(seconds) == 1:
            return cls(median=seconds[0], lower=seconds[0], upper=seconds[0], runs=1)
        lower, median, upper = statistics.quantiles(seconds, n=4, method="inclusive")
        return cls(median=median, lower=lower, upper=upper, runs=len(seconds))


@dataclass(frozen=True, kw_only=True)
class Timed:
    """Something to time: `run` is given what `prepare`, which is not timed, returns."""

    run: Callable[[Any], object]
    prepare: Callable[[], Any] = lambda: None


def in_turn(
    todo: Mapping[str, Timed],
    repeats: int,
    device: torch.device,
    *,
    on_round: Callable[[int, int], None] = lambda done, of: None,
) -> dict[str, list[float]]:
    """Seconds of every run of each thing, after one that does not count.

    One of each in turn, so that what else the machine does slows all of them alike; the device has
    finished whenever the clock is read. on_round(done, of) is called after each round.
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
    """The device has done all that it was told to."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize()


def peak_mb(run: Callable[[], object], device: torch.device) -> float | None:
    """Memory in 10^6 bytes that `run` needs at its peak, beyond what is in use before.

    On a GPU that of its tensors, else that of the process; None where the system does not say.
    """
    if device.type == "cuda":
        synchronise(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        run()
        synchronise(device)
        return (torch.cuda.max_memory_allocated(device) - before) / 1e6
    _give_back_what_is_free()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak is what is in use now
        resident = _kilobytes("VmRSS")
        run()
        return max(0.0, (_kilobytes("VmHWM") - resident) * 1024 / 1e6)
    except OSError:
        return None


def _kilobytes(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def _give_back_what_is_free() -> None:
    """Free memory that the C library keeps would hide what is taken of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
