"""`pnpdepth refine`: one image, its sparse depth, and a network; refined depth and its record."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.auto.choice import Competition
from pnpdepth_cli.auto.cross_validation import spatial_folds
from pnpdepth_cli.auto.predictions import OpenNetworks
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import Scores, score
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError, PnpDepthError, UsageError
from pnpdepth_cli.frames.frame import Frame, RefinedFrame
from pnpdepth_cli.frames.refine import OnIteration, refine_frame, refine_frames
from pnpdepth_cli.frames.tiles import refine_tiled
from pnpdepth_cli.io.atomic import all_or_none
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.rank_layers import default_layer
from pnpdepth_cli.pipeline.refinement.against_linear import compared_with_linear
from pnpdepth_cli.pipeline.refinement.held_out import (
    best_candidates,
    competition_of,
    refine_with_folds,
)
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.pipeline.refinement.method import Method, needs_folds, resolve_method
from pnpdepth_cli.pipeline.refinement.output_files import Outputs, plan_outputs
from pnpdepth_cli.pipeline.refinement.output_range import within_range
from pnpdepth_cli.pipeline.refinement.outputs import write_outputs
from pnpdepth_cli.pipeline.refinement.points import PointError, point_error, split_points
from pnpdepth_cli.pipeline.refinement.request import MethodOptions, NetworkChoice, RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import (
    is_dense,
    moves_weights,
    resolve_definition,
    resolve_layer,
    resolve_settings,
)
from pnpdepth_cli.pipeline.sparse.colmap_options import METRES
from pnpdepth_cli.pipeline.stopwatch import Stopwatch, peak_memory_mb, versions
from pnpdepth_cli.points import SparsePoints

COMPANION = "compact"
"""The network that competes beside the user's, where there is an image."""
_CHECK_FOLDS = 5
"""One of so many folds is held out to compare a fixed method with linear interpolation."""
_MIN_CHECKED = 5
"""Fewer points do not compare a method with linear interpolation."""

Opened = Split | OpenNetworks
"""The networks of a refiner, open for any number of frames."""


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
        with refiner.opened() as opened:
            frame = refiner.refine(
                opened, inputs, on_iteration=lambda done, loss: on_iteration(done, of, loss)
            )
    if inputs.gt is None and not len(frame.held_out) and frame.interpolation is None:
        with watch("check"), refiner.opened() as opened:
            frame = refiner.checked(opened, inputs, frame)
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
    method: Method
    """Whether the method is chosen or fixed, and why."""
    networks: Mapping[str, Network]
    """All networks that compete by name, the user's first; `network` alone for a fixed method."""
    competition: Competition | None = None
    """Which candidates compete, where points are held out in turns."""

    def opened(self) -> Opened:
        """Returns the networks, to be opened by `with` for all frames."""
        if self.competition is not None:
            return OpenNetworks(self.networks)
        if self.settings.masked:
            return self.network.cut_at_points()
        return self.network.cut_at(self.layer)

    def refine(
        self,
        opened: Opened,
        inputs: Inputs,
        *,
        on_iteration: OnIteration = lambda done, loss: None,
    ) -> RefinedFrame:
        """Returns one frame refined in memory, the same whatever was refined before.

        Raises:
            PnpDepthError: The frame cannot be refined.
        """
        torch.manual_seed(self.request.hold_out.seed)
        frame, held_out = self._split_frame(inputs)
        refined = self._refined(opened, frame, inputs.gt, on_iteration)
        return replace(refined, held_out=held_out)

    def checked(self, opened: Opened, inputs: Inputs, frame: RefinedFrame) -> RefinedFrame:
        """Returns the refined frame with its method's error at held-out points beside linear's.

        For a fixed method without ground truth: it is run once more without a fifth of the points.
        """
        points = inputs.points
        if len(points) < _MIN_CHECKED:
            return frame
        held = spatial_folds(points, _CHECK_FOLDS, seed=self.request.hold_out.seed) == 0
        kept, left = points.select(~held), points.select(held)
        try:
            again = self._refined(opened, inputs.frame(kept), None)
        except PnpDepthError:
            return frame
        before, after = point_error(again.before, left), point_error(again.after, left)
        interpolated = (linear(kept, left.xy) - left.depth).abs()
        if before is None or after is None:
            return frame
        return replace(
            frame,
            interpolation={
                "points": len(left),
                "before": before.mae,
                "linear": float(interpolated.mean()),
                "after": after.mae,
            },
        )

    def _refined(
        self,
        opened: Opened,
        frame: Frame,
        gt: NDArray[np.float32] | None,
        on_iteration: OnIteration = lambda done, loss: None,
    ) -> RefinedFrame:
        if self.competition is not None and isinstance(opened, OpenNetworks):
            return refine_with_folds(opened, self.competition, self.request, frame, gt)
        assert isinstance(opened, Split)
        network, settings, propagation = self.network, self.settings, self._propagation
        if side := self.request.network.tile:
            return refine_tiled(
                network, opened, settings, frame, side,
                propagation=propagation, on_iteration=on_iteration,
            )  # fmt: skip
        return refine_frame(
            network, opened, settings, frame, propagation=propagation, on_iteration=on_iteration
        )

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
        assert self.competition is not None
        frames = [self._split_frame(inputs)[0] for inputs in group]
        with OpenNetworks(self.networks) as opened:
            seed = self.request.hold_out.seed
            best = best_candidates(opened, self.competition, seed, frames)
        return replace(self, competition=replace(self.competition, shortlist=best))

    def _split_frame(self, inputs: Inputs) -> tuple[Frame, SparsePoints]:
        """The frame with the points to use, and the points held out."""
        asked = self.request.hold_out
        used, held_out = split_points(inputs.points, asked.holdout, asked.seed)
        return inputs.frame(used), held_out

    @property
    def _propagation(self) -> str:
        return self.method.options.propagate or "none"

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
    choice, hold_out, method = request.network, request.hold_out, resolve_method(request)
    timed = method.chosen or moves_weights(method.options)
    if hold_out.time_budget_s is not None and not timed:
        raise UsageError(f"--time-budget caps the choice, but {method.why} fixes the method")
    if choice.more_models and not method.chosen:
        raise UsageError(f"several --model compete in the choice, but {method.why} fixes a method")
    if choice.tile is not None and needs_folds(request):
        raise UsageError("--tile goes with none of --auto, --baselines and --uncertainty")
    frame, networks = first.frame(), []
    for number, spec in enumerate((choice.model, *choice.more_models)):
        checkpoint = choice.checkpoint if number == 0 else None
        network = load_network(spec, checkpoint, choice.device, precision=choice.precision)
        networks.append(resolve_definition(network, frame, choice if number == 0 else _PLAIN))
    return refiner_of(request, networks, first)


def refiner_of(
    request: RefineRequest,
    networks: Sequence[Network],
    first: Inputs,
    *,
    settings: RefineSettings | None = None,
) -> Refiner:
    """Returns the refiner of networks that leave nothing open.

    Args:
        request: What is asked for.
        networks: The user's. Where the method is chosen, the companion competes beside them.
        first: The frame whose points decide the layers to cut at.
        settings: How z of the first network is updated. None: by the request.
    """
    method, plans = resolve_method(request), []
    if method.chosen:
        networks = _with_companion(networks, request.network, first.frame())
    for number, network in enumerate(networks):
        definition = network.definition
        options = method.options if number == 0 else MethodOptions()
        layer = options.layer
        if layer is None and not method.own_layer and options.target != "masked":
            layer = default_layer(network, first.size, len(first.points))
        own = resolve_settings(
            definition,
            options,
            request.hold_out,
            metric=first.unit == METRES,
            dense=is_dense(first.points),
        )
        if number == 0 and settings is not None:
            own = settings
        plans.append((_name(networks, number), network, resolve_layer(definition, layer), own))
    _, network, cut_at, own = plans[0]
    folds = needs_folds(request)
    if folds and own.moves_weights:
        raise UsageError(
            "weights cannot be updated together with --auto, --baselines or --uncertainty; leave"
            " out --target and --parameters"
        )
    timed = request.hold_out.time_budget_s is not None
    return Refiner(
        request=request,
        network=network,
        layer=cut_at,
        settings=own,
        method=method,
        networks={name: each for name, each, _, _ in plans},
        competition=competition_of(method, plans, timed=timed) if folds else None,
    )


def _with_companion(
    networks: Sequence[Network], choice: NetworkChoice, frame: Frame
) -> Sequence[Network]:
    """The networks, and the companion if there is an image and it is none of them."""
    if frame.rgb is None or any(each.definition.name == COMPANION for each in networks):
        return networks
    companion = load_network(COMPANION, None, choice.device, precision=choice.precision)
    return [*networks, resolve_definition(companion, frame, _PLAIN)]


_PLAIN = NetworkChoice()
"""Nothing is chosen of further networks: their definitions say all."""


def _name(networks: Sequence[Network], number: int) -> str:
    """The network's own name, numbered if a network before it has the same."""
    name = networks[number].definition.name
    same = sum(each.definition.name == name for each in networks[:number])
    return f"{name} ({same + 1})" if same else name


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
    hold_out, method = request.hold_out, refiner.method
    propagate = method.options.propagate
    return {
        "versions": versions(),
        "unit": inputs.unit,
        "inputs": inputs.record,
        "camera": None if inputs.camera is None else inputs.camera.record(),
        "model": refiner.model_record,
        "method": {
            "kind": "chosen" if method.chosen else "fixed",
            "why": method.why,
            "networks": list(refiner.networks),
        },
        "settings": {
            "layer": refiner.layer,
            **asdict(refiner.settings),
            "step": frame.refinement.step,
            "propagate": propagate if method.chosen else propagate or "none",
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
            **_moved_points(inputs, frame),
        },
        "loss": list(frame.refinement.losses),
        "kept": frame.refinement.kept,
        "sparse_error": _before_after(frame, lambda d: point_error(d, frame.used)),
        "held_out_error": _before_after(frame, lambda d: point_error(d, frame.held_out)),
        "scores": _before_after(frame, lambda d: _score(d, inputs.gt)),
        "linear": compared_with_linear(frame, inputs.gt),
        "auto": frame.choice,
        "baselines": frame.baselines,
        "diverged": str(frame.diverged) if frame.diverged else None,
        "notes": [note for note in (*inputs.notes, *_notes(refiner), *frame.notes) if note],
    }


def _moved_points(inputs: Inputs, frame: RefinedFrame) -> dict[str, int]:
    """The number of used points that are neighbours', for a frame with neighbours."""
    if not inputs.neighbours:
        return {}
    return {"moved": len(frame.used) - (len(inputs.points) - len(frame.held_out))}


def _notes(refiner: Refiner) -> list[str]:
    return [note for network in refiner.networks.values() for note in network.notes]


def _score(depth: NDArray[np.float32], gt: NDArray[np.float32] | None) -> Scores | None:
    return None if gt is None else score(torch.from_numpy(depth), torch.from_numpy(gt))


def _before_after(
    frame: RefinedFrame, measure: Callable[[NDArray[np.float32]], PointError | Scores | None]
) -> dict[str, Any] | None:
    before, after = measure(frame.before), measure(frame.after)
    if before is None or after is None:
        return None
    return {"before": asdict(before), "after": asdict(after)}
