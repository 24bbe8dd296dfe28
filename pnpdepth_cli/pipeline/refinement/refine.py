"""`pnpdepth refine`: one image, its sparse depth, and a network; refined depth and its record."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.auto.candidates import Candidate
from pnpdepth_cli.core.metrics import Scores, score
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError, PnpDepthError, UsageError
from pnpdepth_cli.frames.frame import Frame, RefinedFrame
from pnpdepth_cli.frames.refine import OnIteration, refine_frames
from pnpdepth_cli.frames.tiles import refine_tiled
from pnpdepth_cli.io.atomic import all_or_none
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement.held_out import best_candidates, refine_with_folds
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.pipeline.refinement.output_files import Outputs, plan_outputs
from pnpdepth_cli.pipeline.refinement.output_range import within_range
from pnpdepth_cli.pipeline.refinement.outputs import write_outputs
from pnpdepth_cli.pipeline.refinement.points import PointError, point_error, split_points
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import (
    moves_weights,
    resolve_definition,
    resolve_layer,
    resolve_settings,
)
from pnpdepth_cli.pipeline.stopwatch import Stopwatch, peak_memory_mb, versions
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class RefineOutcome:
    """A refined frame on disk."""

    record: dict[str, Any]
    """What <stem>.json holds."""
    diverged: DivergedError | None
    """Why the refinement stopped early. None if it did not."""


def refine_image(
    request: RefineRequest,
    *,
    on_iteration: Callable[[int, int, float], None] = lambda done, of, loss: None,
) -> RefineOutcome:
    """Refines one frame, writes its depth and companions, and returns what was done.

    Args:
        request: What is asked for.
        on_iteration: Called with (done, of, loss) after each update of z.

    Raises:
        PnpDepthError: Any of its kinds; then nothing is written.
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
    """A network with nothing left open, and how to refine its frames."""

    request: RefineRequest
    """What is asked for."""
    network: Network
    """The network."""
    layer: str
    """Layer to cut at."""
    settings: RefineSettings
    """How z is updated."""
    shortlist: tuple[Candidate, ...] | None = None
    """With `--auto`, the candidates that compete. None: each frame finds its own."""

    def split(self) -> Split:
        """Returns the network cut at the layer, or at its sparse depth, to be opened for all."""
        if self.settings.masked:
            return self.network.cut_at_points()
        return self.network.cut_at(self.layer)

    def refine(
        self,
        split: Split,
        inputs: Inputs,
        *,
        on_iteration: OnIteration = lambda done, loss: None,
    ) -> RefinedFrame:
        """Returns one frame refined in memory, the same whatever was refined before.

        Raises:
            PnpDepthError: The frame cannot be refined.
        """
        request = self.request
        torch.manual_seed(request.hold_out.seed)
        frame, held_out = self._split_frame(inputs)
        refined: RefinedFrame | PnpDepthError
        if request.hold_out.needs_folds:
            refined = refine_with_folds(
                self.network, self.layer, self.settings, request, frame, inputs.gt, self.shortlist
            )
        elif side := request.network.tile:
            refined = refine_tiled(
                self.network,
                split,
                self.settings,
                frame,
                side,
                propagation=self._propagation,
                on_iteration=on_iteration,
            )
        else:
            (refined,) = refine_frames(
                self.network,
                split,
                self.settings,
                (frame,),
                propagation=self._propagation,
                on_iteration=on_iteration,
            )
        if isinstance(refined, PnpDepthError):
            raise refined
        return replace(refined, held_out=held_out)

    def refine_together(
        self, split: Split, group: Sequence[Inputs], settings: RefineSettings
    ) -> list[RefinedFrame | PnpDepthError]:
        """Returns frames of one size refined in one pass; an error in place of a failed frame.

        Args:
            split: The network cut at the layer, open.
            group: The frames.
            settings: How z is updated.

        Raises:
            BatchError: The network does not take them together.
        """
        torch.manual_seed(self.request.hold_out.seed)
        frames, held_out = zip(*(self._split_frame(inputs) for inputs in group), strict=True)
        refined = refine_frames(
            self.network, split, settings, frames, propagation=self._propagation
        )
        return [
            replace(each, held_out=points) if isinstance(each, RefinedFrame) else each
            for each, points in zip(refined, held_out, strict=True)
        ]

    def with_shortlist_of(self, group: Sequence[Inputs]) -> Refiner:
        """Returns the same refiner with the candidates that are best on these frames."""
        frames = [self._split_frame(inputs)[0] for inputs in group]
        best = best_candidates(self.network, self.layer, self.settings, self.request, frames)
        return replace(self, shortlist=best)

    def _split_frame(self, inputs: Inputs) -> tuple[Frame, SparsePoints]:
        """The frame with the points to use, and the points held out."""
        asked = self.request.hold_out
        used, held_out = split_points(inputs.points, asked.holdout, asked.seed)
        return inputs.frame().with_points(used), held_out

    @property
    def _propagation(self) -> str:
        return self.request.method.propagate or "none"

    @functools.cached_property
    def model_record(self) -> dict[str, Any]:
        """Entries of the network in a record."""
        checkpoint = self.network.checkpoint
        return {
            "name": self.network.definition.name,
            "spec": self.request.network.model,
            "checkpoint": str(checkpoint) if checkpoint else None,
            "checkpoint_sha256": sha256_of(checkpoint) if checkpoint else None,
        }


def load_refiner(request: RefineRequest, first: Inputs) -> Refiner:
    """Returns the refiner that is asked for; this first frame decides what the network leaves open.

    Raises:
        UsageError: The request combines what cannot be combined.
        ModelError: The network cannot be loaded.
    """
    choice, hold_out = request.network, request.hold_out
    if hold_out.time_budget_s is not None and not (hold_out.auto or moves_weights(request.method)):
        raise UsageError("--time-budget is for the trials of --auto; give that too")
    if choice.tile is not None and hold_out.needs_folds:
        raise UsageError("--tile goes with none of --auto, --baselines and --uncertainty")
    network = load_network(
        choice.model, choice.checkpoint, choice.device, precision=choice.precision
    )
    network = resolve_definition(network, first.frame(), choice)
    return Refiner(
        request=request,
        network=network,
        layer=resolve_layer(network.definition, request.method.layer),
        settings=resolve_settings(network.definition, request.method, hold_out),
    )


def write_refined(
    outputs: Outputs, refiner: Refiner, inputs: Inputs, frame: RefinedFrame, watch: Stopwatch
) -> RefineOutcome:
    """Scores the refined frame and writes it with its record.

    The record is the same from run to run, except `seconds` and `peak_memory_mb`.
    """
    frame = within_range(outputs.depth, inputs, frame)
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
        "kept": frame.refinement.kept,
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
