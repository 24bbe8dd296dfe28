"""The depth that each candidate predicts for a frame, with nothing computed twice.

A network that takes only the image runs its front once for a frame, whatever points it is refined
with. One refinement gives the depth after every number of updates that competes. Everything else
is computed when a candidate first needs it.
"""

from __future__ import annotations

import contextlib
import copy
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.auto.blending import weighted_mean
from pnpdepth_cli.auto.candidates import Candidate, RefinementConfig
from pnpdepth_cli.choices import BASELINES, LOSSES
from pnpdepth_cli.completion.interpolation import in_hull
from pnpdepth_cli.completion.propagation import fitted_kernel, propagate, propagate_at
from pnpdepth_cli.completion.residual_field import Kernel
from pnpdepth_cli.core.refine import Refinement, refine_from
from pnpdepth_cli.core.split import InputSplit, Split
from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Frame, RefinedFrame
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.refine import refine_frame_weights, to_refined_frame
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.points import SparsePoints


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

    def at_points(self) -> InputSplit:
        """Returns the network cut at its sparse depth, open."""
        if not isinstance(self._split, InputSplit):
            self.close()
            self._split = self._open.enter_context(self.network.cut_at_points())
        assert isinstance(self._split, InputSplit)
        return self._split

    def at(self, layer: str) -> Split:
        """Returns the network cut at the layer, open."""
        if self._split is None or self._split.layer != layer:
            self.close()
            self._split = self._open.enter_context(self.network.cut_at(layer))
        return self._split


class OpenNetworks:
    """Networks that stay cut from frame to frame, as a context manager.

    Args:
        networks: By name. The first is the user's.
    """

    def __init__(self, networks: Mapping[str, Network]) -> None:
        self.networks = dict(networks)
        self._caches = {name: SplitCache(network) for name, network in self.networks.items()}
        self._stack = ExitStack()

    def __enter__(self) -> OpenNetworks:
        for cache in self._caches.values():
            self._stack.enter_context(cache)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def split(self, config: RefinementConfig) -> Split:
        """Returns the configuration's network cut at its layer or its sparse depth, open."""
        cache = self._caches[config.network]
        return cache.at_points() if config.settings.masked else cache.at(config.layer)


class FramePasses:
    """Passes of the networks over one image, for several sets of points.

    Args:
        opened: The networks.
    """

    def __init__(self, opened: OpenNetworks) -> None:
        self._opened = opened
        self._z0: dict[str, tuple[str, Tensor]] = {}  # layer and z_0 by network
        self._outputs: dict[str, Any] = {}  # of networks that take only the image
        self._encoded: dict[str, Any] = {}  # what encoders of the image returned, by network

    def trajectory(self, config: RefinementConfig, frame: Frame) -> Trajectory:
        """Returns the refinement of the frame.

        Args:
            config: The network and how it is refined.
            frame: The image, the same in every call, and the points of this call.

        Raises:
            PnpDepthError: The refinement fails.
        """
        network = self._opened.networks[config.network]
        with out_of_memory_is_a_device_error(network.device):
            prepared = prepare(network, frame)
            if not len(prepared.points):
                raise prepared.no_points_error()
            reader = prepared.depth_reader(config.settings)
            result: Refinement | PnpDepthError
            if not config.settings.iterations:
                result = self._plain(config, prepared, reader)
            elif config.settings.moves_weights:
                self._z0.pop(config.network, None)
                return _of_weights(self._opened.split(config), prepared, config)
            else:
                result = self._refined(config, prepared, reader)
            refined = to_refined_frame(prepared, reader, result)
        if isinstance(refined, PnpDepthError):
            raise refined
        return _trajectory(prepared, refined)

    def _refined(
        self, config: RefinementConfig, prepared: PreparedFrame, reader: AlignedDepth
    ) -> Refinement | PnpDepthError:
        split = self._opened.split(config)
        layer, z0 = self._z0.pop(config.network, (None, None))
        if z0 is None or layer != config.layer:
            with torch.no_grad():
                z0 = split.front(*prepared.arguments)
        if prepared.network.definition.input_kind == "rgb":
            # the cut keeps what the front of its last layer gave
            self._z0[config.network] = config.layer, z0
        (result,) = refine_from(
            split,
            z0,
            (prepared.points,),
            config.settings,
            depth_of=(reader,),
            keep_depths={0, *config.competing_iterations},
        )
        return result

    def _plain(
        self, config: RefinementConfig, prepared: PreparedFrame, reader: AlignedDepth
    ) -> Refinement:
        """The same without updates: a pass of the whole network, which need not be cut."""
        definition, name = prepared.network.definition, config.network
        output = self._outputs.get(name)
        if output is None:
            with (
                torch.no_grad(),
                self._encoder_runs_once(prepared.network, name),
                wrap_user_errors("the network's forward"),
            ):
                output = prepared.network.module(*prepared.arguments)
        if definition.input_kind == "rgb":
            self._outputs[name] = output
        depth = reader(output).detach()
        loss: Tensor = LOSSES[config.settings.loss](
            prepared.points.sample(depth), prepared.points.depth
        )
        return Refinement(
            before=depth, after=depth, losses=(float(loss),), step=0.0, kept=0, depths={0: depth}
        )

    @contextmanager
    def _encoder_runs_once(self, network: Network, name: str) -> Iterator[None]:
        """Inside, the encoder of the image gives what it gave for this image before."""
        if network.definition.image_encoder is None:
            yield
            return
        encoder = network.module.get_submodule(network.definition.image_encoder)
        run, own = encoder.forward, encoder.__dict__.get("forward")

        def forward(*inputs: Any, **options: Any) -> Any:
            if name not in self._encoded:
                self._encoded[name] = run(*inputs, **options)
            return self._encoded[name]

        encoder.__dict__["forward"] = forward
        try:
            yield
        finally:
            if own is None:
                del encoder.__dict__["forward"]
            else:
                encoder.__dict__["forward"] = own


def _trajectory(prepared: PreparedFrame, refined: RefinedFrame) -> Trajectory:
    """The refined frame with the depths on its way in the image frame."""
    depths = {
        updates: torch.from_numpy(prepared.to_image(depth))
        for updates, depth in refined.refinement.depths.items()
        if updates == 0 or bool(depth.isfinite().all())
    }
    refinement = replace(refined.refinement, depths={})
    return Trajectory(depths=depths, frame=replace(refined, refinement=refinement))


def _of_weights(split: Split, prepared: PreparedFrame, config: RefinementConfig) -> Trajectory:
    """The plain depth and that of the best weights."""
    reader = prepared.depth_reader(config.settings)
    result = refine_frame_weights(split, config.settings, prepared, reader)
    refined = to_refined_frame(prepared, reader, result)
    if isinstance(refined, PnpDepthError):
        raise refined
    plain, best = (torch.from_numpy(depth) for depth in (refined.before, refined.after))
    return Trajectory(depths={0: plain, config.settings.iterations: best}, frame=refined)


class CandidateDepths:
    """Depth of one frame by many candidates, from one set of points.

    Args:
        passes: The networks' passes over the frame's image.
        frame: The frame with the points that candidates may use.
        reference: The refinement whose start is the prediction of baselines that need one.
        default: The candidate that continues baselines outside the hull of the points.
    """

    def __init__(
        self,
        passes: FramePasses,
        frame: Frame,
        reference: RefinementConfig,
        default: Candidate,
    ) -> None:
        self._passes, self._frame = passes, frame
        self._reference, self._default = reference, default
        self._trajectories: dict[
            tuple[RefinementConfig, Candidate | None], Trajectory | PnpDepthError
        ] = {}
        self._kernels: dict[str, Kernel] = {}
        self._hidden_points: Mapping[RefinementConfig, RefinementConfig] = {}
        self._until: float | None = None
        self.kept_steps: dict[str, int] = {}
        """Steps by hidden points that were kept, by network."""

    def with_hidden_points(
        self, configs: Mapping[RefinementConfig, RefinementConfig], *, until: float | None
    ) -> CandidateDepths:
        """Returns the same where networks' own depths are those after steps by hidden points.

        A refinement that fails, or for which there is no time, leaves the network's own depth.

        Args:
            configs: The refinements by hidden points, by the networks' own.
            until: Time by `time.monotonic` after which no step begins. None sets no limit.
        """
        other = copy.copy(self)
        other._hidden_points, other._until = configs, until
        return other

    def trajectory(self, config: RefinementConfig, prior: Candidate | None = None) -> Trajectory:
        """Returns the refinement; raises its PnpDepthError, computed or remembered."""
        key = config, prior
        if key not in self._trajectories:
            try:
                dense_prior = None if prior is None else self.dense(prior)
                refined = self._passes.trajectory(config, replace(self._frame, prior=dense_prior))
            except PnpDepthError as error:
                self._trajectories[key] = error
                raise
            self._trajectories[key] = refined
        known = self._trajectories[key]
        if isinstance(known, PnpDepthError):
            raise known
        return known

    @property
    def points(self) -> SparsePoints:
        """The points that candidates may use."""
        return self._frame.points

    @property
    def prediction(self) -> Tensor:
        """(H, W) metres of the reference network, aligned with the points."""
        return self.trajectory(self._reference).after(0)

    def dense(self, candidate: Candidate) -> Tensor:
        """Returns the candidate's depth (H, W) metres, 0 = unknown."""
        frame = self._frame
        if candidate.within_hull:
            inside = in_hull(frame.points)
            unlimited = self.dense(replace(candidate, within_hull=False))
            return torch.where(inside, unlimited, self.dense(self._default))
        depth = self._start(candidate)
        if candidate.propagate == "none":
            return depth
        return propagate(depth, frame.points, frame.rgb, kind=candidate.propagate).depth

    def at(self, xy: Tensor, candidate: Candidate) -> Tensor:
        """Returns the candidate's depth (M,) metres at pixel coordinates (M, 2).

        All candidates' residuals are propagated with the kernel that fits the first one's.
        """
        frame, name = self._frame, candidate.baseline
        if candidate.within_hull:
            inside = in_hull(frame.points, xy)
            unlimited = self.at(xy, replace(candidate, within_hull=False))
            return torch.where(inside, unlimited, self.at(xy, self._default))
        if candidate.propagate != "none":
            start, kind = self._start(candidate), candidate.propagate
            residual = start, frame.points, frame.rgb
            if kind not in self._kernels:
                self._kernels[kind] = fitted_kernel(*residual, kind)
            return propagate_at(*residual, xy, kind=kind, kernel=self._kernels[kind])
        if name is None:
            queries = SparsePoints(xy=xy, depth=xy.new_ones(len(xy)), size=frame.size)
            return queries.sample(self._start(candidate))
        depth: Tensor = BASELINES[name].at(xy, frame.points, self._prediction_for(name))
        return depth

    def _start(self, candidate: Candidate) -> Tensor:
        """(H, W): the candidate's depth before propagation."""
        if candidate.fused:
            members = torch.stack([self.dense(each) for each in candidate.fused])
            return weighted_mean(members, candidate.weights, geometric=True)
        if candidate.baseline is not None:
            name = candidate.baseline
            depth: Tensor = BASELINES[name].depth(self._frame.points, self._prediction_for(name))
            return depth
        config, iterations = candidate.config or self._reference, candidate.iterations
        if candidate.prior is None and not iterations:
            return self._own(config)
        return self.trajectory(config, candidate.prior).after(iterations)

    def _own(self, config: RefinementConfig) -> Tensor:
        """(H, W): the network's own depth, after steps by hidden points where these are made."""
        if config in self._hidden_points:
            with contextlib.suppress(PnpDepthError):
                return self._after_hidden_points(config, self._hidden_points[config])
        return self.trajectory(config).after(0)

    def _after_hidden_points(self, config: RefinementConfig, moved: RefinementConfig) -> Tensor:
        if (moved, None) not in self._trajectories:
            timed = moved
            if self._until is not None:
                left_s = self._until - time.monotonic()
                if left_s <= 0:
                    return self.trajectory(config).after(0)
                timed = moved.within(left_s)
            refined = self._passes.trajectory(timed, self._frame)
            self._trajectories[moved, None] = refined
            self.kept_steps[config.network] = refined.frame.refinement.kept
        return self.trajectory(moved).after(moved.settings.iterations)

    def _prediction_for(self, baseline: str) -> Tensor | None:
        return self._own(self._reference) if BASELINES[baseline].needs_prediction else None
