"""What refinement makes of a frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.completion.alignment import Alignment
from pnpdepth_cli.completion.image_registration import ImageRegistration
from pnpdepth_cli.errors import DivergedError
from pnpdepth_cli.frames.frame import DepthMap, Frame
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What one network gives for a frame, at the image's size."""

    before: Tensor  # (H, W) metres, 0 = unknown: aligned with the points
    after: Tensor  # (H, W) metres, 0 = unknown: z updated
    losses: tuple[float, ...]  # at the points, before the first update of z and after each
    step: float  # α as a number
    diverged: DivergedError | None  # why the updates ended early. None if they did not
    alignment: Alignment | None
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Refined:
    """A refined frame; maps have the image's size."""

    before: DepthMap
    """(H, W) metres, 0 = unknown: the network's depth before refinement."""
    after: DepthMap
    """(H, W) metres, 0 = unknown: the refined depth."""
    used: SparsePoints
    """The points that the depth was fitted to."""
    held_out: SparsePoints
    losses: tuple[float, ...]
    """Loss at the points before the first update and after each update."""
    step: float
    """Step size of the updates as a number."""
    diverged: DivergedError | None
    """Why the refinement stopped early. None if it did not."""
    alignment: Alignment | None = None
    """Alignment of the network's output with the points. None where the output is in metres."""
    notes: tuple[str, ...] = ()
    sigma: DepthMap | None = None
    """(H, W) metres, standard deviation of `after`. None if it was not asked for."""
    valid: NDArray[np.bool_] | None = None
    """(H, W), where points support `after`. None without `sigma`."""
    stages: Mapping[str, DepthMap] = field(default_factory=dict)
    """(H, W) metres of stages of the default method, by name; of a frame with ground truth."""
    validation: Validation | None = None
    """The stages and the result at validation points. None where nothing was validated."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """Weights of the experts of the default method, by name; their sum is 1."""
    registration: ImageRegistration | None = None
    """How the image was moved to the points. None: it was not."""

    def __repr__(self) -> str:
        height, width = self.after.shape
        weights = "".join(f", {name} {weight:.2f}" for name, weight in self.weights.items())
        return f"Refined({width}×{height}, {len(self.used):,} points{weights})"

    @property
    def depth(self) -> DepthMap:
        """The refined depth, `after`."""
        return self.after


@dataclass(frozen=True, kw_only=True)
class ValidationPoints:
    """Points that predictions from the other points are compared with."""

    points: SparsePoints  # the M validation points; none of a frame with few points
    weights: Tensor  # (M,) 0…1, how consistent each is with its neighbours

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.points):,} points)"

    def error(self, at: Tensor) -> float:
        """Returns the weighted mean absolute error in metres of a prediction (M,).

        A point without prediction counts as far off as a depth of 0 is.
        """
        error = (at - self.points.depth).abs()
        return float((error * self.weights).sum() / self.weights.sum())


@dataclass(frozen=True, kw_only=True, repr=False)
class Validation(ValidationPoints):
    """Depth at validation points, predicted from the other points.

    Networks that take points predict without updates of z.
    """

    kept: SparsePoints  # all other points that were given
    network: Tensor  # (H, W) metres, 0 = unknown: the user's network, aligned with the other points
    predicted: Mapping[str, Tensor]
    """(M,) metres at the validation points, by stage; also linear interpolation and the result."""


def make_refined(
    frame: Frame,
    own: Prediction,
    depth: Tensor,
    *,
    used: SparsePoints,
    notes: Sequence[str] = (),
    stages: Mapping[str, Tensor] = MappingProxyType({}),
    validation: Validation | None = None,
    weights: Mapping[str, float] = MappingProxyType({}),
) -> Refined:
    """Returns the refined frame.

    Args:
        frame: The frame, its image moved to its points.
        own: Prediction of the user's network for it.
        depth: (H, W) metres, 0 = unknown: the refined depth.
        notes: Lines of the method for a person.
        stages: (H, W) metres of stages of the method, by name.
    """
    if frame.registration is not None:
        moved = "image: moved to the pixel coordinates of the depth camera by"
        notes = (f"{moved} {frame.registration}", *notes)
    before, after = (each.numpy() for each in (own.before, depth))
    return Refined(
        before=before,
        after=after,
        used=used,
        held_out=used.select(slice(0)) if frame.held_out is None else frame.held_out,
        losses=own.losses,
        step=own.step,
        diverged=own.diverged,
        alignment=own.alignment,
        notes=(*own.notes, *notes),
        stages={name: each.numpy() for name, each in stages.items()},
        validation=validation,
        weights=weights,
        registration=frame.registration,
    )
