"""A network and a method, for any number of frames in memory."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from pnpdepth_cli.auto.choice import Competition
from pnpdepth_cli.auto.cross_validation import spatial_folds
from pnpdepth_cli.auto.predictions import OpenNetworks
from pnpdepth_cli.completion.image_registration import (
    Evidence,
    ImageRegistration,
    estimated,
    evidence,
)
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Carried, Frame, RefinedFrame
from pnpdepth_cli.frames.refine import OnIteration, refine_frame, refine_frames
from pnpdepth_cli.frames.tiles import refine_tiled
from pnpdepth_cli.frames.warm_start import refine_next
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.held_out import best_candidates, refine_with_folds
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.method import Method
from pnpdepth_cli.pipeline.refinement.points import point_error, split_points
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.points import SparsePoints

_COMPARED_FOLDS = 5
"""One of so many folds is held out to compare a fixed method with linear interpolation."""
_TRIED = 3
"""After so many frames that say nothing of the registration, no more are read."""
_MIN_COMPARED = 5
"""Fewer points do not compare a method with linear interpolation."""

Opened = Split | OpenNetworks
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
    """Whether the method is chosen or fixed, and why."""
    networks: Mapping[str, Network]
    """All networks that compete by name, the user's first; `network` alone for a fixed method."""
    competition: Competition | None = None
    """Which candidates compete, where points are held out in turns."""
    registrations: Mapping[tuple[int, int], ImageRegistration | None] = field(default_factory=dict)
    """How the images of one size are moved into the frame of the points, where many frames decide
    it. A frame of another size decides alone."""

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
        if self.competition is not None and isinstance(opened, OpenNetworks):
            refined = refine_with_folds(opened, self.competition, self.request, frame, inputs.gt)
            return _finished(refined, frame, held_out)
        assert isinstance(opened, Split)
        network, settings, propagation = self.network, self.settings, self._propagation
        if side := self.request.network.tile:
            refined = refine_tiled(
                network, opened, settings, frame, side,
                propagation=propagation, on_iteration=on_iteration,
            )  # fmt: skip
        else:
            refined = refine_frame(
                network, opened, settings, frame, propagation=propagation, on_iteration=on_iteration
            )
        return _finished(refined, frame, held_out)

    def refine_next(self, opened: Opened, inputs: Inputs, carried: Carried) -> RefinedFrame:
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

    def compared(self, opened: Opened, inputs: Inputs, frame: RefinedFrame) -> RefinedFrame:
        """Returns the refined frame with its method's error at held-out points beside linear's.

        For a fixed method without ground truth: it is run once more without a fifth of the points.
        The frame is returned as it is where its points are too few or the method fails.
        """
        points = inputs.points
        if len(points) < _MIN_COMPARED:
            return frame
        held = spatial_folds(points, _COMPARED_FOLDS, seed=self.request.hold_out.seed) == 0
        kept, left = points.select(~held), points.select(held)
        try:
            again = self.refine(opened, replace(inputs, points=kept, gt=None))
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

    def with_shortlist_of(self, group: Sequence[Inputs]) -> Refiner:
        """Returns the same refiner with the candidates that are best on these frames."""
        assert self.competition is not None
        frames = [self._split_frame(inputs)[0] for inputs in group]
        with OpenNetworks(self.networks) as opened:
            seed = self.request.hold_out.seed
            choosing = replace(self.competition, hidden_points={})
            best = best_candidates(opened, choosing, seed, frames)
        return replace(self, competition=replace(self.competition, shortlist=best))

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
