"""The ways from a network and some points to dense depth, and the depth that each of them gives.

A way starts at a baseline or at the network's prediction after so many updates of z, and may spread
what is left at the points. For one frame and one set of points `Depths` computes many ways with
nothing done twice: one refinement gives the depth at every number of updates that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.completion.baselines import BASELINES
from pnpdepth_cli.completion.propagation import propagate, propagated_at
from pnpdepth_cli.core.refine import RefineSettings, refine_from
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.pipeline.refinement.frame import (
    FrameToRefine,
    ReadyFrame,
    RefinedFrame,
    finished_frame,
    ready_frame,
    to_image,
)
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Where and how z is updated, `settings.iterations` times at most."""

    layer: str
    settings: RefineSettings

    def __str__(self) -> str:
        s = self.settings
        aligned = "" if s.align == "none" else f", aligned ({s.align})"
        return f"cut at {self.layer}, {s.update}, step {s.lr}{aligned}"


UPDATES = (1, 2, 3, 5, 10, 20)
"""Numbers of updates of z that are looked at, as far as a trial's own goes, which is as well."""


def updates_of(trial: Trial) -> tuple[int, ...]:
    """The numbers of updates of z that are looked at, above 0."""
    most = trial.settings.iterations
    return tuple(sorted({*(k for k in UPDATES if k < most), most} - {0}))


@dataclass(frozen=True, kw_only=True)
class Way:
    """One way to dense depth: from a baseline by name, or from a trial after so many updates of z.

    propagate: how the residual is propagated, one of `completion.propagation.PROPAGATIONS`.
    """

    baseline: str | None = None
    trial: Trial | None = None
    iterations: int = 0
    propagate: str = "none"

    def __str__(self) -> str:
        if self.baseline is not None:
            start = self.baseline
        elif self.iterations:
            start = f"{self.iterations} updates of z ({self.trial})"
        else:
            aligned = "" if self.trial is None else self.trial.settings.align
            start = "network" if aligned in ("", "none") else f"network aligned ({aligned})"
        return start if self.propagate == "none" else f"{start} + {self.propagate}"


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A refinement with its depth (H, W), in the image frame, after some numbers of updates."""

    depths: dict[int, Tensor]
    frame: RefinedFrame

    def after(self, iterations: int) -> Tensor:
        """The depth after so many updates, or the last before it diverged."""
        return self.depths[max(made for made in self.depths if made <= iterations)]


class HeldCut:
    """A network that stays cut while the layer stays the same, so that a path is learnt once."""

    def __init__(self, network: Network) -> None:
        self.network, self._held = network, ExitStack()
        self._split: Split | None = None

    def __enter__(self) -> HeldCut:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """The network is whole again, until it is wanted cut."""
        self._held.close()
        self._split = None

    def at(self, layer: str) -> Split:
        """The network cut at the layer, open."""
        if self._split is None or self._split.layer != layer:
            self.close()
            self._split = self._held.enter_context(self.network.cut_at(layer))
        return self._split


def trajectories(
    cut: HeldCut,
    trials: Sequence[Trial],
    inputs: Inputs,
    sets: Sequence[SparsePoints],
    *,
    needless: Callable[[Trial, Trajectory], bool] = lambda trial, first: False,
) -> dict[Trial, list[Trajectory | PnpDepthError]]:
    """The trials' refinements with each set of points, or the errors that they ended with.

    trials: all of one layer, in front of which the network runs once for all of them. needless:
    what need not be made after the first trial with the first set.
    """
    found: dict[Trial, list[Trajectory | PnpDepthError]] = {trial: [] for trial in trials}
    network, z0 = cut.network, None
    with out_of_memory_is_a_device_error(network.device):
        split = cut.at(trials[0].layer)
        for used in sets:
            task = FrameToRefine.with_points(inputs, used)
            if network.definition.input_kind != "rgb":
                z0 = None
            for trial in trials:
                if trial not in found:
                    continue
                frame = ready_frame(network, trial.settings, task)
                if isinstance(frame, PnpDepthError):
                    found[trial].append(frame)
                    continue
                if z0 is None:
                    with torch.no_grad():
                        z0 = split.front(*frame.arguments)
                made = _trajectory(split, z0, frame, trial.settings, updates_of(trial))
                found[trial].append(made)
                if trial is trials[0] and used is sets[0] and isinstance(made, Trajectory):
                    found = {t: f for t, f in found.items() if t is trial or not needless(t, made)}
    return found


def _trajectory(
    split: Split,
    z0: Tensor,
    frame: ReadyFrame,
    settings: RefineSettings,
    wanted: Collection[int],
) -> Trajectory | PnpDepthError:
    (result,) = refine_from(
        split, z0, (frame.points,), settings, depth_of=(frame.depth_of,), keep_depths={0, *wanted}
    )
    done = finished_frame(frame, result)
    if isinstance(done, PnpDepthError):
        return done
    depths = {
        updates: torch.from_numpy(to_image(frame.frame, depth))
        for updates, depth in done.refinement.depths.items()
        if updates == 0 or bool(depth.isfinite().all())
    }
    return Trajectory(
        depths=depths, frame=replace(done, refinement=replace(done.refinement, depths={}))
    )


class Depths:
    """Depth of one frame from one set of points, by many ways.

    trajectories: of every trial that a way may start with. prediction: (H, W) the network's,
    aligned with the points if its numbers are relative.
    """

    def __init__(
        self,
        inputs: Inputs,
        used: SparsePoints,
        prediction: Tensor,
        trajectories: Mapping[Trial, Trajectory],
    ) -> None:
        self._used, self._prediction, self._trajectories = used, prediction, trajectories
        self._rgb = inputs.picture()

    def dense(self, way: Way) -> Tensor:
        """The way's depth (H, W), 0 = unknown."""
        depth = self._start(way)
        if way.propagate == "none":
            return depth
        return propagate(depth, self._used, self._rgb, kind=way.propagate).depth

    def at(self, places: Tensor, way: Way) -> Tensor:
        """The way's depth (M,) at places (M, 2), x and y in pixels."""
        if way.baseline is not None and way.propagate == "none":
            return BASELINES[way.baseline].at(places, self._used, self._prediction)
        if way.propagate == "none":
            return SparsePoints(
                xy=places, depth=places.new_ones(len(places)), size=self._used.size
            ).sample(self._start(way))
        return propagated_at(self._start(way), self._used, self._rgb, places, kind=way.propagate)

    def relative_sigma(self) -> Tensor:
        """(H, W) how unsure log depth is, but for a factor: what the points tell of each pixel.

        By what the network alone leaves at the points; a way that goes through them leaves nothing.
        """
        found = propagate(self._prediction, self._used, self._rgb, sigma=True)
        assert found.sigma is not None
        return torch.where(found.depth > 0, found.sigma / found.depth, 0.0)

    def _start(self, way: Way) -> Tensor:
        if way.baseline is not None:
            return BASELINES[way.baseline].depth(self._used, self._prediction)
        if way.trial is None:
            return self._prediction
        return self._trajectories[way.trial].after(way.iterations)
