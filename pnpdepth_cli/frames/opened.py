"""Networks that stay cut from frame to frame and compute nothing twice for one image.

For one image and several sets of points, the front of a network that takes the image alone runs
once, and so does the image encoder that a definition names.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.refine import Refinement, refine_from
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.refine import to_refined_frame
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.settings import Settings


@dataclass(frozen=True, kw_only=True, eq=False)
class Member:
    """A network of the default method."""

    network: Network
    layer: str  # layer to cut at
    settings: Settings  # how its output is aligned and z is updated

    @property
    def name(self) -> str:
        """What the network is called."""
        return self.network.definition.name

    @property
    def takes_points(self) -> bool:
        """Whether sparse depth is an input."""
        return "sparse" in self.network.definition.input_kind

    @property
    def takes_prior(self) -> bool:
        """Whether another network's depth is an input."""
        return self.network.definition.takes_prior


class OpenNetworks:
    """The networks of the default method, open from frame to frame, as a context manager.

    Args:
        members: The networks, the user's first.
    """

    def __init__(self, members: Sequence[Member]) -> None:
        self.members = tuple(members)
        self._opened = {member: OpenNetwork(member.network, member.layer) for member in members}
        self._stack = ExitStack()

    def __enter__(self) -> OpenNetworks:
        for opened in self._opened.values():
            self._stack.enter_context(opened)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def next_image(self) -> None:
        """Forgets what was computed for the last image."""
        for opened in self._opened.values():
            opened.next_image()

    def refine(self, member: Member, frame: Frame, *, updates: bool = True) -> Refined:
        """Returns the frame refined by one network, its residual not propagated.

        Args:
            member: The network.
            frame: The image, the same in all calls until `next_image`, and the points of this call.
            updates: Whether z is updated.

        Raises:
            PnpDepthError: The refinement fails.
        """
        settings = member.settings
        if not updates:
            settings = replace(settings, iterations=0)
        return self._opened[member].refine(frame, settings)


class OpenNetwork:
    """A network that is cut when first refined, as a context manager."""

    def __init__(self, network: Network, layer: str) -> None:
        self.network, self.layer = network, layer
        self._of_image_only = network.definition.input_kind == "rgb"
        self._open = ExitStack()
        self._split: Split | None = None
        self._z0: Tensor | None = None
        self._output: Any = None
        self._encoded: dict[str, Any] = {}

    def __enter__(self) -> OpenNetwork:
        self._open.enter_context(encoding_once(self.network, self._encoded))
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
        self._split = None
        self.next_image()

    def next_image(self) -> None:
        """Forgets what was computed for the last image."""
        self._z0 = self._output = None
        self._encoded.clear()

    def refine(self, frame: Frame, settings: Settings) -> Refined:
        """Returns the frame refined by this network, its residual not propagated.

        Args:
            frame: The image, the same in all calls until `next_image`, and the points of this call.
            settings: How z is updated.

        Raises:
            PnpDepthError: The refinement fails.
        """
        settings = settings.complete()
        with out_of_memory_is_a_device_error(self.network.device):
            prepared = prepare(self.network, frame)
            if not len(prepared.points):
                raise prepared.no_points_error()
            reader = prepared.depth_reader(settings.align)
            if settings.iterations:
                result = self._updated(prepared, reader, settings)
            else:
                result = self._plain(prepared, reader, settings)
        refined = to_refined_frame(prepared, reader, result)
        if isinstance(refined, PnpDepthError):
            raise refined
        return refined

    def _cut(self) -> Split:
        """The network cut at the layer, open."""
        if self._split is None:
            self._split = self._open.enter_context(self.network.cut_at(self.layer))
        return self._split

    def _updated(
        self, prepared: PreparedFrame, reader: AlignedDepth, settings: Settings
    ) -> Refinement | PnpDepthError:
        split, z0 = self._cut(), self._z0
        if z0 is None:
            with torch.no_grad():
                z0 = split.front(*prepared.arguments)
        if self._of_image_only:
            self._z0 = z0
        coarse, points = self.network.definition.coarse, (prepared.points,)
        if coarse is None:
            return refine_from(split, z0, points, settings, depth_of=(reader,))[0]
        with coarse(self.network.module) as at_full_size:
            (result,) = refine_from(split, z0, points, settings, depth_of=(reader,))
        if isinstance(result, Refinement):
            before, after = (reader(at_full_size[number]) for number in (0, -1))
            result = replace(result, before=before, after=after)
        return result

    def _plain(
        self, prepared: PreparedFrame, reader: AlignedDepth, settings: Settings
    ) -> Refinement:
        """The same without updates: a pass of the whole network, which need not be cut."""
        output = self._output
        if output is None and self._z0 is not None:
            with torch.no_grad():
                output = self._cut().rear(self._z0)
        elif output is None:
            with torch.no_grad(), wrap_user_errors("the network's forward"):
                output = self.network.module(*prepared.arguments)
        if self._of_image_only:
            self._output = output
        depth = reader(output).detach()
        at_points = prepared.points.sample(depth)
        known = at_points.isfinite()
        loss = checked_loss(settings.loss)(at_points[known], prepared.points.depth[known])
        return Refinement(before=depth, after=depth, losses=(float(loss),), step=0.0)


@contextmanager
def encoding_once(network: Network, encoded: dict[str, Any]) -> Iterator[None]:
    """Inside, the image encoder, if the definition names one, runs once; then its output is known.

    Args:
        network: The network.
        encoded: What is known, by the encoder's name; cleared for another image.
    """
    name = network.definition.image_encoder
    if name is None:
        yield
        return
    encoder = network.module.get_submodule(name)
    run, own = encoder.forward, encoder.__dict__.get("forward")

    def forward(*inputs: Any, **options: Any) -> Any:
        if name not in encoded:
            encoded[name] = run(*inputs, **options)
        return encoded[name]

    encoder.__dict__["forward"] = forward
    try:
        yield
    finally:
        if own is None:
            encoder.__dict__.pop("forward", None)
        else:
            encoder.__dict__["forward"] = own
