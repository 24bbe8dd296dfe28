"""Baselines: dense depth without refinement, to measure a refined network against.

`pnpdepth_cli.choices.BASELINES` lists the names. "local" aligns a network's depth locally. A global
alignment reads the network's numbers as a·x + b everywhere. Here a and b are fitted around
each pixel, to its nearest points (`completion.propagation`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from pnpdepth_cli.completion.alignment import (
    Candidate,
    align,
    align_prediction,
    where_predicted,
)
from pnpdepth_cli.completion.interpolation import distinct, linear, nearest
from pnpdepth_cli.completion.outliers import inlier_weights
from pnpdepth_cli.completion.propagation import local_lines
from pnpdepth_cli.points import SparsePoints

Baseline = Callable[[SparsePoints, Tensor], Tensor]
"""Gives depth (H, W) metres, 0 = unknown, from points and a prediction (H, W), which is up to scale
and shift, 0 = unknown."""


_LEAST_STD = 1e-9  # of the aligned depth at the points, over its mean: it may be level


def align_locally(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns the locally aligned depth (H, W) float32 metres, within a global alignment's bounds.

    Args:
        prediction: (H, W) depth, metric or not; not positive or not finite is unknown, and 0 in the
            result.

    Raises:
        NoPointsError: No point has a prediction.
    """
    device = prediction.device
    prediction = prediction.detach().cpu()
    known, points = where_predicted(prediction, points.tensors())
    points = distinct(points)
    # The global alignment, as metres and as what keeps metres within its bounds.
    x = torch.where(known, prediction, 1.0).double()
    kinds = ("none", "scale", "affine")
    aligned = align(points.sample(x), points, [Candidate("depth", kind) for kind in kinds])
    start = aligned.scale * x + aligned.shift
    bounded = replace(aligned, scale=1.0, shift=0.0)
    # It in standard deviations over the points, which lines are over.
    at_points = points.sample(start)
    mean = at_points.mean()
    std = at_points.std(correction=0) + _LEAST_STD * at_points.abs().mean()
    z = (start - mean) / std
    z_at_points = (at_points - mean) / std
    # The residual of depth by lines around every pixel, outliers counting less.
    residual = points.depth.double() - at_points
    weights = inlier_weights(points, points.depth.double().log() - bounded.depth(at_points).log())
    shift, slope = local_lines(points, None, residual, z_at_points, weights)
    depth = bounded.depth(start + shift + slope * z)
    return torch.where(known, depth, 0.0).float().to(device)


def _aligned(kind: str, reading: str = "depth") -> Baseline:
    """The baseline that aligns the prediction."""
    return lambda points, prediction: align_prediction(
        prediction, points, kind=kind, reading=reading
    )


TABLE: dict[str, Baseline] = {
    "nearest": lambda points, _: nearest(points),
    "linear": lambda points, _: linear(points),
    "linear-log": lambda points, _: linear(points, space="log"),
    "median": _aligned("median"),
    "scale": _aligned("scale"),
    "affine": _aligned("affine"),
    "scale-disparity": _aligned("scale", "disparity"),
    "affine-disparity": _aligned("affine", "disparity"),
    "local": align_locally,
}
