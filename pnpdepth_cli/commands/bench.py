"""`pnpdepth bench`: time and memory of a refinement and its parts, relative to a forward pass."""

from __future__ import annotations

import ctypes
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.commands.stopwatch import versions
from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.refine import refine
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.frame import synthetic_frame
from pnpdepth_cli.models.network import load_network, out_of_memory_is_a_device_error
from pnpdepth_cli.models.rank_layers import default_layer
from pnpdepth_cli.settings import Settings

DEFAULT_SIZE = (480, 640)
FIRST_FRAME = "refinement, first frame"
_WITH_PEAK = ("forward", "refinement", FIRST_FRAME)


def run_bench(
    model: str = "compact",
    checkpoint: Path | None = None,
    *,
    layer: str | None = None,
    size: tuple[int, int] | None = None,
    points: int = 500,
    iterations: int | None = None,
    precision: str = "fp32",
    device: str = "cpu",
    repeats: int = 10,
    on_round: Callable[[int, int], None] = lambda done, of: None,
) -> dict[str, Any]:
    """Returns the times and memory of all parts on a synthetic frame; None is the network's own.

    A network without weights gets random ones. Each of `parts` has, by its name, the quartiles of
    the seconds of its runs, its median in forward passes, and its peak memory beyond what was in
    use before in 10^6 bytes, None if not measured. `limit` is (front + (2K + 1)·rear) / (front +
    rear) forward passes: what K updates cost at least.

    Args:
        model: As of `load_network`, with `checkpoint`, `precision` and `device`.
        layer: Where the network is cut.
        size: (H, W) of the frame.
        points: Of the frame.
        iterations: K.
        repeats: Measured runs, after one warm-up.
        on_round: Called with (done, of) after every round, in which each part runs once.
    """
    torch.manual_seed(0)  # the same random weights each time
    network = load_network(model, checkpoint, device, precision=precision, untrained=True)
    policy = network.definition.size
    own = (policy.height, policy.width) if isinstance(policy, Fixed) else DEFAULT_SIZE
    rgb, drawn = synthetic_frame(size or own, points)
    layer = layer or default_layer(network, drawn.size, len(drawn))
    layer = resolve_layer(network.definition, layer)
    method = Settings()
    if iterations is not None:
        method = replace(method, iterations=iterations)
    if not (network.checkpoint or network.definition.complete):
        method = replace(method, align="none")  # random weights have no relation to the points
    settings = resolve_settings(network.definition, method)
    prepared = prepare(network, Frame(rgb=rgb[0], points=drawn))
    if not len(prepared.points):
        raise NoPointsError(f"none of {points} points lies in the network's view; take more")
    with out_of_memory_is_a_device_error(network.device), network.cut_at(layer) as split:
        todo = _parts(split, layer, prepared, settings)
        spent = in_turn(todo, repeats, network.device, on_round=on_round)
        peaks = {name: peak_mb(todo[name], network.device) for name in _WITH_PEAK}
    forward, front, rear = (statistics.median(spent[name]) for name in ("forward", "front", "rear"))
    parts = {}
    for name, seconds in spent.items():
        many = seconds if len(seconds) > 1 else seconds * 2
        lower, median, upper = statistics.quantiles(many, n=4, method="inclusive")
        parts[name] = {
            "median_s": median,
            "lower_s": lower,
            "upper_s": upper,
            "forwards": median / forward,
            "peak_mb": peaks.get(name),
        }
    return {
        "model": model,
        "checkpoint": str(network.checkpoint) if network.checkpoint else None,
        "layer": layer,
        "size": list(prepared.map.image),
        "network_size": list(prepared.map.network),
        "points": len(prepared.points),
        "iterations": settings.iterations,
        "precision": precision,
        "device": str(network.device),
        "threads": torch.get_num_threads(),
        "versions": versions(),
        "parts": parts,
        "limit": (front + (2 * settings.iterations + 1) * rear) / (front + rear),
        "notes": list(network.notes),
    }


def _parts(
    split: Split, layer: str, prepared: PreparedFrame, settings: Settings
) -> dict[str, Callable[[], object]]:
    """The network, its front and rear, and the refinement; tensors in, tensors out."""
    network, arguments, no_grad = prepared.network, prepared.arguments, torch.no_grad()
    reader, loss_of = prepared.depth_reader(settings), checked_loss(settings.loss)
    z = no_grad(split.front)(*arguments)

    def rear_and_gradient() -> Tensor | None:
        leaf = z.clone().requires_grad_(True)
        with torch.enable_grad():
            depth = network.depth_of(split.rear(leaf))
            loss = loss_of(prepared.points.sample(depth), prepared.points.depth)
            return gradient_at(leaf, loss)

    def refined(cut: Split) -> Tensor:
        return refine(cut, arguments, prepared.points, settings, depth_of=reader).after

    def first_frame() -> Tensor:
        with network.cut_at(layer) as fresh:
            return refined(fresh)

    return {
        "forward": no_grad(partial(network.module, *arguments)),
        "front": no_grad(partial(split.front, *arguments)),
        "rear": no_grad(partial(split.rear, z)),
        "rear and gradient": rear_and_gradient,
        "refinement": partial(refined, split),
        FIRST_FRAME: first_frame,
    }


def in_turn(
    todo: Mapping[str, Callable[[], object]],
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
        for name, run in todo.items():
            _synchronise(device)
            start = time.perf_counter()
            run()
            _synchronise(device)
            if number >= 0:
                spent[name].append(time.perf_counter() - start)
        on_round(number + 2, repeats + 1)
    return spent


def _synchronise(device: torch.device) -> None:
    if device.type != "cpu":
        torch.get_device_module(device).synchronize()


def peak_mb(run: Callable[[], object], device: torch.device) -> float | None:
    """Returns the peak memory of `run` beyond what is in use before, in 10^6 bytes.

    On a GPU of its tensors, else of the process; None where the system does not measure it.
    """
    if device.type == "cuda":
        _synchronise(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        run()
        _synchronise(device)
        return (torch.cuda.max_memory_allocated(device) - before) / 1e6
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)  # reuse of the C library's free memory would not be measured
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
