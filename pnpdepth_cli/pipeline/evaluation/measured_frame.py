"""What a group of additional measures gets of a frame, and what it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.core.metrics import Measure

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MeasuredFrame:
    """A frame as its protocol scores it; depths are (H, W) metres, 0 where unknown."""

    depth: Depth
    """The prediction."""
    gt: Depth
    """The ground truth, 0 where it is not scored."""
    intrinsics: Floats | None = None
    """(3, 3) of the frame, if they are known."""
    sparse: Depth | None = None
    """The sparse points on their pixels, if they are known."""
    previous: MeasuredFrame | None = None
    """The frame before in the same sequence, without its own previous one; None for the first."""

    @property
    def both(self) -> Mask:
        """(H, W) true where prediction and ground truth are known."""
        return (self.depth > 0) & (self.gt > 0)

    def points(self, depth: Depth) -> Floats:
        """Returns (H, W, 3) metres in the camera's frame of each pixel of a depth map."""
        assert self.intrinsics is not None
        height, width = depth.shape
        y, x = np.mgrid[:height, :width].astype(np.float64)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(self.intrinsics).T
        return np.asarray(rays * depth[..., None].astype(np.float64))


@dataclass(frozen=True, kw_only=True)
class MeasureGroup:
    """Measures that are computed together, one file of `measures/` each, called `GROUP`."""

    measures: tuple[Measure, ...]
    """In the order of tables."""
    values: Callable[[MeasuredFrame], dict[str, float]]
    """Each measure of a frame by its key; NaN where the frame has none."""
    needs: Literal["nothing", "intrinsics", "sparse"] = "nothing"
    """What a frame must have beside its depths."""
    in_sequences: bool = False
    """True if `previous` is used."""


def mean_of(values: NDArray[np.generic], weights: Floats | None = None) -> float:
    """Returns the mean, weighted or not; NaN of nothing."""
    if not values.size:
        return math.nan
    return float(np.average(values.astype(np.float64), weights=weights))
