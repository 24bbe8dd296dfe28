"""A network and a method, for any number of frames in memory."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from pnpdepth_cli.completion.image_registration import (
    Evidence,
    ImageRegistration,
    estimated,
    evidence,
)
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.default import check_fixed, refine_default, split_hidden
from pnpdepth_cli.frames.frame import Frame, RefinedFrame, WarmStart
from pnpdepth_cli.frames.fuse import Fusion, Member
from pnpdepth_cli.frames.refine import OnIteration, refine_frame, refine_frames
from pnpdepth_cli.frames.tiles import refine_tiled
from pnpdepth_cli.frames.uncertainty import uncertainty
from pnpdepth_cli.frames.warm_start import refine_next
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.method import Method, needs_check
from pnpdepth_cli.pipeline.refinement.points import split_points
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.points import SparsePoints

_TRIED = 3
"""After so many frames that say nothing of the registration, no more are read."""

Opened = Split | Fusion
"""The networks of a refiner, open for any number of frames."""


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
    """Whether it is the default method or a fixed one, and why."""
    members: tuple[Member, ...]
    """The networks of the default method, the user's first; the user's alone for a fixed one."""
    registrations: Mapping[tuple[int, int], ImageRegistration | None] = field(default_factory=dict)
    """How the images of one size are moved into the frame of the points, where many frames decide
    it. A frame of another size decides alone."""

    def opened(self) -> Opened:
        """Returns the networks, to be opened by `with` for all frames."""
        if self.method.is_default:
            return Fusion(self.members)
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
        hold_out = self.request.hold_out
        torch.manual_seed(hold_out.seed)
        frame, held_out = self._split_frame(inputs)
        if isinstance(opened, Fusion):
            budget_s = hold_out.time_budget_s
            refined = refine_default(
                opened,
                frame,
                seed=hold_out.seed,
                until=None if budget_s is None else time.monotonic() + budget_s,
            )
        else:
            fixed = self._fixed(opened, on_iteration)
            refined = fixed(frame)
            if needs_check(self.request):
                refined = self._checked(fixed, frame, refined)
        return _finished(self._with_sigma(refined), frame, held_out)

    def _fixed(self, split: Split, on_iteration: OnIteration) -> Callable[[Frame], RefinedFrame]:
        """The fixed method."""
        options: dict[str, Any] = {
            "propagation": self._propagation,
            "on_iteration": on_iteration,
        }
        if side := self.request.network.tile:
            return lambda frame: refine_tiled(
                self.network, split, self.settings, frame, side, **options
            )
        return functools.partial(refine_frame, self.network, split, self.settings, **options)

    def _checked(
        self, fixed: Callable[[Frame], RefinedFrame], frame: Frame, refined: RefinedFrame
    ) -> RefinedFrame:
        """The refined frame with the fixed method's check, for which it is run again.

        It is returned as it is where its points are too few or the method fails.
        """
        parts = split_hidden(frame.points, self.request.hold_out.seed)
        if parts is None:
            return refined
        kept, hidden = parts
        try:
            again = fixed(frame.with_points(kept))
        except PnpDepthError:
            return refined
        return replace(refined, check=check_fixed(refined, again, hidden, kept))

    def _with_sigma(self, refined: RefinedFrame) -> RefinedFrame:
        """The refined frame with its standard deviation, if that is asked for."""
        if not self.request.hold_out.uncertainty:
            return refined
        estimate = uncertainty(refined)
        return replace(
            refined,
            sigma=estimate.sigma,
            valid=estimate.valid,
            notes=(*refined.notes, estimate.note),
        )

    def refine_next(self, opened: Opened, inputs: Inputs, carried: WarmStart) -> RefinedFrame:
        """Returns one frame of a window, which may begin where the frame before ended.

        Raises:
            PnpDepthError: The frame cannot be refined.
        """
        assert isinstance(opened, Split)
        torch.manual_seed(self.request.hold_out.seed)
        frame, held_out = self._split_frame(inputs)
        refined = refine_next(
            self.network, opened, self.settings, frame, carried, propagation=self._propagation
        )
        return _finished(refined, frame, held_out)

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
            _finished(each, frame, points) if isinstance(each, RefinedFrame) else each
            for each, frame, points in zip(refined, frames, held_out, strict=True)
        ]

    def with_registration_of(self, group: Iterable[Inputs]) -> Refiner:
        """Returns the same refiner with the registration that the images of these frames share.

        Images of the size of the first one decide, for all frames of that size.
        """
        usable = list[Evidence]()
        for read, inputs in enumerate(group, 1):
            if inputs.rgb is not None and inputs.registration == "auto":
                known = evidence(inputs.rgb, self._split_points(inputs)[0])
                usable += [] if known is None else [known]
            if read == _TRIED and not usable:  # such as scans, none of which will tell
                break
        if not usable:
            return self
        return replace(self, registrations={usable[0].size: estimated(usable)})

    def _split_points(self, inputs: Inputs) -> tuple[SparsePoints, SparsePoints]:
        """The points to use, and the points held out."""
        hold_out = self.request.hold_out
        return split_points(inputs.points, hold_out.holdout, hold_out.seed)

    def _split_frame(self, inputs: Inputs) -> tuple[Frame, SparsePoints]:
        """The frame with the points to use, and the points held out."""
        used, held_out = self._split_points(inputs)
        if inputs.registration == "auto" and inputs.size in self.registrations:
            inputs = replace(inputs, registration=self.registrations[inputs.size])
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


def _finished(refined: RefinedFrame, frame: Frame, held_out: SparsePoints) -> RefinedFrame:
    """The refined frame with what was decided before it was refined."""
    notes = refined.notes
    if frame.registration is not None:
        notes = (f"image: moved into the frame of the points by {frame.registration}", *notes)
    return replace(refined, held_out=held_out, registration=frame.registration, notes=notes)
