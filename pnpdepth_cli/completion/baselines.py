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


def _aligned(points: SparsePoints, prediction: Tensor, *, kind: str, reading: str) -> Tensor:
    """The prediction, read as depth or disparity and aligned with the points."""
    return align_prediction(prediction, points, kind=kind, reading=reading)


def by_nearest(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns the depth of the nearest point everywhere."""
    return nearest(points)


def by_linear(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns linear interpolation of depth between the points."""
    return linear(points)


def by_linear_log(points: SparsePoints, prediction: Tensor) -> Tensor:
    """Returns linear interpolation of log depth between the points."""
    return linear(points, space="log")


by_median = partial(_aligned, kind="median", reading="depth")
by_scale = partial(_aligned, kind="scale", reading="depth")
by_affine = partial(_aligned, kind="affine", reading="depth")
by_scale_of_disparity = partial(_aligned, kind="scale", reading="disparity")
by_affine_of_disparity = partial(_aligned, kind="affine", reading="disparity")
