"""Sparse depth as log depth, and the residuals of the points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

MASKED = -1e4
"""Logit whose weight in a softmax is 0."""


class Points:
    """The sparse depth of a batch: log depth minus its median, and where it is known.

    Args:
        sparse: (B, 1, H, W) metres, 0 = unknown.
    """

    mask: Tensor
    """(B, 1, H, W), 1 at the points, else 0."""
    median: Tensor
    """Median log depth of each image (B, 1, 1, 1), 0 without any point."""
    value: Tensor
    """Log depth minus the median (B, 1, H, W), 0 beside the points."""
    weight: Tensor
    """Inlier weight of each point (B, 1, H, W), 0 beside them; 1 until `weigh` is called."""

    def __init__(self, sparse: Tensor):
        self.mask = (sparse > 0).to(torch.float32)
        self._image, _, self._row, self._column = torch.nonzero(self.mask, as_tuple=True)
        log_depth = torch.log(torch.where(sparse > 0, sparse, 1.0).to(torch.float32))
        medians = []
        for pixels, is_point in zip(log_depth.flatten(1), self.mask.flatten(1) > 0, strict=True):
            of_points = pixels[is_point]
            medians.append(of_points.median() if of_points.numel() else pixels.new_zeros(()))
        self.median = torch.stack(medians).view(-1, 1, 1, 1)
        self.value = (log_depth - self.median) * self.mask
        self.weight = self.mask

    def weigh(self, weight: Tensor) -> None:
        """Sets the weights of the points to those of a map (B, 1, H, W), 0..1."""
        self.weight = self.mask * weight

    def moments(self) -> Tensor:
        """Returns means over 2 x 2 pixels (B, 4, H / 2, W / 2), with 0 beside the points.

        In order: whether a pixel is a point, its weight, weighted value and weighted squared value.
        They are all that residuals need; finer positions change these by less than half a
        pixel's slope.
        """
        weight = self.at(self.weight)
        value = self.at(self.value)
        return self.pooled([torch.ones_like(weight), weight, weight * value, weight * value**2], 2)

    def at(self, values: Tensor) -> Tensor:
        """Returns a map (B, 1, H, W) at the points (n,), image after image, row after row."""
        return values[self._image, 0, self._row, self._column]

    def positions(self) -> tuple[Tensor, Tensor]:
        """Returns rows and columns (n,) of the points' pixel centres, 0.5 for the first pixel."""
        return self._row + 0.5, self._column + 0.5

    def pooled(self, values: Sequence[Tensor], stride: int) -> Tensor:
        """Returns means over cells (B, k, H / stride, W / stride) of k maps, 0 beside the points.

        Args:
            values: The k maps at the points, (n,) each.
            stride: A cell's side in pixels.
        """
        batch = len(self.mask)
        height = self.mask.shape[-2] // stride
        width = self.mask.shape[-1] // stride
        # The number of each point's cell, image after image, row after row.
        row = self._image * height + self._row // stride
        cell = row * width + self._column // stride
        sums = self.mask.new_zeros(len(values), batch * height * width)
        addends = torch.stack([value / stride**2 for value in values])
        sums = sums.scatter_add(1, cell.expand_as(addends), addends)
        return sums.view(len(values), batch, height, width).transpose(0, 1)


class Residual(NamedTuple):
    """How log depth at the points of each cell differs from a depth map; all (B, 1, h, w)."""

    mean: Tensor
    """Weighted mean of the differences."""
    std: Tensor
    """Their weighted standard deviation."""
    density: Tensor
    """Mean weight over the cell's pixels, those without a point counting 0."""
    reliability: Tensor
    """Log of the mean weight of the cell's points, MASKED without any."""


def residual_of(moments: Tensor, depth: Tensor, stride: int) -> Residual:
    """Returns the residuals of the points against a depth, in each cell of it.

    Args:
        moments: (B, 4, H / 2, W / 2), see `Points.moments`.
        depth: Log depth minus the median (B, 1, H / stride, W / stride).
        stride: Side of a cell in pixels.
    """
    count, density, value, square = moments.chunk(4, dim=1)
    dense = resize(depth, density.shape[-2:]) if stride > 2 else depth
    # Σ w (v − d) and Σ w (v − d)², from Σ w, Σ w v and Σ w v²; then over the cells.
    difference = value - dense * density
    squared = square - dense * (2.0 * value - dense * density)
    sums = F.avg_pool2d(torch.cat([count, density, difference, squared], dim=1), stride // 2)
    count, density, difference, squared = sums.chunk(4, dim=1)
    mean, std = mean_and_std(density, difference, squared)
    weight = torch.log((density / count.clamp(min=1e-6)).clamp(min=1e-6))
    return Residual(mean, std, density, torch.where(count > 0, weight, MASKED))


def mean_and_std(weight: Tensor, value: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean and standard deviation from sums over the same elements, all of one shape.

    Args:
        weight: Sum of the weights.
        value: Sum of weight × value.
        square: Sum of weight × value².
    """
    known = weight.clamp(min=1e-6)
    mean = value / known
    return mean, torch.sqrt((square / known - mean * mean).clamp(min=0.0) + 1e-6)


def resize(x: Tensor, size: torch.Size | tuple[int, int]) -> Tensor:
    """Returns a map (B, c, …) at the size (h, w), interpolated bilinearly."""
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=False)
