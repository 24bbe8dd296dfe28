"""Every simple way to dense depth, by name: what a refined network is measured against.

The paper's own setting is one more; it needs the network itself and is `refine` with a plain
`RefineSettings()`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
    """A way to dense depth (H, W) float32 in metres of the points' frame.

    title: what it does, for a table. of_points: from the points alone. of_prediction: from a
    prediction (H, W), depth up to scale and shift with 0 unknown, and the points; where the
    prediction is unknown the result is 0. One of the two is given. pointwise: whether it takes
    `places` too, so that depth at few pixels costs less than at all.
    """

    title: str
    of_points: Callable[..., Tensor] | None = None
    of_prediction: Callable[..., Tensor] | None = None
    pointwise: bool = False

    @property
    def needs_prediction(self) -> bool:
        """Whether the baseline uses the network's depth."""
        return self.of_prediction is not None

    def depth(self, points: SparsePoints, prediction: Tensor | None = None) -> Tensor:
        """The depth (H, W). UsageError if it needs a prediction and there is none."""
        if self.of_points is not None:
            return self.of_points(points)
        if self.of_prediction is None or prediction is None:
            raise UsageError(f"baseline {self.title!r} needs a network's prediction")
        return self.of_prediction(prediction, points)

    def at(self, places: Tensor, points: SparsePoints, prediction: Tensor | None = None) -> Tensor:
        """The depth (M,) at places (M, 2), x and y in pixels; errors as of `depth`."""
        if not self.pointwise:
            there = SparsePoints(xy=places, depth=places.new_ones(len(places)), size=points.size)
            return there.sample(self.depth(points, prediction))
        bound = replace(
            self,
            of_points=self.of_points and partial(self.of_points, places=places),
            of_prediction=self.of_prediction and partial(self.of_prediction, places=places),
        )
        return bound.depth(points, prediction)


def _fit(kind: str, space: str) -> Callable[[Tensor, SparsePoints], Tensor]:
    return partial(aligned, kind=kind, space=space)


BASELINES: Mapping[str, Baseline] = {
    "nearest": Baseline(title="nearest point", of_points=nearest, pointwise=True),
    "linear": Baseline(title="linear between points (Delaunay)", of_points=linear, pointwise=True),
    "linear-log": Baseline(
        title="linear between points, in log depth",
        of_points=partial(linear, space="log"),
        pointwise=True,
    ),
    "idw": Baseline(title="inverse distance weighting", of_points=inverse_distance, pointwise=True),
    "morphological": Baseline(title="morphological fill (IP-Basic)", of_points=morphological),
    "median": Baseline(title="median of ratios", of_prediction=_fit("median", "depth")),
    "scale": Baseline(title="scale", of_prediction=_fit("scale", "depth")),
    "affine": Baseline(title="scale and shift", of_prediction=_fit("affine", "depth")),
    "scale-disparity": Baseline(
        title="scale, in disparity", of_prediction=_fit("scale", "inverse")
    ),
    "affine-disparity": Baseline(
        title="scale and shift, in disparity", of_prediction=_fit("affine", "inverse")
    ),
    "local": Baseline(
        title="scale and shift around each pixel", of_prediction=locally_aligned, pointwise=True
    ),
}
