"""A synthetic scene, sparse points of it, and the error of its completion."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pnpdepth_cli.points import SparsePoints

SIZE = (48, 64)


def scene_depth() -> Tensor:
    """Depth (H, W) in metres: a floor, a wall and a box."""
    y, x = torch.meshgrid(*(torch.arange(float(n)) for n in SIZE), indexing="ij")
    depth = torch.minimum(60 / (y - 10).clamp_min(1), 4 + 0.02 * x)
    depth[20:40, 10:30] = 1.4
    return depth


class Scene(NamedTuple):
    ground_truth: Tensor
    """Depth (H, W), `scene_depth`."""
    rgb: Tensor
    """Its image (3, H, W)."""
    prediction: Tensor
    """Depth (H, W) with a drifting scale."""


def scene() -> Scene:
    """A scene, its image, and a prediction that is wrong by a scale that drifts."""
    depth = scene_depth()
    y, x = torch.meshgrid(*(torch.arange(float(n)) for n in SIZE), indexing="ij")
    rgb = torch.stack([0.3 + 0.4 * (depth < 1.5), 0.5 + 0.2 * y / 48, 0.4 + 0 * x])
    prediction = depth * (0.7 + 0.5 * x / 64) * torch.where(depth < 1.5, 1.3, 1.0)
    return Scene(ground_truth=depth, rgb=rgb, prediction=prediction)


def random_points(depth: Tensor, count: int, seed: int = 0) -> SparsePoints:
    """`count` random pixels of a depth (H, W)."""
    height, width = depth.shape
    chosen = torch.randperm(depth.numel(), generator=torch.Generator().manual_seed(seed))[:count]
    xy = torch.stack([chosen % width, chosen // width], dim=1).float()
    return SparsePoints(xy=xy, depth=depth.flatten()[chosen], size=(height, width))


def mean_log_error(depth: Tensor, ground_truth: Tensor) -> float:
    """Mean absolute error of log depth."""
    return float((depth.log() - ground_truth.log()).abs().mean())
