"""`pnpdepth refine`: one image, its sparse depth, and a network; refined depth and its record."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.core.metrics import Scores, score
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError, UsageError
from pnpdepth_cli.io.atomic import all_or_none
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement.frame import (
    FrameToRefine,
    PointError,
    RefinedFrame,
    point_error,
    refine_frame,
    split_points,
)
from pnpdepth_cli.pipeline.refinement.held_out import refine_with_folds, ways_of
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.pipeline.refinement.output_files import Outputs, plan_outputs
from pnpdepth_cli.pipeline.refinement.outputs import write_outputs
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import (
    resolve_definition,
    resolve_layer,
    resolve_settings,
)
from pnpdepth_cli.pipeline.refinement.tiles import refine_tiled
from pnpdepth_cli.pipeline.refinement.ways import Way
from pnpdepth_cli.pipeline.stopwatch import Stopwatch, peak_memory_mb, versions


@dataclass(frozen=True, kw_only=True)
class RefineOutcome:
    """A refined frame: `record` is what <stem>.json holds; `diverged` says why it stopped early."""

    record: dict[str, Any]
    diverged: DivergedError | None


def refine_image(
    request: RefineRequest,
    *,
    on_iteration: Callable[[int, int, float], None] = lambda done, of, loss: None,
) -> RefineOutcome:
    """The refined depth and its companions are on disk; what was done is returned.

    on_iteration(done, of, loss) is called after each update of z. Raises the errors of
    `pnpdepth_cli.errors`; then nothing is written.
    """
    watch = Stopwatch()
    outputs = plan_outputs(request)
    with watch("read"):
        inputs = read_inputs(request)
    with watch("load network"):
        refiner = load_refiner(request, inputs)
    with watch("refine"):
        of = refiner.settings.iterations
        with refiner.split() as split:
            frame = refiner.refine(
                split, inputs, on_iteration=lambda done, loss: on_iteration(done, of, loss)
            )
    return write_refined(outputs, refiner, inputs, frame, watch)


@dataclass(frozen=True, kw_only=True)
class Refiner:
    """A network with nothing left open, the layer to cut it at, and how to refine its frames.

    ways: with --auto, those that were found on other frames; None: each frame finds its own.
    """

    request: RefineRequest
    network: Network
    layer: str
    settings: RefineSettings
    ways: tuple[Way, ...] | None = None

    def split(self) -> Split:
        """The network cut at the layer, to be opened for as many frames as there are."""
        return self.network.cut_at(self.layer)

    def refine(
        self,
        split: Split,
        inputs: Inputs,
        *,
        on_iteration: Callable[[int, float], None] = lambda done, loss: None,
    ) -> RefinedFrame:
        """One frame refined in memory, the same whatever was refined before."""
        torch.manual_seed(self.request.hold_out.seed)
        task = self.task(inputs)
        if self.request.hold_out.needs_folds:
            return refine_with_folds(
                self.network, self.layer, self.settings, self.request, task, self.ways
            )
        if side := self.request.network.tile:
            return refine_tiled(
                self.network, split, self.settings, task, side, on_iteration=on_iteration
            )
        return refine_frame(self.network, split, self.settings, task, on_iteration=on_iteration)

    def with_ways_of(self, frames: Sequence[Inputs]) -> Refiner:
        """The same, its ways found on these frames."""
        tasks = [self.task(inputs) for inputs in frames]
        ways = ways_of(self.network, self.layer, self.settings, self.request, tasks)
        return replace(self, ways=ways)

    def task(self, inputs: Inputs) -> FrameToRefine:
        """The frame with its points as the request shares them out."""
        asked = self.request.hold_out
        used, held_out = split_points(inputs.points, asked.holdout, asked.seed)
        return FrameToRefine(
            inputs=inputs,
            used=used,
            held_out=held_out,
            propagate=self.request.method.propagate or "none",
        )

    @functools.cached_property
    def model_record(self) -> dict[str, Any]:
        """What a record says of the network."""
        checkpoint = self.network.checkpoint
        return {
            "name": self.network.definition.name,
            "spec": self.request.network.model,
            "checkpoint": str(checkpoint) if checkpoint else None,
            "checkpoint_sha256": sha256_of(checkpoint) if checkpoint else None,
        }


def load_refiner(request: RefineRequest, first: Inputs) -> Refiner:
    """The network that is asked for, with what it leaves open settled on this first frame.

    UsageError if the request asks for what does not go together.
    """
    choice, hold_out = request.network, request.hold_out
    if hold_out.time_budget_s is not None and not hold_out.auto:
        raise UsageError("--time-budget is for the trials of --auto; give that too")
    if choice.tile is not None and hold_out.needs_folds:
        raise UsageError("--tile goes with none of --auto, --baselines and --uncertainty")
    network = load_network(
        choice.model, choice.checkpoint, choice.device, precision=choice.precision
    )
    network = resolve_definition(network, first, choice)
    return Refiner(
        request=request,
        network=network,
        layer=resolve_layer(network.definition, request.method.layer),
        settings=resolve_settings(network.definition, request.method),
    )


def write_refined(
    outputs: Outputs, refiner: Refiner, inputs: Inputs, frame: RefinedFrame, watch: Stopwatch
) -> RefineOutcome:
    """The refined frame is scored, and it and its record are on disk.

    The record is the same from run to run, but for `seconds` and `peak_memory_mb`.
    """
    record = _record(refiner, inputs, frame)
    with all_or_none(outputs.paths()):
        with watch("write"):
            record |= write_outputs(outputs, inputs, frame)
        record["seconds"] = watch.seconds
        record["peak_memory_mb"] = peak_memory_mb(refiner.network.device)
        outputs.write_record(record)
    return RefineOutcome(record=record, diverged=frame.diverged)


def _record(refiner: Refiner, inputs: Inputs, frame: RefinedFrame) -> dict[str, Any]:
    request, network = refiner.request, refiner.network
    hold_out, propagate = request.hold_out, request.method.propagate
    return {
        "versions": versions(),
        "inputs": inputs.record,
        "model": refiner.model_record,
        "settings": {
            "layer": refiner.layer,
            **asdict(refiner.settings),
            "step": frame.refinement.step,
            "propagate": propagate if hold_out.auto else propagate or "none",
            "output_kind": network.definition.output_kind,
            "normalise": request.network.normalise,
            "holdout": hold_out.holdout,
            "seed": hold_out.seed,
            "precision": request.network.precision,
            "tile": request.network.tile,
            "device": str(network.device),
        },
        "alignment": asdict(frame.alignment) if frame.alignment else None,
        "size": [inputs.size[1], inputs.size[0]],
        "points": {
            "used": len(frame.used),
            "held_out": len(frame.held_out),
            "nearest": float(inputs.points.depth.min()),
            "farthest": float(inputs.points.depth.max()),
        },
        "loss": list(frame.refinement.losses),
        "sparse_error": _before_after(frame, lambda d: point_error(d, frame.used)),
        "held_out_error": _before_after(frame, lambda d: point_error(d, frame.held_out)),
        "scores": _before_after(frame, lambda d: _score(d, inputs.gt)),
        "auto": frame.choice,
        "baselines": frame.baselines,
        "diverged": str(frame.diverged) if frame.diverged else None,
        "notes": [note for note in (*inputs.notes, *network.notes, *frame.notes) if note],
    }


def _score(depth: NDArray[np.float32], gt: NDArray[np.float32] | None) -> Scores | None:
    return None if gt is None else score(torch.from_numpy(depth), torch.from_numpy(gt))


def _before_after(
    frame: RefinedFrame, measure: Callable[[NDArray[np.float32]], PointError | Scores | None]
) -> dict[str, Any] | None:
    before, after = measure(frame.before), measure(frame.after)
    if before is None or after is None:
        return None
    return {"before": asdict(before), "after": asdict(after)}
