"""One frame in memory, and what refinement makes of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.completion.alignment import Alignment
from pnpdepth_cli.completion.image_registration import ImageRegistration
from pnpdepth_cli.core.refine import Refinement
from pnpdepth_cli.core.weights import MovingWeights
from pnpdepth_cli.errors import DivergedError
from pnpdepth_cli.points import SparsePoints

DepthMap = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """An image and its sparse depth."""

    rgb: Tensor | None
    """(3, H, W) float32 in 0…1. None without an image."""
    points: SparsePoints
    """Sparse depth in the image frame."""
    outliers: SparsePoints | None = None
    """Points that were left out as outliers, for networks that weigh their points."""
    prior: Tensor | None = None
    """(H, W) metres, 0 = unknown: another network's depth, aligned with the points, for networks
    that take one. None without."""
    registration: ImageRegistration | None = None
    """How `rgb` was moved into the frame of the points. None: it was not."""

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the image frame."""
        return self.points.size

    def with_points(self, points: SparsePoints) -> Frame:
        """Returns the same image with other sparse depth."""
        return replace(self, points=points)

    def without(self, outliers: Tensor) -> Frame:
        """Returns the frame with those points, of (N,) bool, left out as outliers."""
        left_out = self.points.select(outliers)
        return replace(self, points=self.points.select(~outliers), outliers=left_out)


@dataclass(frozen=True, kw_only=True)
class Carried:
    """What a frame of a window may take over from the frame before; the first has nothing."""

    change: Tensor | None = None
    """z_K − z_0 of the frame before."""
    alignment: Alignment | None = None
    """Its alignment of the network's output with the points."""
    weights: MovingWeights | None = None
    """Its weights, where weights move instead of z."""


@dataclass(frozen=True, kw_only=True)
class RefinedFrame:
    """A refined frame, all in the image frame."""

    before: DepthMap
    """(H, W) metres, 0 = unknown: the network's depth before refinement."""
    after: DepthMap
    """(H, W) metres, 0 = unknown: the refined depth."""
    used: SparsePoints
    """The points that the depth was fitted to."""
    held_out: SparsePoints
    """The points that were kept out, to score at."""
    refinement: Refinement
    """Losses and step sizes of the refinement."""
    diverged: DivergedError | None
    """Why the refinement stopped early. None if it did not."""
    alignment: Alignment | None = None
    """Alignment of the network's output with the points. None where the output is in metres."""
    notes: tuple[str, ...] = ()
    """What a person should know."""
    sigma: DepthMap | None = None
    """(H, W) metres, standard deviation of `after`. None if it was not asked for."""
    valid: NDArray[np.bool_] | None = None
    """(H, W), where points support `after`. None without `sigma`."""
    choice: dict[str, Any] | None = None
    """What was chosen by held-out points, for a record."""
    interpolation: dict[str, Any] | None = None
    """Mean absolute errors in metres of the network (before), of linear interpolation and of the
    result (after) at points that were held out in turns, for a record."""
    baselines: dict[str, dict[str, Any]] | None = None
    """Scores of the baselines, for a record."""
    registration: ImageRegistration | None = None
    """How the image was moved into the frame of the points. None: it was not."""
    in_window: bool = False
    """Whether it was refined as a frame of a window, which may begin where the one before ended."""
    carried: Carried | None = None
    """What the next frame of the window may begin with; dropped once that has begun."""


def no_points(points: SparsePoints) -> SparsePoints:
    """Returns an empty selection of the points."""
    return points.select(torch.zeros(len(points), dtype=torch.bool))
