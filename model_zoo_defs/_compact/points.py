"""Sparse depth as log depth, and the residuals of the points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

MASKED = -1e4


class Points:
    """The sparse depth of a batch: log depth minus its median, and where it is known.

    value, mask, weight: (B, 1, H, W); median: (B, 1, 1, 1), 0 for a sample without any point.
    The weight of a point is 1 until `weigh` is called.
    """

    def __init__(self, sparse: Tensor):
        self.mask = (sparse > 0).to(torch.float32)
        self._image, _, self._row, self._column = torch.nonzero(self.mask, as_tuple=True)
        log_depth = torch.log(torch.where(sparse > 0, sparse, 1.0).to(torch.float32))
        rows = zip(log_depth.flatten(1), self.mask.flatten(1) > 0, strict=True)
        known = (row[seen] for row, seen in rows)
        medians = [row.median() if row.numel() else row.new_zeros(()) for row in known]
        self.median = torch.stack(medians).view(-1, 1, 1, 1)
        self.value = (log_depth - self.median) * self.mask
        self.weight = self.mask

    def weigh(self, weight: Tensor) -> None:
        """Residuals and fits use these weights (B, 1, H, W), 0..1, at the points."""
        self.weight = self.mask * weight

    def moments(self) -> Tensor:
        """Fraction of known pixels, weight, weighted value and square (B, 4, H / 2, W / 2).

        Sums over 2 x 2 pixels are all the residuals need; finer positions change them by less
        than half a pixel's slope.
        """
        weight = self.at(self.weight)
        value = self.at(self.value)
        return self.pooled([torch.ones_like(weight), weight, weight * value, weight * value**2], 2)

    def at(self, values: Tensor) -> Tensor:
        """A map (B, 1, H, W) at the points (n,), image after image, row after row."""
        return values[self._image, 0, self._row, self._column]

    def positions(self) -> tuple[Tensor, Tensor]:
        """Rows and columns (n,) of the points' pixel centres."""
        return self._row + 0.5, self._column + 0.5

    def pooled(self, values: Sequence[Tensor], stride: int) -> Tensor:
        """Means over cells (B, k, H / stride, W / stride) of maps that are 0 beside the points.

        Args:
            values: The k maps at the points, (n,) each.
            stride: A cell's side in pixels.
        """
        count = len(self.mask)
        (height, width) = (n // stride for n in self.mask.shape[-2:])
        row = self._image * height + self._row // stride
        cell = row * width + self._column // stride
        sums = self.mask.new_zeros(len(values), count * height * width)
        of_cell = torch.stack([value / stride**2 for value in values])
        sums = sums.scatter_add(1, cell.expand_as(of_cell), of_cell)
        return sums.view(len(values), count, height, width).transpose(0, 1)


class Residual(NamedTuple):
    """Weighted residuals of the points against a depth, per cell, each (B, 1, h, w).

    std: standard deviation of the residuals; density: weighted fraction of known pixels;
    reliability: log of the mean weight of the cell's points, MASKED where there is none.
    """

    mean: Tensor
    std: Tensor
    density: Tensor
    reliability: Tensor


def residual_of(moments: Tensor, depth: Tensor, stride: int) -> Residual:
    """The residuals of `Points.moments` against `depth`, per cell of `stride` pixels."""
    count, density, value, square = moments.chunk(4, dim=1)
    dense = resize(depth, density.shape[-2:]) if stride > 2 else depth
    difference = value - dense * density
    squared = square - dense * (2.0 * value - dense * density)
    sums = F.avg_pool2d(torch.cat([count, density, difference, squared], dim=1), stride // 2)
    count, density, difference, squared = sums.chunk(4, dim=1)
    mean, std = mean_and_std(density, difference, squared)
    weight = torch.log((density / count.clamp(min=1e-6)).clamp(min=1e-6))
    return Residual(mean, std, density, torch.where(count > 0, weight, MASKED))


def mean_and_std(weight: Tensor, value: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation, from sums of weights, weighted values and weighted squares."""
    known = weight.clamp(min=1e-6)
    mean = value / known
    return mean, torch.sqrt((square / known - mean * mean).clamp(min=0.0) + 1e-6)


def resize(x: Tensor, size: torch.Size | tuple[int, int]) -> Tensor:
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=False)
