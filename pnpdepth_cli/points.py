"""Sparse depth as points: coordinates and depths, never a resampled image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class SparsePoints:
    """N true depths at pixel coordinates of a frame.

    xy: (N, 2) float32, x to the right and y down, pixel centres at whole numbers.
    depth: (N,) float32 metres, all finite and positive.
    size: (height, width) of the frame the coordinates live in.
    """

    xy: Tensor
    depth: Tensor
    size: tuple[int, int]

    def __len__(self) -> int:
        return int(self.depth.numel())

    def in_frame(self, height: int, width: int) -> SparsePoints:
        """The same points in the same field of view sampled by height × width pixels.

        Coordinates move with the pixel areas (half-pixel convention); depths are untouched.
        """
        if (height, width) == self.size:
            return self
        scale = self.xy.new_tensor([width / self.size[1], height / self.size[0]])
        return SparsePoints(
            xy=(self.xy + 0.5) * scale - 0.5, depth=self.depth, size=(height, width)
        )

    def cropped(self, top: int, left: int, height: int, width: int) -> SparsePoints:
        """The points in these rows and columns of the frame, at their places in that part."""
        x, y = self.xy[:, 0] - left, self.xy[:, 1] - top
        inside = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
        return SparsePoints(
            xy=torch.stack([x, y], dim=1)[inside], depth=self.depth[inside], size=(height, width)
        )

    def select(self, mask: Tensor) -> SparsePoints:
        """The points where mask (N,) is true."""
        return SparsePoints(xy=self.xy[mask], depth=self.depth[mask], size=self.size)

    def to(self, device: torch.device | str) -> SparsePoints:
        """The same points on another device."""
        return SparsePoints(xy=self.xy.to(device), depth=self.depth.to(device), size=self.size)

    def sample(self, dense: Tensor) -> Tensor:
        """The values (N,) of a dense map (..., h, w) of this field of view at the points.

        Plain indexing where every point sits on the map's grid, bilinear otherwise; beyond the
        outermost pixel centres the border value holds. Differentiable in `dense`.
        """
        height, width = dense.shape[-2:]
        xy = self.in_frame(height, width).xy
        flat = dense.reshape(-1)
        if flat.numel() != height * width:
            raise ValueError(f"one map is expected, not shape {tuple(dense.shape)}")
        x = xy[:, 0].clamp(0, width - 1)
        y = xy[:, 1].clamp(0, height - 1)
        left, top = x.floor().long(), y.floor().long()
        fx, fy = x - left, y - top
        if not bool((fx != 0).any()) and not bool((fy != 0).any()):
            return flat[top * width + left]
        # On the grid both neighbours are one: a pixel without weight may be infinite.
        right, bottom = x.ceil().long(), y.ceil().long()
        upper = flat[top * width + left] * (1 - fx) + flat[top * width + right] * fx
        lower = flat[bottom * width + left] * (1 - fx) + flat[bottom * width + right] * fx
        return upper * (1 - fy) + lower * fy

    def scatter(self) -> Tensor:
        """(1, 1, H, W) metres, 0 = unknown: each point on its nearest pixel, nearest point wins."""
        height, width = self.size
        x, y = self.xy[:, 0], self.xy[:, 1]
        inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        column, row = x.round().clamp(0, width - 1), y.round().clamp(0, height - 1)
        flat = self.depth.new_full((height * width,), torch.inf)
        places = row.long() * width + column.long()
        flat.scatter_reduce_(0, places[inside], self.depth[inside], "amin")
        return torch.where(flat.isinf(), 0.0, flat).reshape(1, 1, height, width)
