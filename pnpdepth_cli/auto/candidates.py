"""Candidates that compete at held-out points, and the depth that each of them predicts.

A candidate starts from a baseline, or from the network's depth after a number of updates of z, and
may propagate the residual at the points. For one frame and one set of points, `CandidateDepths`
computes many candidates with nothing computed twice: one refinement gives the depth after every
number of updates that competes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.completion.propagation import propagate, propagate_at
from pnpdepth_cli.core.refine import RefineSettings, refine_from
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Frame, RefinedFrame
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.refine import to_refined_frame
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.points import SparsePoints

ITERATIONS = (1, 2, 3, 5, 10, 20)
"""Numbers of updates of z that compete, besides a configuration's own."""


@dataclass(frozen=True, kw_only=True)
class RefinementConfig:
    """Where the network is cut and how z is updated."""

    layer: str
    """Layer to cut at."""
    settings: RefineSettings
    """How z is updated, `settings.iterations` times at most."""

    def __str__(self) -> str:
        s = self.settings
        aligned = "" if s.align == "none" else f", aligned ({s.align})"
        return f"cut at {self.layer}, {s.update}, step {s.lr}{aligned}"

    @property
    def competing_iterations(self) -> tuple[int, ...]:
        """Numbers of updates of z above 0 that compete, ascending."""
        most = self.settings.iterations
        return tuple(sorted({*(k for k in ITERATIONS if k < most), most} - {0}))


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One method that predicts dense depth from a frame and its points."""

    baseline: str | None = None
    """Name of the baseline that it starts from. None: from the network."""
    config: RefinementConfig | None = None
    """Refinement that it starts from."""
    iterations: int = 0
    """Number of updates of z; 0 is the network's own depth."""
    propagate: str = "none"
    """How the residual is propagated: "none" or a name in `choices.PROPAGATIONS`."""

    def __str__(self) -> str:
        if self.baseline is not None:
            start = self.baseline
        elif self.iterations:
            start = f"{self.iterations} updates of z ({self.config})"
        else:
            alignment = "none" if self.config is None else self.config.settings.align
            start = "network" if alignment == "none" else f"network aligned ({alignment})"
        return start if self.propagate == "none" else f"{start} + {self.propagate}"


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A refinement and the depths on its way."""

    depths: dict[int, Tensor]
    """(H, W) metres in the image frame, 0 = unknown, by the number of updates."""
    frame: RefinedFrame
    """The refined frame at the end."""

    def after(self, iterations: int) -> Tensor:
        """Returns the depth (H, W) after so many updates, or the last before a divergence."""
        return self.depths[max(updates for updates in self.depths if updates <= iterations)]


class SplitCache:
    """Keeps the network cut while the layer stays the same, so that it is recorded once."""

    def __init__(self, network: Network) -> None:
        self.network, self._open = network, ExitStack()
        self._split: Split | None = None

    def __enter__(self) -> SplitCache:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Restores the whole network until it is cut again."""
        self._open.close()
        self._split = None

    def at(self, layer: str) -> Split:
        """Returns the network cut at the layer, open."""
        if self._split is None or self._split.layer != layer:
            self.close()
            self._split = self._open.enter_context(self.network.cut_at(layer))
        return self._split


def trajectories(
    cache: SplitCache,
    configs: Sequence[RefinementConfig],
    frame: Frame,
    point_sets: Sequence[SparsePoints],
    *,
    is_redundant: Callable[[RefinementConfig, Trajectory], bool] = lambda config, first: False,
) -> dict[RefinementConfig, list[Trajectory | PnpDepthError]]:
    """Returns the refinements of a frame with each set of points, or the errors that ended them.

    Args:
        cache: The network.
        configs: Configurations of one layer. The front of the network runs once for all of them.
        frame: The frame; its own points are not used.
        point_sets: The sets of points.
        is_redundant: Given a configuration and the first trajectory, whether the configuration
            would add nothing. Redundant ones are left out of the result.
    """
    results: dict[RefinementConfig, list[Trajectory | PnpDepthError]] = {c: [] for c in configs}
    network, z0 = cache.network, None
    with out_of_memory_is_a_device_error(network.device):
        split = cache.at(configs[0].layer)
        for points in point_sets:
            prepared = prepare(network, frame.with_points(points))
            if network.definition.input_kind != "rgb":
                z0 = None
            for config in configs:
                if config not in results:
                    continue
                if not len(prepared.points):
                    results[config].append(prepared.no_points_error())
                    continue
                if z0 is None:
                    with torch.no_grad():
                        z0 = split.front(*prepared.arguments)
                result = _trajectory(split, z0, prepared, config)
                results[config].append(result)
                is_first = config is configs[0] and points is point_sets[0]
                if is_first and isinstance(result, Trajectory):
                    for other in configs[1:]:
                        if is_redundant(other, result):
                            results.pop(other, None)
    return results


def _trajectory(
    split: Split, z0: Tensor, prepared: PreparedFrame, config: RefinementConfig
) -> Trajectory | PnpDepthError:
    reader = prepared.depth_reader(config.settings)
    (result,) = refine_from(
        split,
        z0,
        (prepared.points,),
        config.settings,
        depth_of=(reader,),
        keep_depths={0, *config.competing_iterations},
    )
    refined = to_refined_frame(prepared, reader, result)
    if isinstance(refined, PnpDepthError):
        return refined
    depths = {
        updates: torch.from_numpy(prepared.to_image(depth))
        for updates, depth in refined.refinement.depths.items()
        if updates == 0 or bool(depth.isfinite().all())
    }
    refinement = replace(refined.refinement, depths={})
    return Trajectory(depths=depths, frame=replace(refined, refinement=refinement))


class CandidateDepths:
    """Depth of one frame by many candidates, from one set of points.

    Args:
        frame: The frame with the points that candidates may use.
        prediction: (H, W) metres of the network, aligned with the points if it is relative.
        refinements: Trajectory of every configuration that a candidate may start from.
    """

    def __init__(
        self,
        frame: Frame,
        prediction: Tensor,
        refinements: Mapping[RefinementConfig, Trajectory],
    ) -> None:
        self._frame, self._prediction, self._refinements = frame, prediction, refinements

    def dense(self, candidate: Candidate) -> Tensor:
        """Returns the candidate's depth (H, W) metres, 0 = unknown."""
        depth = self._start(candidate)
        if candidate.propagate == "none":
            return depth
        frame = self._frame
        return propagate(depth, frame.points, frame.rgb, kind=candidate.propagate).depth

    def at(self, xy: Tensor, candidate: Candidate) -> Tensor:
        """Returns the candidate's depth (M,) metres at pixel coordinates (M, 2)."""
        frame, name = self._frame, candidate.baseline
        if name is not None and candidate.propagate == "none":
            depth: Tensor = BASELINES[name].at(xy, frame.points, self._prediction)
            return depth
        if candidate.propagate == "none":
            return SparsePoints(xy=xy, depth=xy.new_ones(len(xy)), size=frame.size).sample(
                self._start(candidate)
            )
        return propagate_at(
            self._start(candidate), frame.points, frame.rgb, xy, kind=candidate.propagate
        )

    def relative_sigma(self) -> Tensor:
        """Returns the uncalibrated standard deviation (H, W) of log depth.

        It is that of the network's residual: a candidate that goes through the points leaves none.
        """
        frame = self._frame
        result = propagate(self._prediction, frame.points, frame.rgb, sigma=True)
        assert result.sigma is not None
        return torch.where(result.depth > 0, result.sigma / result.depth, 0.0)

    def _start(self, candidate: Candidate) -> Tensor:
        if candidate.baseline is not None:
            baseline = BASELINES[candidate.baseline]
            depth: Tensor = baseline.depth(self._frame.points, self._prediction)
            return depth
        if candidate.config is None:
            return self._prediction
        return self._refinements[candidate.config].after(candidate.iterations)


def default_configs(
    definition: ModelDefinition, layer: str, settings: RefineSettings
) -> list[RefinementConfig]:
    """Returns configurations to try, the most promising first.

    Those that differ from the first in alignment alone are tried by default. Other steps and
    layers follow, for when there is time.

    Args:
        definition: Of the network.
        layer: The layer that was asked for.
        settings: The settings that were asked for.
    """
    adam = replace(settings, update="adam", lr="3%", schedule="constant", blur=0.0, iterations=10)
    steps = [settings, adam]
    if settings == replace(RefineSettings(), align=settings.align):
        steps.reverse()  # nobody has tuned the paper's steps to this network
    alignments = [settings.align] + (["auto"] if settings.align == "none" else [])
    layers = [layer, *(other for other in definition.layers if other != layer)]
    configs = [
        RefinementConfig(layer=cut, settings=replace(step, align=alignment))
        for cut in layers
        for step in steps
        for alignment in alignments
    ]
    return list(dict.fromkeys(configs))
