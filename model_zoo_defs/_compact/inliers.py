"""A weight for every point from its agreement with the points around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._compact.points import Points, Prior

# The weight of a point as a function of its log odds of being an inlier: steep, because a softmax
# over few candidates follows a doubtful point too far, and 1 for most inliers.
STEEPNESS, SHIFT = 4.0, 2.0
# Up to this expected fraction of outliers in an image their log odds gain the margin, which falls
# to 0 at twice the fraction: isolated points of clean images lie on thin objects.
CLEAN_FRACTION, CLEAN_MARGIN = 0.03, 7.0


class InlierWeights(nn.Module):
    """A weight 0..1 for every point from its agreement with the points around it.

    The image is divided into cells with about one point each. A point is compared with the means
    of the 5 x 5 cells around it; its own cell is counted without it. With a prior, the residuals
    against the prior are compared likewise. A second pass compares with means that are
    weighted by the result of the first.
    """

    WIDTHS = (1.0, 2.5)
    SCALES = (0.02, 0.06, 0.2)
    # of the point, and their means over all points of the image: how clean these points are
    STATISTICS = 2 * (len(WIDTHS) * (len(SCALES) + 3) + 1)

    def __init__(self) -> None:
        super().__init__()
        self.first = PointScore(self.STATISTICS)
        self.second = PointScore(self.STATISTICS)
        nn.init.constant_(self.first.leave.bias, 4.0)  # weights of exactly 1

    def forward(self, points: Points, prior: Prior | None) -> tuple[Tensor, Tensor]:
        """(weights, logits), both (B, 1, H, W), 1 and 0 away from the points."""
        at, nothing = points.mask > 0, torch.zeros_like(points.mask)
        with torch.autocast(points.mask.device.type, enabled=False):
            log_odds = self.first(*self.statistics(points, prior, points.mask))
            use = nothing.masked_scatter(at, torch.sigmoid(log_odds.detach()))
            log_odds = log_odds + self.second(*self.statistics(points, prior, use))
        logits = nothing.masked_scatter(at, log_odds)
        weights = torch.sigmoid(STEEPNESS * (logits + self._margin(points, logits)) + SHIFT)
        return torch.where(at, weights, 1.0), logits

    @staticmethod
    def _margin(points: Points, logits: Tensor) -> Tensor:
        """Log odds (B, 1, 1, 1) that spare doubtful points of images with hardly any outlier."""
        count = points.mask.sum((1, 2, 3), keepdim=True).clamp(min=1.0)
        outliers = (points.mask * torch.sigmoid(-logits)).sum((1, 2, 3), keepdim=True) / count
        return CLEAN_MARGIN * (1.0 - (outliers / CLEAN_FRACTION - 1.0).clamp(0.0, 1.0))

    def statistics(
        self, points: Points, prior: Prior | None, use: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Statistics (n, STATISTICS) of every point of the batch, and of its prior residual.

        Args:
            points: The sparse depth of the batch.
            prior: Its prior, or None.
            use: Weights (B, 1, H, W) of the points in the means that they are compared with.
        """
        known = points.mask.squeeze(1) > 0
        rows = _each(known, points.value, use, self._statistics)
        if prior is None:
            return rows, None
        of_prior = _each(known, prior.residual, use * prior.valid, self._statistics)
        at = known.unsqueeze(1)
        single = torch.stack([prior.valid[at], prior.residual[at].abs().clamp(max=2.0)], 1)
        return rows, torch.cat([of_prior, single], 1) * prior.valid[at].unsqueeze(1)

    def _statistics(self, rows: Tensor, columns: Tensor, value: Tensor, use: Tensor,
                    size: tuple[int, int]) -> Tensor:  # fmt: skip
        """Agreement with, number and deviation of the points around each point (n, STATISTICS)."""
        step = max(1.0, (size[0] * size[1] / max(1, len(rows))) ** 0.5)
        across = int(size[1] / step) + 5  # a margin of two empty cells
        down = int(size[0] / step) + 5
        row, column = (rows / step).long() + 2, (columns / step).long() + 2
        cell = row * across + column
        length = down * across
        count = torch.bincount(cell, use, length)
        total = torch.bincount(cell, use * value, length)
        shifts = [(i, j) for i in range(-2, 3) for j in range(-2, 3)]
        offset = torch.tensor([i * across + j for i, j in shifts], device=cell.device)
        around = cell.unsqueeze(1) + offset
        own = (offset == 0) * use.unsqueeze(1)
        counts = count[around] - own
        means = (total[around] - own * value.unsqueeze(1)) / counts.clamp(min=0.5)
        occupied = (counts > 0.5).float()
        # distance between cells, from the point to the middle of the other cell
        rest_row, rest_column = rows / step - row + 1.5, columns / step - column + 1.5
        shift = torch.tensor(shifts, device=cell.device, dtype=torch.float32)
        square = (shift[:, 0] - rest_row.unsqueeze(1)).square()
        square = square + (shift[:, 1] - rest_column.unsqueeze(1)).square()
        difference = (means - value.unsqueeze(1)) * occupied
        nearest = torch.where(occupied > 0, difference.abs(), 2.0).amin(1, keepdim=True)
        table = [nearest.clamp(max=2.0)]
        for width in self.WIDTHS:
            weight = occupied * torch.exp(-square / width**2)
            number = weight.sum(1, keepdim=True)
            weight = weight / (number + 0.05)
            mean = (weight * means).sum(1, keepdim=True)
            deviation = (weight * (means - mean).abs()).sum(1, keepdim=True)
            signed = (weight * torch.tanh(difference / 0.2)).sum(1, keepdim=True)
            agreement = [
                (weight * torch.exp(-difference.abs() / scale)).sum(1, keepdim=True)
                for scale in self.SCALES
            ]
            table += [*agreement, torch.log1p(number), deviation.clamp(max=2.0), signed]
        each = torch.cat(table, 1)
        return torch.cat([each, each.mean(0, keepdim=True).expand_as(each)], 1)


class ExactLinear(nn.Linear):
    """A linear layer that stays in float32 at any precision: only plain `nn.Linear` is cast."""


class PointScore(nn.Module):
    """Log odds (n,) from the statistics of n points and of their residuals against a prior."""

    def __init__(self, statistics: int):
        super().__init__()
        self.enter = ExactLinear(statistics, 24)
        self.enter_prior = ExactLinear(statistics + 2, 24, bias=False)
        self.leave = ExactLinear(24, 1)
        for layer in (self.enter_prior, self.leave):
            nn.init.zeros_(layer.weight)
        nn.init.constant_(self.leave.bias, 0.0)

    def forward(self, rows: Tensor, of_prior: Tensor | None) -> Tensor:
        hidden = self.enter(rows)
        if of_prior is not None:
            hidden = hidden + self.enter_prior(of_prior)
        return cast(Tensor, self.leave(F.relu(hidden)).squeeze(1))


def _each(
    known: Tensor, value: Tensor, use: Tensor,
    statistics: Callable[[Tensor, Tensor, Tensor, Tensor, tuple[int, int]], Tensor],
) -> Tensor:  # fmt: skip
    """The statistics of the points of every sample, one below the other, in the order of `known`.

    known: (B, H, W); value, use: (B, 1, H, W).
    """
    table = []
    for mask, values, uses in zip(known, value, use, strict=True):
        rows, columns = torch.nonzero(mask, as_tuple=True)
        size = (int(mask.shape[0]), int(mask.shape[1]))
        points = (rows.float(), columns.float(), values[0][rows, columns], uses[0][rows, columns])
        table.append(statistics(*points, size))
    return torch.cat(table)
