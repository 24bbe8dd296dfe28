"""Baselines: dense depth without refinement, to measure a refined network against.

`pnpdepth_cli.choices.BASELINES` has their names. "local" aligns a network's depth locally. A global
alignment reads the network's numbers as a·x + b everywhere. Here a and b are fitted around
each pixel, to its nearest points (`completion.propagation`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

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


_LEAST_STD = 1e-9
"""Added to the standard deviation of the aligned depth at the points, in units of its mean.

The depth may be the same at all points, and it is divided by the standard deviation."""


def align_locally(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns the prediction aligned anew around each pixel, (H, W) float32 metres, 0 = unknown.

    It is within the bounds of a global alignment.

    Args:
        points: The points.
        prediction: Depth (H, W), metric or not; not positive or not finite is unknown, and 0 in the
            result.

    Raises:
        NoPointsError: No point has a prediction.
        ModelError: No global alignment fits.
    """
    device = prediction.device
    prediction = prediction.detach().cpu()
    known, points = where_predicted(prediction, points.tensors())
    points = distinct(points)
    # The global alignment, and one that only clamps metres to its bounds.
    x = torch.where(known, prediction, 1.0).double()  # 1 stands for what is unknown
    kinds = ("none", "scale", "affine")
    alignment = align(points.sample(x), points, [Candidate("depth", kind) for kind in kinds])
    aligned = alignment.scale * x + alignment.shift
    clamping = replace(alignment, scale=1.0, shift=0.0)
    # Aligned depth in standard deviations over the points: the regressor of the local lines.
    at_points = points.sample(aligned)
    mean = at_points.mean()
    std = at_points.std(correction=0) + _LEAST_STD * at_points.abs().mean()
    regressor = (aligned - mean) / std
    regressor_at_points = (at_points - mean) / std
    # The residual of depth by lines around every pixel, outliers counting less.
    residual = points.depth.double() - at_points
    log_residual = points.depth.double().log() - clamping.depth(at_points).log()
    weights = inlier_weights(points, log_residual)
    shift, slope = local_lines(points, None, residual, regressor_at_points, weights)
    depth = clamping.depth(aligned + shift + slope * regressor)
    return torch.where(known, depth, 0.0).float().to(device)


def _aligned(points: SparsePoints, prediction: Tensor, *, kind: str, reading: str) -> Tensor:
    """The prediction aligned with the points, (H, W) metres, 0 = unknown.

    It is `align_prediction` with the arguments of a baseline, points first.
    """
    return align_prediction(prediction, points, kind=kind, reading=reading)


def by_nearest(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns the depth of the nearest point, (H, W) metres; the prediction has no effect."""
    return nearest(points)


def by_linear(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns linear interpolation of depth between the points; the prediction has no effect."""
    return linear(points)


def by_linear_log(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns linear interpolation of log depth between the points, in metres; as `by_linear`."""
    return linear(points, space="log")


# Alignments of the whole prediction (`align_prediction`), with one factor or scale and shift.
by_median = partial(_aligned, kind="median", reading="depth")
by_scale = partial(_aligned, kind="scale", reading="depth")
by_affine = partial(_aligned, kind="affine", reading="depth")
by_scale_of_disparity = partial(_aligned, kind="scale", reading="disparity")
by_affine_of_disparity = partial(_aligned, kind="affine", reading="disparity")
