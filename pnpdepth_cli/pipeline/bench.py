"""`pnpdepth bench`: time and memory of a refinement and its parts, relative to a forward pass."""

from __future__ import annotations

import ctypes
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from pnpdepth_cli.choices import LOSSES
from pnpdepth_cli.core.refine import refine
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.errors import NoPointsError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.frame import synthetic_frame
from pnpdepth_cli.models.network import Network, load_network, out_of_memory_is_a_device_error
from pnpdepth_cli.models.rank_layers import default_layer
from pnpdepth_cli.pipeline.stopwatch import versions
from pnpdepth_cli.settings import Settings

DEFAULT_SIZE = (480, 640)
FIRST_FRAME, FULL = "refinement, first frame", "refinement, fp32"
MASKED = "refinement, hidden points"
_WITH_PEAK = ("forward", "refinement", FIRST_FRAME, FULL, MASKED)


@dataclass(frozen=True, kw_only=True)
class BenchRequest:
    """What to measure; None is the network's own default."""

    model: str = "compact"
    checkpoint: Path | None = None
    layer: str | None = None
    size: tuple[int, int] | None = None
    """(H, W) of the synthetic frame."""
    points: int = 500
    iterations: int | None = None
    target: str = "given"
    """"masked" times refinement by hidden points as well, with the network's defaults."""
    precision: str = "fp32"
    device: str = "cpu"
    repeats: int = 10
    """Measured runs, after one warm-up."""


@dataclass(frozen=True, kw_only=True)
class Quartiles:
    """Quartiles of the seconds of several runs."""

    median: float
    lower: float
    upper: float
    runs: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Quartiles:
        """Returns the quartiles of at least one run."""
        many = list(seconds) if len(seconds) > 1 else [*seconds] * 2
        lower, median, upper = statistics.quantiles(many, n=4, method="inclusive")
        return cls(median=median, lower=lower, upper=upper, runs=len(seconds))


@dataclass(frozen=True, kw_only=True)
class BenchPart:
    """One timed part."""

    name: str
    seconds: Quartiles
    forwards: float
    """Its median in forward passes."""
    peak_mb: float | None
    """Peak memory beyond what was in use before, 10^6 bytes; None if not measured."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The result of `run_bench`.

    The limit, (front + (2K + 1)·rear) / (front + rear) forward passes, is what K updates cost at
    least.
    """

    model: str
    checkpoint: str | None
    """None for random weights."""
    layer: str
    size: tuple[int, int]
    """(H, W) of the image."""
    network_size: tuple[int, int]
    """(H, W) of the network's input."""
    points: int
    """Sparse points inside the network's crop."""
    iterations: int
    precision: str
    device: str
    threads: int
    """Of torch on the CPU."""
    versions: dict[str, str]
    parts: tuple[BenchPart, ...]
    limit_by_flops: float | None
    """The limit by counts of operations; None if none can be counted."""
    limit_measured: float
    """The limit by the times of front and rear."""
    depth_change: float | None
    """Mean |d − d'| / d', d' refined in fp32; None if the precision is fp32."""
    notes: tuple[str, ...]

    def part(self, name: str) -> BenchPart:
        """Returns the part of that name."""
        return next(part for part in self.parts if part.name == name)


def run_bench(
    request: BenchRequest, *, on_round: Callable[[int, int], None] = lambda done, of: None
) -> Bench:
    """Returns the times and memory of all parts on a synthetic frame.

    A network without weights gets random ones.

    Args:
        request: What to measure.
        on_round: Called with (done, of) after every round, in which each part runs once.
    """
    if request.repeats < 1 or request.points < 1:
        raise UsageError(
            f"repeats {request.repeats}, points {request.points}: there must be at least one"
        )
    network = _network(request, request.precision)
    policy = network.definition.size
    own = (policy.height, policy.width) if isinstance(policy, Fixed) else DEFAULT_SIZE
    rgb, points = synthetic_frame(request.size or own, request.points)
    layer = request.layer or default_layer(network, points.size, len(points))
    layer = resolve_layer(network.definition, layer)
    method = Settings()
    if request.iterations is not None:
        method = replace(method, iterations=request.iterations)
    if not (network.checkpoint or network.definition.complete):
        method = replace(method, align="none")  # random weights have no relation to the points
    settings = resolve_settings(network.definition, method)
    prepared = prepare(network, Frame(rgb=rgb[0], points=points))
    if not len(prepared.points):
        raise NoPointsError(f"none of {len(points)} points lies in the network's view; take more")
    with out_of_memory_is_a_device_error(network.device), ExitStack() as stack:
        split = stack.enter_context(network.cut_at(layer))
        todo = _parts(split, layer, prepared, settings)
        change = None
        if request.precision != "fp32":
            full = replace(prepared, network=_network(request, "fp32"))
            full_split = stack.enter_context(full.network.cut_at(layer))
            todo[FULL] = Timed(run=lambda _: _refined(full_split, full, settings))
            depth, exact = _refined(split, prepared, settings), todo[FULL].run(None)
            change = float(((depth - exact).abs() / exact)[exact > 0].mean())
        if request.target == "masked":
            masked = replace(method.opened("iterations"), target="masked")
            todo[MASKED] = _masked(prepared, resolve_settings(network.definition, masked))
        spent = in_turn(todo, request.repeats, network.device, on_round=on_round)
        peaks = {
            name: peak_mb(partial(_once, timed), network.device)
            for name, timed in todo.items()
            if name in _WITH_PEAK
        }
        operations = _operations(split, prepared)
    seconds = {name: Quartiles.of(each) for name, each in spent.items()}
    front, rear = seconds["front"].median, seconds["rear"].median
    measured = _limit(front, rear, settings.iterations)
    assert measured is not None
    return Bench(
        model=request.model,
        checkpoint=str(network.checkpoint) if network.checkpoint else None,
        layer=layer,
        size=prepared.map.image,
        network_size=prepared.map.network,
        points=len(prepared.points),
        iterations=settings.iterations,
        precision=request.precision,
        device=str(network.device),
        threads=torch.get_num_threads(),
        versions=versions(),
        parts=tuple(
            BenchPart(
                name=name,
                seconds=each,
                forwards=each.median / seconds["forward"].median,
                peak_mb=peaks.get(name),
            )
            for name, each in seconds.items()
        ),
        limit_by_flops=_limit(*operations, settings.iterations),
        limit_measured=measured,
        depth_change=change,
        notes=tuple(network.notes),
    )


def _network(request: BenchRequest, precision: str) -> Network:
    """The network of the request, with the same random weights each time if it has none."""
    torch.manual_seed(0)
    return load_network(
        request.model, request.checkpoint, request.device, precision=precision, untrained=True
    )


def _parts(
    split: Split, layer: str, prepared: PreparedFrame, settings: Settings
) -> dict[str, Timed]:
    """The network, its front and rear, and the refinement; tensors in, tensors out."""
    network, arguments, no_grad = prepared.network, prepared.arguments, torch.no_grad()
    loss_of = LOSSES[settings.loss]
    z = no_grad(split.front)(*arguments)

    def loss() -> tuple[Tensor, Tensor]:
        leaf = z.clone().requires_grad_(True)
        with torch.enable_grad():
            depth = network.depth_of(split.rear(leaf))
            return leaf, loss_of(prepared.points.sample(depth), prepared.points.depth)

    def first_frame(_: object) -> None:
        with network.cut_at(layer) as fresh:
            _refined(fresh, prepared, settings)

    return {
        "forward": Timed(run=no_grad(lambda _: network.module(*arguments))),
        "front": Timed(run=no_grad(lambda _: split.front(*arguments))),
        "rear": Timed(run=no_grad(lambda _: split.rear(z))),
        "rear backward": Timed(run=lambda started: gradient_at(*started), prepare=loss),
        "refinement": Timed(run=lambda _: _refined(split, prepared, settings)),
        FIRST_FRAME: Timed(run=first_frame),
    }


def _masked(prepared: PreparedFrame, settings: Settings) -> Timed:
    """A refinement by hidden points, the cut included."""

    def run(_: object) -> None:
        with prepared.network.cut_at_points() as split:
            refine_frame(prepared.network, split, settings, prepared.frame)

    return Timed(run=run)


def _refined(split: Split, prepared: PreparedFrame, settings: Settings) -> Tensor:
    reader = prepared.depth_reader(settings)
    return refine(split, prepared.arguments, prepared.points, settings, depth_of=reader).after


@torch.no_grad()
def _operations(split: Split, prepared: PreparedFrame) -> tuple[float, float]:
    """Floating-point operations of the front and of the rear."""
    z = split.front(*prepared.arguments)
    with FlopCounterMode(display=False) as whole:
        prepared.network.module(*prepared.arguments)
    with FlopCounterMode(display=False) as behind:
        split.rear(z)
    rear = behind.get_total_flops()
    return max(0, whole.get_total_flops() - rear), rear


def _limit(front: float, rear: float, iterations: int) -> float | None:
    return (front + (2 * iterations + 1) * rear) / (front + rear) if front + rear else None


# measuring


def _once(timed: Timed) -> None:
    timed.run(timed.prepare())


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A function to time."""

    run: Callable[[Any], Any]
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
            _synchronise(device)
            start = time.perf_counter()
            timed.run(prepared)
            _synchronise(device)
            if number >= 0:
                spent[name].append(time.perf_counter() - start)
        on_round(number + 2, repeats + 1)
    return spent


def _synchronise(device: torch.device) -> None:
    """Waits until the device has finished its work."""
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


# the paper's table IV


@dataclass(frozen=True, kw_only=True)
class PaperTime:
    """A network of the paper, and the seconds that the paper prints; None if not printed."""

    name: str
    """The paper's name of it."""
    model: str
    """Ours."""
    data: str
    size: tuple[int, int]
    """(H, W) of its frames."""
    before: float | None = None
    """The network alone, on a GPU that the paper does not name."""
    after: float | None = None

    @property
    def forwards(self) -> float | None:
        """The paper's refinement in forward passes."""
        return None if self.before is None or self.after is None else self.after / self.before


_NYU, _KITTI = (228, 304), (352, 1216)
PAPER_TIMES = tuple(
    PaperTime(name=name, model=model, data=data, size=size, before=before, after=after)
    for name, model, data, size, before, after in (
        ("Eigen", "eigen", "NYU", _NYU, None, None),
        ("FCRN", "fcrn", "NYU", _NYU, None, None),
        ("Zhou", "sfmlearner", "KITTI", (128, 416), None, None),
        ("Uhrig", "sparseconv", "KITTI", _KITTI, 0.0311, 0.1614),
        ("Chodosh", "adnn", "KITTI", _KITTI, 0.0320, 0.0447),
        ("Ma", "sparse2dense-r18-deconv3", "NYU", _NYU, 0.0046, 0.0233),
        ("Jaritz", "latefusion", "NYU", (224, 320), 0.0484, 0.1593),
    )
)
"""Wang et al. (ICRA 2019), Table IV, and the three networks that it leaves out."""


def bench_table(
    *,
    repeats: int,
    precision: str,
    device: str,
    on_network: Callable[[int, int, str], None] = lambda done, of, name: None,
) -> list[tuple[PaperTime, Bench]]:
    """Returns the times of the paper's networks beside ours: full size, random weights, K = 5.

    Args:
        repeats: Measured runs of each part.
        precision: Of convolutions and matrix products.
        device: Torch's name of the device.
        on_network: Called with (done, of, name) before each network.
    """
    rows = []
    for number, paper in enumerate(PAPER_TIMES):
        on_network(number, len(PAPER_TIMES), paper.model)
        request = BenchRequest(
            model=paper.model,
            size=paper.size,
            iterations=5,
            precision=precision,
            device=device,
            repeats=repeats,
        )
        rows.append((paper, run_bench(request)))
    return rows


def table_record(rows: Sequence[tuple[PaperTime, Bench]]) -> list[dict[str, Any]]:
    """Returns the table in JSON's own types."""
    return [{"paper": asdict(paper), "bench": asdict(bench)} for paper, bench in rows]
