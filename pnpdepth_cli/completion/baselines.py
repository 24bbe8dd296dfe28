"""Baselines: dense depth without refinement, to measure a refined network against.

`pnpdepth_cli.choices.BASELINES` lists the names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from torch import Tensor

from pnpdepth_cli.completion.alignment import aligned
from pnpdepth_cli.completion.interpolation import inverse_distance, linear, morphological, nearest
from pnpdepth_cli.completion.local_alignment import locally_aligned
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Predicts dense depth (H, W) float32 metres, from the points or from a prediction."""

    title: str
    """What it does, for a table."""
    of_points: Callable[..., Tensor] | None = None
    """Depth from the points alone."""
    of_prediction: Callable[..., Tensor] | None = None
    """Depth from a prediction (H, W), up to scale and shift with 0 unknown, and the points."""
    pointwise: bool = False
    """Whether the function takes `xy` (M, 2), so that few pixels cost less than all."""

    @property
    def needs_prediction(self) -> bool:
        """Whether it needs a network."""
        return self.of_prediction is not None

    def depth(self, points: SparsePoints, prediction: Tensor | None = None) -> Tensor:
        """Returns the depth (H, W) metres, 0 = unknown.

        Raises:
            UsageError: It needs a prediction and there is none.
        """
        if self.of_points is not None:
            return self.of_points(points)
        if self.of_prediction is None or prediction is None:
            raise UsageError(f"baseline {self.title!r} needs a network's prediction")
        return self.of_prediction(prediction, points)

    def at(self, xy: Tensor, points: SparsePoints, prediction: Tensor | None = None) -> Tensor:
        """Returns the depth (M,) metres at pixel coordinates (M, 2); errors as of `depth`."""
        if not self.pointwise:
            queries = SparsePoints(xy=xy, depth=xy.new_ones(len(xy)), size=points.size)
            return queries.sample(self.depth(points, prediction))
        bound = replace(
            self,
            of_points=self.of_points and partial(self.of_points, xy=xy),
            of_prediction=self.of_prediction and partial(self.of_prediction, xy=xy),
        )
        return bound.depth(points, prediction)


def _points(title: str, depth: Callable[..., Tensor], *, pointwise: bool = True) -> Baseline:
    return Baseline(title=title, of_points=depth, pointwise=pointwise)


def _aligned(title: str, kind: str, space: str) -> Baseline:
    return Baseline(title=title, of_prediction=partial(aligned, kind=kind, space=space))


TABLE = {
    "nearest": _points("nearest point", nearest),
    "linear": _points("linear between points (Delaunay)", linear),
    "linear-log": _points("linear between points, in log depth", partial(linear, space="log")),
    "idw": _points("inverse distance weighting", inverse_distance),
    "morphological": _points("morphological fill (IP-Basic)", morphological, pointwise=False),
    "median": _aligned("median of ratios", kind="median", space="depth"),
    "scale": _aligned("scale", kind="scale", space="depth"),
    "affine": _aligned("scale and shift", kind="affine", space="depth"),
    "scale-disparity": _aligned("scale, in disparity", kind="scale", space="inverse"),
    "affine-disparity": _aligned("scale and shift, in disparity", kind="affine", space="inverse"),
    "local": Baseline(
        title="scale and shift around each pixel", of_prediction=locally_aligned, pointwise=True
    ),
}
