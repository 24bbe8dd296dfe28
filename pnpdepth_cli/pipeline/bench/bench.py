"""`pnpdepth bench`: time and memory of a refinement and its parts, relative to a forward pass."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from pnpdepth_cli.choices import LOSSES, SPACES
from pnpdepth_cli.completion.alignment import align
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.refine import RefineSettings, refine
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.errors import NoPointsError, PnpDepthError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.frame import synthetic_frame
from pnpdepth_cli.models.network import Network, load_network, out_of_memory_is_a_device_error
from pnpdepth_cli.models.rank_layers import default_layer
from pnpdepth_cli.pipeline.bench.timing import Quartiles, Timed, in_turn, peak_mb
from pnpdepth_cli.pipeline.refinement.inputs import read_inputs
from pnpdepth_cli.pipeline.refinement.output_files import plan_outputs
from pnpdepth_cli.pipeline.refinement.output_range import within_range
from pnpdepth_cli.pipeline.refinement.outputs import write_outputs
from pnpdepth_cli.pipeline.refinement.request import (
    FrameFiles,
    MethodOptions,
    NetworkChoice,
    OutputOptions,
    RefineRequest,
)
from pnpdepth_cli.pipeline.refinement.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.pipeline.stopwatch import versions
from pnpdepth_cli.points import SparsePoints

DEFAULT_SIZE = (480, 640)
FIRST_FRAME, FULL = "refinement, first frame", "refinement, fp32"
MASKED = "refinement, hidden points"
_WITH_PEAK = ("forward", "refinement", FIRST_FRAME, FULL, MASKED)
_CODES_PER_METRE = 1000.0  # of the synthetic sparse depth


@dataclass(frozen=True, kw_only=True)
class BenchRequest:
    """What to measure; None is the network's own default."""

    model: str = "compact"
    """A network, as `--model` names it."""
    checkpoint: Path | None = None
    """Its weights; None for its own, or random ones."""
    layer: str | None = None
    """Where it is cut."""
    size: tuple[int, int] | None = None
    """(H, W) of the synthetic frame."""
    points: int = 500
    """Sparse points of the frame."""
    iterations: int | None = None
    """Updates of z."""
    target: str = "given"
    """"masked" times refinement by hidden points as well, with the network's defaults."""
    precision: str = "fp32"
    """Of convolutions and matrix products."""
    device: str = "cpu"
    """Torch's name of the device."""
    repeats: int = 10
    """Measured runs, after one warm-up."""
    files: bool = True
    """True to measure reading, writing, alignment and propagation too."""


@dataclass(frozen=True, kw_only=True)
class BenchPart:
    """One timed part."""

    name: str
    """What was timed."""
    seconds: Quartiles
    """Of its runs."""
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
    """The network, as `--model` names it."""
    checkpoint: str | None
    """Its weights; None for random ones."""
    layer: str
    """Where it is cut."""
    size: tuple[int, int]
    """(H, W) of the image."""
    network_size: tuple[int, int]
    """(H, W) of the network's input."""
    points: int
    """Sparse points inside the network's crop."""
    iterations: int
    """Updates of z, K."""
    precision: str
    """Of convolutions and matrix products."""
    device: str
    """Torch's name of the device."""
    threads: int
    """Of torch on the CPU."""
    versions: dict[str, str]
    """Of the program and its libraries."""
    parts: tuple[BenchPart, ...]
    """What was timed."""
    limit_by_flops: float | None
    """The limit by counts of operations; None if none can be counted."""
    limit_measured: float
    """The limit by the times of front and rear."""
    depth_change: float | None
    """Mean |d − d'| / d', d' refined in fp32; None if the precision is fp32."""
    notes: tuple[str, ...]
    """What was assumed; one line each."""

    def part(self, name: str) -> BenchPart:
        """Returns the part of that name."""
        return next(part for part in self.parts if part.name == name)

    def record(self) -> dict[str, Any]:
        """Returns the result in JSON's own types."""
        return asdict(self)


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
    with tempfile.TemporaryDirectory(prefix="pnpdepth-") as folder, ExitStack() as stack:
        subject = _Subject.load(request, Path(folder))
        with out_of_memory_is_a_device_error(subject.network.device):
            return subject.measured(stack, on_round)


@dataclass(frozen=True, kw_only=True)
class _Subject:
    """A network and a synthetic frame for it; `files_request` names the frame's files."""

    request: BenchRequest
    files_request: RefineRequest
    network: Network
    layer: str
    settings: RefineSettings
    prepared: PreparedFrame

    @classmethod
    def load(cls, request: BenchRequest, folder: Path) -> _Subject:
        network = _network(request, request.precision)
        definition = network.definition
        policy = definition.size
        own = (policy.height, policy.width) if isinstance(policy, Fixed) else DEFAULT_SIZE
        rgb, points = synthetic_frame(request.size or own, request.points)
        refine_request = RefineRequest(
            files=FrameFiles(image=folder / "rgb.png", sparse=folder / "sparse.png"),
            network=NetworkChoice(model=request.model),
            method=MethodOptions(
                layer=request.layer,
                iterations=request.iterations,
                # the output of random weights has no relation to the points
                align=None if network.checkpoint or definition.complete else "none",
            ),
            outputs=OutputOptions(output=folder / "out", overwrite=True),
        )
        _write_frame(refine_request.files, rgb, points)
        layer = request.layer or default_layer(network, points.size, len(points))
        prepared = prepare(network, Frame(rgb=rgb[0], points=points))
        if not len(prepared.points):
            raise NoPointsError(
                f"none of {len(points)} points lies in the network's view; take more"
            )
        return cls(
            request=request,
            files_request=refine_request,
            network=network,
            layer=resolve_layer(definition, layer),
            settings=resolve_settings(definition, refine_request.method),
            prepared=prepared,
        )

    def measured(self, stack: ExitStack, on_round: Callable[[int, int], None]) -> Bench:
        """Measures all parts in turn."""
        device, notes = self.network.device, list(self.network.notes)
        opened = _network(self.request, self.request.precision)
        split = stack.enter_context(opened.cut_at(self.layer))
        with torch.no_grad():
            z = split.front(*self.prepared.arguments)
            output = split.rear(z)
            limit = _limit(*self._operations(split, z), self.settings.iterations)
        todo = self._engine_parts(split, z)
        change = None
        if self.request.precision != "fp32":
            full = _network(self.request, "fp32")
            full_split = stack.enter_context(full.cut_at(self.layer))
            todo[FULL] = Timed(run=lambda _: self._refined(full_split, full))
            change = _change(self._refined(split, self.network), self._refined(full_split, full))
        if self.request.target == "masked":
            todo[MASKED] = self._masked_part()
        if self.request.files:
            todo |= self._alignment_and_propagation(output, notes) | self._file_parts()
        spent = in_turn(todo, self.request.repeats, device, on_round=on_round)
        peaks = {name: peak_mb(_once(todo[name]), device) for name in _WITH_PEAK if name in todo}
        seconds = {name: Quartiles.of(each) for name, each in spent.items()}
        front, rear = seconds["front"].median, seconds["rear"].median
        measured = _limit(front, rear, self.settings.iterations)
        assert measured is not None
        return Bench(
            model=self.request.model,
            checkpoint=str(self.network.checkpoint) if self.network.checkpoint else None,
            layer=self.layer,
            size=self.prepared.map.image,
            network_size=self.prepared.map.network,
            points=len(self.prepared.points),
            iterations=self.settings.iterations,
            precision=self.request.precision,
            device=str(device),
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
            limit_by_flops=limit,
            limit_measured=measured,
            depth_change=change,
            notes=tuple(notes),
        )

    def _engine_parts(self, split: Split, z: Tensor) -> dict[str, Timed]:
        """The network, its front and rear, and the refinement; tensors in, tensors out."""
        no_grad, module = torch.no_grad(), self.network.module
        loss_of = LOSSES[self.settings.loss]

        def loss() -> tuple[Tensor, Tensor]:
            leaf = z.clone().requires_grad_(True)
            with torch.enable_grad():
                depth = self.network.depth_of(split.rear(leaf))
                return leaf, loss_of(self.prepared.points.sample(depth), self.prepared.points.depth)

        def first_frame(_: object) -> None:
            with self.network.cut_at(self.layer) as fresh:
                self._refined(fresh, self.network)

        return {
            "forward": Timed(run=no_grad(lambda _: module(*self.prepared.arguments))),
            "front": Timed(run=no_grad(lambda _: split.front(*self.prepared.arguments))),
            "rear": Timed(run=no_grad(lambda _: split.rear(z))),
            "rear backward": Timed(run=lambda prepared: gradient_at(*prepared), prepare=loss),
            "refinement": Timed(run=lambda _: self._refined(split, self.network)),
            FIRST_FRAME: Timed(run=first_frame),
        }

    def _masked_part(self) -> Timed:
        """A refinement by hidden points, the cut included."""
        method = replace(self.files_request.method, target="masked", layer=None, iterations=None)
        settings = resolve_settings(self.network.definition, method)

        def run(_: object) -> None:
            with self.network.cut_at_points() as split:
                refine_frame(self.network, split, settings, self.prepared.frame)

        return Timed(run=run)

    def _refined(self, split: Split, network: Network) -> Tensor:
        prepared = replace(self.prepared, network=network)
        return refine(
            split,
            prepared.arguments,
            prepared.points,
            self.settings,
            depth_of=prepared.depth_reader(self.settings),
        ).after

    def _alignment_and_propagation(self, output: Any, notes: list[str]) -> dict[str, Timed]:
        """Returns the jobs that time alignment and propagation, without those that fail here."""
        stated = self.network.definition.output_kind
        spaces = (stated,) if stated in SPACES else ("depth", "inverse")
        points = self.prepared.points
        predicted = points.sample(self.network.raw_of(output))
        depth = self.network.depth_of(output)
        of_depth = points.resized(*depth.shape[-2:])
        image = self.prepared.frame.rgb
        assert image is not None
        rgb = F.interpolate(image[None], of_depth.size, mode="bilinear")[0]
        jobs = {
            "alignment": Timed(run=lambda _: align(predicted, points, spaces, "auto")),
            "propagation": Timed(run=lambda _: propagate(depth[0, 0], of_depth, rgb, kind="gp")),
        }
        for name in list(jobs):
            try:
                jobs[name].run(None)
            except PnpDepthError as error:  # a constant, as of random weights, fits no points
                notes.append(f"{name} was not measured: {error}")
                del jobs[name]
        return jobs

    def _file_parts(self) -> dict[str, Timed]:
        """Reading and writing of files, as `pnpdepth refine` does it."""
        inputs, outputs = read_inputs(self.files_request), plan_outputs(self.files_request)
        with self.network.cut_at(self.layer) as split:
            frame = refine_frame(self.network, split, self.settings, inputs.frame())
        frame = within_range(outputs, inputs, frame)
        return {
            "reading": Timed(run=lambda _: read_inputs(self.files_request)),
            "writing": Timed(run=lambda _: write_outputs(outputs, inputs, frame)),
        }

    def _operations(self, split: Split, z: Tensor) -> tuple[float, float]:
        """Floating-point operations of the front and of the rear."""
        with FlopCounterMode(display=False) as whole:
            self.network.module(*self.prepared.arguments)
        with FlopCounterMode(display=False) as behind:
            split.rear(z)
        rear = behind.get_total_flops()
        return max(0, whole.get_total_flops() - rear), rear


def _network(request: BenchRequest, precision: str) -> Network:
    """The network of the request, with the same random weights each time if it has none."""
    torch.manual_seed(0)
    return load_network(
        request.model,
        request.checkpoint,
        request.device,
        precision=precision,
        untrained=True,
    )


def _write_frame(files: FrameFiles, rgb: Tensor, points: SparsePoints) -> None:
    assert isinstance(files.image, Path)
    assert files.sparse is not None
    cv2.imwrite(str(files.image), (255 * rgb[0].permute(1, 2, 0)).round().byte().numpy())
    write_depth(files.sparse, points.scatter()[0, 0].numpy(), scale=_CODES_PER_METRE)


def _limit(front: float, rear: float, iterations: int) -> float | None:
    return (front + (2 * iterations + 1) * rear) / (front + rear) if front + rear else None


def _change(depth: Tensor, of: Tensor) -> float:
    known = of > 0
    return float(((depth - of).abs()[known] / of[known]).mean())


def _once(timed: Timed) -> Callable[[], object]:
    return lambda: timed.run(timed.prepare())
