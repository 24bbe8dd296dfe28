"""Baselines: dense depth without refinement, to measure a refined network against.

`pnpdepth_cli.choices.BASELINES` lists the names. "local" aligns a network's depth locally. A global
alignment reads the network's numbers as a·x + b everywhere. Here a and b are fitted around
each pixel, to its nearest points (`completion.propagation`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from pnpdepth_cli.completion.alignment import align, align_prediction, where_predicted
from pnpdepth_cli.completion.interpolation import distinct, linear, nearest
from pnpdepth_cli.completion.outliers import inlier_weights
from pnpdepth_cli.completion.propagation import local_lines
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Predicts dense depth (H, W) float32 metres, from the points or from a prediction."""

    title: str  # what it does, for a table
    of_points: Callable[..., Tensor] | None = None  # depth from the points alone
    of_prediction: Callable[..., Tensor] | None = None
    """Depth from a prediction (H, W), up to scale and shift with 0 unknown, and the points."""

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


def _align_by(title: str, kind: str, space: str) -> Baseline:
    return Baseline(title=title, of_prediction=partial(align_prediction, kind=kind, space=space))


def align_locally(prediction: Tensor, points: SparsePoints) -> Tensor:
    """Returns the locally aligned depth (H, W) float32 metres, within a global alignment's bounds.

    Args:
        prediction: (H, W) depth, metric or not; not positive or not finite is unknown, and 0 in the
            result.

    Raises:
        NoPointsError: No point has a prediction.
    """
    device, prediction, points = prediction.device, prediction.detach().cpu(), points.tensors()
    known, points = where_predicted(prediction, points)
    points = distinct(points)
    x = torch.where(known, prediction, 1.0).double()
    aligned = align(points.sample(x), points, ("depth",), "auto")
    start, reading = aligned.scale * x + aligned.shift, replace(aligned, scale=1.0, shift=0.0)
    at_points = points.sample(start)
    std = at_points.std(correction=0) + 1e-9 * at_points.abs().mean()
    z, z_at_points = ((y - at_points.mean()) / std for y in (start, at_points))
    residual = points.depth.double() - at_points
    weights = inlier_weights(points, points.depth.double().log() - reading.depth(at_points).log())
    shift, slope = local_lines(points, None, residual, z_at_points, weights)
    depth = reading.depth(start + shift + slope * z)
    return torch.where(known, depth, 0.0).float().to(device)


TABLE = {
    "nearest": Baseline(title="nearest point", of_points=nearest),
    "linear": Baseline(title="linear between points (Delaunay)", of_points=linear),
    "linear-log": Baseline(
        title="linear between points, in log depth",
        of_points=partial(linear, space="log"),
    ),
    "median": _align_by("median of ratios", kind="median", space="depth"),
    "scale": _align_by("scale", kind="scale", space="depth"),
    "affine": _align_by("scale and shift", kind="affine", space="depth"),
    "scale-disparity": _align_by("scale, in disparity", kind="scale", space="inverse"),
    "affine-disparity": _align_by("scale and shift, in disparity", kind="affine", space="inverse"),
    "local": Baseline(title="scale and shift around each pixel", of_prediction=align_locally),
}
