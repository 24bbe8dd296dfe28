"""One method for any number of frames in memory.

This is what `refine`, `batch`, Ray workers and the Python API call; reading and writing are around
it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from types import MappingProxyType

import torch
from numpy.typing import ArrayLike

from pnpdepth_cli.completion.image_registration import (
    Evidence,
    estimated,
    evidence,
)
from pnpdepth_cli.core.refine import OnIteration
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError, PnpDepthError, UsageError
from pnpdepth_cli.frames.adapt import Weights, learn, too_little, weights_in_place
from pnpdepth_cli.frames.default import check_fixed, refine_default
from pnpdepth_cli.frames.frame import (
    METRES,
    Frame,
    Refined,
    Register,
    Registration,
    Unit,
    frame_of_arrays,
    no_points,
    registration_to_make,
)
from pnpdepth_cli.frames.opened import Member, OpenNetworks
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.frames.resolve import resolve_definition, resolve_layer, resolve_settings
from pnpdepth_cli.frames.uncertainty import with_uncertainty
from pnpdepth_cli.frames.validation import split_points
from pnpdepth_cli.models.measure_layers import default_layer
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

COMPANION = "compact"
"""The network that is fused with the user's, where there is an image."""
UPDATES = 5
"""Most updates of z in the default method. More fit what propagation fits anyway."""
_TRIED = 3
"""After so many frames that say nothing of the registration, no more are read."""


class Refiner:
    """Refines frames with one network, or several that are fused; a context manager.

    The networks stay cut open from frame to frame and are as before when it closes. What their
    definitions leave open (such as the RGB range of an ONNX file) is decided by the first frame.

    Args:
        network: From `load_network`; several are fused by the default method.
        settings: What is left open, the network decides. With any setting of the method, `network`
            alone is refined by it; without, by the default method.
        uncertainty: Whether the standard deviation of the depth is estimated too.
        check: Whether the result is checked at validation points also with a fixed method.
        compact: Whether the default method fuses `network` with the included network `compact`,
            where there is an image. Without, `network` alone is refined.
        registration: Whether images are moved into the frame of the points: "auto", if their depth
            edges show that they are not registered; "off"; or by (zoom, right, down), pixels.
        adapt: Frames of the same sequence, (image, sparse) each, whose points the weights of
            `network`, which must take points, learn from before the first frame is refined. The
            learnt weights are used while the refiner is open, if hidden points show that they are
            better.

    Raises:
        UsageError: The settings contradict each other.
        InputError: A frame of `adapt` cannot be used.
    """

    def __init__(
        self,
        network: Network | Sequence[Network],
        settings: Settings | None = None,
        *,
        uncertainty: bool = False,
        check: bool = False,
        compact: bool = True,
        registration: Registration = "auto",
        adapt: Sequence[tuple[ArrayLike | None, ArrayLike | SparsePoints]] = (),
    ) -> None:
        self._networks = tuple(network) if isinstance(network, Sequence) else (network,)
        if not self._networks or not all(isinstance(each, Network) for each in self._networks):
            raise UsageError("network must be from load_network, or several in a list")
        if not isinstance(settings, Settings | None):
            raise UsageError(f"settings must be Settings, not {type(settings).__name__}")
        self.asked = settings or Settings()
        self.is_default = not self.asked.fixed_by
        self._uncertainty, self._check = uncertainty, check or uncertainty
        self._compact = compact
        self._register = registration_to_make(registration, self.asked)
        self._adapt = [frame_of_arrays(*pair, self._register, None) for pair in adapt]
        self._weights: Weights | None = None  # learnt ones, where they are better
        self.members: tuple[Member, ...] = ()
        self.registrations: Mapping[tuple[int, int], Register] = MappingProxyType({})
        self._stack = ExitStack()
        self._opened: Split | OpenNetworks | None = None
        if len(self._networks) > 1 and not self.is_default:
            raise UsageError(
                f"several --model are fused, but {self.asked.fixed_by} fixes one network"
            )

    def __enter__(self) -> Refiner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Restores the networks."""
        self._opened = None
        self._stack.close()

    @property
    def network(self) -> Network:
        """The user's network; with nothing left open after `decide`."""
        return self.members[0].network

    @property
    def layer(self) -> str:
        """Where the user's network is cut."""
        return self.members[0].layer

    @property
    def settings(self) -> Settings:
        """The settings of the user's network, with nothing left open."""
        return self.members[0].settings

    @property
    def split(self) -> Split | None:
        """The user's network, cut and open; None with the default method, or while closed."""
        return self._opened if isinstance(self._opened, Split) else None

    def refine(
        self,
        image: ArrayLike | None,
        sparse: ArrayLike | SparsePoints,
        *,
        unit: Unit | None = None,
    ) -> Refined:
        """Returns one frame of arrays refined.

        Args:
            image: RGB (H, W, 3), uint8, uint16, or in 0..1 or 0..255; also grey (H, W), with alpha,
                or channels first. None for a network that takes sparse depth only.
            sparse: Depth map (H, W) in metres with 0 for unknown, rows (N, 3) of x, y and depth
                (pixel centres at whole numbers), or SparsePoints.
            unit: Of the depth of an array, "m" or "mm"; needed for integers, and where half of the
                depths are beyond 200.

        Raises:
            InputError: Image or points cannot be used.
            DivergedError: The loss became non-finite; `last_good` is the Refined before that.
        """
        frame = frame_of_arrays(image, sparse, self._register, unit)
        refined = self.refine_frame(frame)
        refined = replace(refined, notes=(*self.network.notes, *frame.notes, *refined.notes))
        if refined.diverged is not None:
            raise DivergedError(str(refined.diverged), refined)
        return refined

    def refine_frame(
        self, frame: Frame, *, on_iteration: OnIteration = lambda done, loss: None
    ) -> Refined:
        """Returns one frame refined, the same whatever was refined before.

        Raises:
            PnpDepthError: The frame cannot be refined.
        """
        frame, opened = self._begun(frame)
        if isinstance(opened, OpenNetworks):
            refined = refine_default(opened, frame, seed=self.asked.seed)
        else:
            settings, propagation = self.settings, self.settings.propagate
            refined = refine_frame(
                self.network, opened, settings, frame,
                propagation=propagation, on_iteration=on_iteration,
            )  # fmt: skip
            if self._check:
                refined = self._checked(frame, refined)
        if self._uncertainty:
            refined = with_uncertainty(refined)
        return _finished(refined, frame)

    def decide(self, frame: Frame, more: Callable[[], Sequence[Frame]] = tuple) -> Refiner:
        """Decides once what definitions leave open, and returns this refiner.

        Args:
            more: Gives further frames, which decide as well; called only if a network needs it.

        Raises:
            UsageError: The settings contradict each other.
            ModelError: A network cannot be used.
        """
        if self.members:
            return self
        first = frame.registered()
        networks = [
            resolve_definition(network, first, lambda: [each.registered() for each in more()])
            for network in self._networks
        ]
        if self._adapt:
            networks[0] = self._adapted(networks[0])
        named = {network.definition.name for network in networks}
        fused = self.is_default and self._compact and first.rgb is not None
        if fused and COMPANION not in named:
            device, precision = str(networks[0].device), networks[0].precision
            companion = load_network(COMPANION, None, device, precision=precision)
            networks.append(resolve_definition(companion, first))
        self.members = tuple(
            self._member(network, first, self.asked if number == 0 else Settings())
            for number, network in enumerate(networks)
        )
        return self

    def _adapted(self, network: Network) -> Network:
        """The network, with a note of what its weights learnt from the frames of `adapt`."""
        why = too_little(len(self._adapt), self._adapt[0])
        if why is None:
            named = ((f"frame {number}", frame) for number, frame in enumerate(self._adapt))
            learnt = learn(network, named, seed=self.asked.seed)
            self._weights = learnt.weights if learnt.is_better else None
            why = str(learnt)
        own = "" if self._weights is not None else "the network's own weights are used: "
        return replace(network, notes=(*network.notes, f"adapt: {own}{why}"))

    def share_registration(self, frames: Iterable[Frame]) -> None:
        """Decides the registration that images of one size share, by all these frames together.

        Images of the size of the first one decide. A frame of another size decides alone.
        """
        usable = list[Evidence]()
        for read, frame in enumerate(frames, 1):
            if frame.image is not None and frame.register == "auto":
                known = evidence(frame.image, frame.points)
                usable += [] if known is None else [known]
            if read == _TRIED and not usable:  # such as scans, none of which will tell
                break
        if usable:
            self.registrations = MappingProxyType({usable[0].size: estimated(usable)})

    def _begun(self, frame: Frame) -> tuple[Frame, Split | OpenNetworks]:
        """The frame as it is refined, and the networks, open."""
        self.decide(frame)
        torch.manual_seed(self.asked.seed)
        if frame.register == "auto" and frame.size in self.registrations:
            frame = replace(frame, register=self.registrations[frame.size])
        if self._opened is None:
            if self._weights is not None:
                self._stack.enter_context(weights_in_place(self.network, self._weights))
            network: Split | OpenNetworks = (
                OpenNetworks(self.members) if self.is_default else self.network.cut_at(self.layer)
            )
            self._stack.enter_context(network)
            self._opened = network
        return frame.registered(), self._opened

    def _member(self, network: Network, frame: Frame, asked: Settings) -> Member:
        """A network, where it is cut, and its settings."""
        definition, layer = network.definition, asked.layer
        if layer is None and asked.preset is None:
            layer = default_layer(network, frame.size, len(frame.points))
        layer = resolve_layer(definition, layer)
        settings = resolve_settings(definition, asked, metric=frame.unit == METRES)
        member = Member(network=network, layer=layer, settings=replace(settings, layer=layer))
        return self._of_default(member) if self.is_default else member

    def _of_default(self, member: Member) -> Member:
        """The network as the default method refines it.

        A network whose output is metric is aligned too, where the points say that it should be. Of
        networks that take the points, only those made for fusion, with a prior, are updated.
        """
        settings = member.settings
        iterations = min(settings.iterations, UPDATES)
        if not member.takes_points and settings.align == "none":
            settings = replace(settings, align="auto")
        if member.takes_points and not member.takes_prior:
            iterations = 0
        return replace(member, settings=replace(settings, iterations=iterations))

    def _checked(self, frame: Frame, refined: Refined) -> Refined:
        """The refined frame with the fixed method's check, for which it is run again.

        It is returned as it is where its points are too few or the method fails.
        """
        parts = split_points(frame.points, self.asked.seed)
        if parts is None:
            return refined
        kept, points = parts
        unchecked = copy.copy(self)
        unchecked._check = unchecked._uncertainty = False
        try:
            again = unchecked.refine_frame(frame.with_points(kept))
        except PnpDepthError:
            return refined
        return replace(refined, validation=check_fixed(refined, again, kept, points))


def _finished(refined: Refined, frame: Frame) -> Refined:
    """The refined frame with what was decided before it was refined."""
    notes = refined.notes
    if frame.registration is not None:
        notes = (f"image: moved into the frame of the points by {frame.registration}", *notes)
    held_out = no_points(frame.points) if frame.held_out is None else frame.held_out
    return replace(refined, held_out=held_out, registration=frame.registration, notes=notes)
