"""A synthetic frame, to look at a network without one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.points import SparsePoints

if TYPE_CHECKING:
    from pnpdepth_cli.models.network import Network

_POINTS = 500


def synthetic_arguments(network: Network, frame: FrameMap) -> tuple[Tensor, ...]:
    """The network's arguments for the synthetic frame of this size."""
    rgb, points = synthetic_frame(frame.image)
    return network.arguments(frame, rgb, frame.points_to_network(points))


def synthetic_frame(size: tuple[int, int], count: int = _POINTS) -> tuple[Tensor, SparsePoints]:
    """A smooth random rgb image (1, 3, H, W), and points on a slanted plane; the seed is fixed."""
    height, width = size
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, max(2, height // 8), max(2, width // 8), generator=generator)
    rgb = F.interpolate(coarse, size, mode="bilinear")
    pixels = torch.randperm(height * width, generator=generator)[:count]
    y, x = pixels // width, pixels % width
    points = SparsePoints(
        xy=torch.stack([x, y], dim=1).float(),
        depth=2 + 3 * y.float() / height + torch.rand(len(pixels), generator=generator),
        size=size,
    )
    return rgb, points
