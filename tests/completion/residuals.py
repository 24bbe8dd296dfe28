"""A residual field that tests of the Gaussian process and of outliers share."""

from __future__ import annotations

import torch

from pnpdepth_cli.completion.gaussian_process import (
    Residuals,
    features_of,
)
from pnpdepth_cli.points import SparsePoints

SIZE = (20, 30)


def field(
    count: int, *, size: tuple[int, int] = SIZE, colour: bool = True, seed: int = 0
) -> Residuals:
    """A smooth residual at random pixels of an image with a step in its prediction."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    chosen = torch.randperm(height * width, generator=generator)[:count]
    xy = torch.stack([chosen % width, chosen // width], dim=1).float()
    rgb = torch.rand(3, height, width, generator=generator) if colour else None
    log = torch.rand(size, generator=generator) * 0.1
    log[:, width // 2 :] += 1.0
    points = SparsePoints(xy=xy, depth=torch.ones(count), size=size)
    features = features_of(log, rgb)
    residual = torch.sin(xy[:, 0] / width * 3).double() * 0.3 + 0.2
    at = torch.stack([points.sample(feature) for feature in features], dim=1)
    return Residuals(features=features, points=points, point_features=at, residual=residual)
