"""`compact`, the network that comes with the program: an image and some depths in, dense depth out.

Everything happens in log depth minus the median log depth of the points, so depths ten times
larger give an answer ten times larger. The depth is built from coarse to fine:

1. `InlierWeights` weighs every point by its agreement with the points around it.
2. `PointFit` fits a plane through the points around every 1/16 cell, once per head; the weight of
   a point depends on its distance and on how similar the image features are in the two places.
3. At 1/16, 1/8, 1/4 and 1/2 the residuals at the points (against the depth so far) are averaged
   over cells. The features of the level weigh the residuals of the neighbouring cells and the
   depths of the neighbouring coarser cells.
4. The last step to full size mixes the 3 x 3 neighbours with weights predicted from the features.

A prior, the dense depth of any other network aligned to the points, adds candidates: at 1/16
the prior plus a plane through the points' residuals against it, and at each finer level the
coarser depths plus the change of the prior between the two places. Where the prior is unknown its
candidates are masked, and without a prior none of these layers runs.

A point is evidence, never copied: depth depends smoothly on the features of every level, which
is what refinement moves.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    ModelDefinition,
    Multiple,
    Normalisation,
    RefineDefaults,
)

# (channels in, out, kernel, stride, expansion, blocks) of the stages at 1/2 .. 1/32:
# EfficientNet-Lite0 without its last block and its classifier.
STAGES = {
    "s2": ((32, 16, 3, 1, 1, 1),),
    "s4": ((16, 24, 3, 2, 6, 2),),
    "s8": ((24, 40, 5, 2, 6, 2),),
    "s16": ((40, 80, 3, 2, 6, 3), (80, 112, 5, 1, 6, 3)),
    "s32": ((112, 192, 5, 2, 6, 4),),
}
ENCODER_CHANNELS = {"s2": 16, "s4": 24, "s8": 40, "s16": 112, "s32": 192}
DECODER_CHANNELS = {"s2": 16, "s4": 32, "s8": 64, "s16": 96, "s32": 96}
STRIDES = {"s16": 16, "s8": 8, "s4": 4, "s2": 2}
# The weight of a point as a function of its log odds of being an inlier: steep, because a softmax
# over few candidates follows a doubtful point too far, and 1 for most inliers.
STEEPNESS, SHIFT = 4.0, 2.0
# Up to this expected share of outliers in an image their log odds gain the margin, which falls to
# 0 at twice the share: isolated points of clean images are thin things.
CLEAN_SHARE, CLEAN_MARGIN = 0.03, 7.0
FIT_HEADS = 4
FIT_KEY = 16
FIT_CHUNK = 1024
# of the prior, besides the features: at 1/16 estimates, spreads, reliability, value and validity;
# at the other levels value, validity, and the residual of the points against it with its spread
PRIOR_HINTS = {"s16": 3 * FIT_HEADS + 2, "s8": 4, "s4": 4, "s2": 4}
# Untrained, a prior is followed where the points' residuals against it have a much smaller spread
# than the points: logit = bias + gain * reliability, less for neighbours than for the own cell.
PRIOR_GAIN, PRIOR_BIAS, PRIOR_SIDE = 4.5, -3.0, -2.0
# a prior further than this from the median, in log depth, is clamped
PRIOR_RANGE = 4.0
MASKED = -1e4
# the pretrained features have a standard deviation of about 10
FEATURE_SCALE = 0.1
# The initial weights (as logits) make the untrained network a fair interpolator: follow the depth
# so far, correct it by the residual of the own cell, else of the nearest ones.
KEEP, STAY = 4.0, -2.0
NEIGHBOURS = (-0.5, 0.5, -0.5, 0.5, 2.5, 0.5, -0.5, 0.5, -0.5)


class SamePaddedConv(nn.Conv2d):
    """A convolution padded as TensorFlow's SAME does for even sizes: the odd pixel at the end."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int = 1, groups: int = 1):
        super().__init__(channels, out, kernel, stride, groups=groups)
        before = (kernel - stride) // 2
        self.margins = (before, kernel - stride - before) * 2

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(F.pad(x, self.margins))


class InvertedBottleneck(nn.Module):
    """An MBConv block of EfficientNet-Lite, its batch normalisation folded into the weights."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        hidden = channels * expansion
        self.expand = nn.Conv2d(channels, hidden, 1) if expansion != 1 else None
        self.depthwise = SamePaddedConv(hidden, hidden, kernel, stride, groups=hidden)
        self.project = nn.Conv2d(hidden, out, 1)
        self.residual = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = cast(Tensor, self.project(F.relu6(self.depthwise(y))))
        return x + y if self.residual else y


class Encoder(nn.Module):
    """Image features at 1/2, 1/4, 1/8, 1/16 and 1/32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = SamePaddedConv(3, 32, 3, 2)
        self.stages = nn.ModuleDict(
            {level: nn.Sequential(*self._blocks(rows)) for level, rows in STAGES.items()}
        )

    @staticmethod
    def _blocks(rows: tuple[tuple[int, int, int, int, int, int], ...]) -> list[nn.Module]:
        blocks: list[nn.Module] = []
        for channels, out, kernel, stride, expansion, count in rows:
            blocks.append(InvertedBottleneck(channels, out, kernel, stride, expansion))
            blocks += [InvertedBottleneck(out, out, kernel, 1, expansion) for _ in range(count - 1)]
        return blocks

    def forward(self, rgb: Tensor) -> dict[str, Tensor]:
        x = F.relu6(self.stem(rgb))
        features = {}
        for level, stage in self.stages.items():
            x = stage(x)
            features[level] = x * FEATURE_SCALE
        return features


class Points:
    """The sparse depth of a batch: log depth minus its median, and where it is known.

    value, mask, weight: (B, 1, H, W); median: (B, 1, 1, 1), 0 for a sample without any point.
    The weight of a point is 1 until `weigh` is called.
    """

    def __init__(self, sparse: Tensor):
        self.mask = (sparse > 0).to(torch.float32)
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
        """Share of known pixels, weight, weighted value and square (B, 4, H / 2, W / 2).

        Sums over 2 x 2 pixels are all the residuals need; finer positions change them by less
        than half a pixel's slope.
        """
        weighted = self.weight * self.value
        parts = [self.mask, self.weight, weighted, weighted * self.value]
        return F.avg_pool2d(torch.cat(parts, dim=1), 2)


class Residual(NamedTuple):
    """Weighted residuals of the points against a depth, per cell, each (B, 1, h, w).

    share: of known pixels, weighted; reliability: log of the mean weight of the cell's points,
    MASKED where there is none.
    """

    mean: Tensor
    spread: Tensor
    share: Tensor
    reliability: Tensor


def _residual(moments: Tensor, depth: Tensor, stride: int) -> Residual:
    """The residuals of `Points.moments` against `depth`, per cell of `stride` pixels."""
    count, share, value, square = moments.chunk(4, dim=1)
    dense = _resize(depth, share.shape[-2:]) if stride > 2 else depth
    difference = value - dense * share
    squared = square - dense * (2.0 * value - dense * share)
    sums = F.avg_pool2d(torch.cat([count, share, difference, squared], dim=1), stride // 2)
    count, share, difference, squared = sums.chunk(4, dim=1)
    known = share.clamp(min=1e-6)
    mean = difference / known
    spread = torch.sqrt((squared / known - mean * mean).clamp(min=0.0) + 1e-6)
    weight = torch.log((share / count.clamp(min=1e-6)).clamp(min=1e-6))
    return Residual(mean, spread, share, torch.where(count > 0, weight, MASKED))


class Prior:
    """A dense depth in the units of `Points`, 0 where unknown, and where it is known.

    value, valid: (B, 1, H, W).
    """

    def __init__(self, depth: Tensor, points: Points):
        valid = (depth > 0) & torch.isfinite(depth)
        self.valid = valid.to(torch.float32)
        value = torch.log(torch.where(valid, depth, 1.0).to(torch.float32)) - points.median
        self.value = value.clamp(-PRIOR_RANGE, PRIOR_RANGE) * self.valid
        # residuals of the points against the prior, on the pixels where both are known
        self.weight = points.weight * self.valid
        self.residual = (points.value - self.value) * self.valid * points.mask
        weighted = self.weight * self.residual
        parts = [points.mask * self.valid, self.weight, weighted, weighted * self.residual]
        self.moments = F.avg_pool2d(torch.cat(parts, dim=1), 2)

    def at(self, stride: int) -> tuple[Tensor, Tensor]:
        """Value and validity at the centre pixels of the cells of `stride` pixels."""
        start = stride // 2
        part = (..., slice(start, None, stride), slice(start, None, stride))
        return self.value[part], self.valid[part]

    def hints(self, before: Tensor, stride: int) -> Tensor:
        """Value relative to `before`, validity, residual and spread (B, 4, h, w) of a level."""
        value, valid = self.at(stride)
        sums = F.avg_pool2d(self.moments, stride // 2) if stride > 2 else self.moments
        _, share, mean, square = sums.chunk(4, dim=1)
        known = share.clamp(min=1e-6)
        mean = mean / known
        spread = torch.sqrt((square / known - mean * mean).clamp(min=0.0) + 1e-6)
        return torch.cat([(value - before) * valid, valid, mean, spread], dim=1)


class InlierWeights(nn.Module):
    """A weight 0..1 for every point from its agreement with the points around it.

    The image is divided into cells with about one point each. A point is compared with the means
    of the 5 x 5 cells around it; its own cell is counted without it. With a prior, the residuals
    against the prior are compared in the same way. A second pass compares with means that are
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
        return CLEAN_MARGIN * (1.0 - (outliers / CLEAN_SHARE - 1.0).clamp(0.0, 1.0))

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
        """Of every point (n, STATISTICS): agreement, number and spread of the points around."""
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
            spread = (weight * (means - mean).abs()).sum(1, keepdim=True)
            signed = (weight * torch.tanh(difference / 0.2)).sum(1, keepdim=True)
            agreement = [
                (weight * torch.exp(-difference.abs() / scale)).sum(1, keepdim=True)
                for scale in self.SCALES
            ]
            table += [*agreement, torch.log1p(number), spread.clamp(max=2.0), signed]
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


def _cell_grid(height: int, width: int, like: Tensor) -> Tensor:
    """Row and column of every cell's centre, (2, height, width), in cells."""
    rows = torch.arange(height, device=like.device, dtype=torch.float32) + 0.5
    columns = torch.arange(width, device=like.device, dtype=torch.float32) + 0.5
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"))


class PriorFit(NamedTuple):
    """Fits of the points' residuals against the prior, each (B, heads, h, w).

    estimates: prior plus fitted residual; reliability: log of the spread of the points' values
    over the spread of their residuals, both around the place, positive where the prior explains
    the points.
    """

    estimates: Tensor
    spread: Tensor
    reliability: Tensor
    valid: Tensor


class Fit(NamedTuple):
    """Fits at 1/16: estimates (B, heads, h, w), log distance in cells to the nearest points.

    of_prior: None without a prior.
    """

    estimates: Tensor
    distance: Tensor
    of_prior: PriorFit | None = None


class PointFit(nn.Module):
    """Weighted local planes through the points, one estimate per head, at 1/16.

    The weight of a cell with points is exp(query . key) / distance^(2 p) times the mean weight of
    its points; p, the ridge of the plane's slope (relative to the spread of the points) and the
    projections are learnt. The residuals against a prior are fitted with the same weights.
    """

    def __init__(self) -> None:
        super().__init__()
        self.near = nn.Conv2d(ENCODER_CHANNELS["s16"], 64, 1)
        self.far = nn.Conv2d(ENCODER_CHANNELS["s32"], 64, 1)
        self.query = nn.Conv2d(64, FIT_HEADS * FIT_KEY, 1)
        self.key = nn.Conv2d(64, FIT_HEADS * FIT_KEY, 1)
        self.power = nn.Parameter(torch.tensor([2.0, 3.0, 4.0, 6.0]).log())
        self.ridge = nn.Parameter(torch.tensor([0.05, 0.1, 0.3, 1.0]).log())
        self.floor = nn.Parameter(torch.tensor(0.3).log())

    def forward(self, near: Tensor, far: Tensor, points: Points, prior: Prior | None = None) -> Fit:
        """The fits at 1/16 through the points and, with a prior, through residuals against it."""
        height, width = near.shape[-2:]
        features = F.relu(self.near(near) + _resize(self.far(far), near.shape[-2:]))
        queries = self._per_head(self.query(features))
        keys = self._per_head(self.key(features))
        cells = self._cells(points, prior, height, width)
        seen = cells[-1].any(0)
        if not bool(seen.any()):
            return self._without_points(near, prior)
        keys, cells = keys[:, :, seen], [x[..., seen] for x in cells]
        centres = _cell_grid(height, width, near).flatten(1)
        middle = centres.mean(1, keepdim=True)  # small numbers keep the moments exact
        centres, cells[0] = centres - middle, cells[0] - middle
        # The moments are small differences of large sums, which bfloat16 would leave nothing of.
        with torch.autocast(near.device.type, enabled=False):
            parts = [
                self._fit(queries[:, :, i : i + FIT_CHUNK], centres[:, i : i + FIT_CHUNK], keys,
                          *cells)
                for i in range(0, height * width, FIT_CHUNK)
            ]  # fmt: skip
        rows = (torch.cat(part, dim=-1) for part in zip(*parts, strict=True))
        estimates, distance, *of_prior = (x.reshape(*x.shape[:-1], height, width) for x in rows)
        if prior is None:
            return Fit(estimates, distance.unsqueeze(1))
        residual, spread, reliability, support = of_prior
        value, valid = prior.at(16)
        valid = valid * (support > 1e-4)
        fit = PriorFit(value + residual, spread, reliability * valid, valid)
        return Fit(estimates, distance.unsqueeze(1), fit)

    @staticmethod
    def _without_points(near: Tensor, prior: Prior | None) -> Fit:
        """The prior as it is; 0, the median, without a prior."""
        zeros = torch.zeros_like(near[:, :FIT_HEADS], dtype=torch.float32)
        distance = zeros[:, :1] + 5.0
        if prior is None:
            return Fit(zeros, distance)
        value, valid = prior.at(16)
        return Fit(zeros, distance, PriorFit(value + zeros, zeros + 1.0, zeros, valid + zeros))

    @staticmethod
    def _per_head(x: Tensor) -> Tensor:
        """(B, heads, cells, key) in float32."""
        return x.float().reshape(len(x), FIT_HEADS, FIT_KEY, -1).transpose(2, 3)

    @staticmethod
    def _cells(points: Points, prior: Prior | None, height: int, width: int) -> list[Tensor]:
        """Of the points of each cell, weighted, (B, cells) but for the place (B, 2, cells).

        Place, value, log weight, the same of the residual against the prior where there is one
        (value, share of points where the prior is known), and if there is any point.
        """
        weight = points.weight
        pixel = (_cell_grid(weight.shape[-2], weight.shape[-1], weight) / 16.0).unsqueeze(0)
        maps = [points.mask, weight, points.value * weight, pixel * weight.detach()]
        count, share, value, at = (F.avg_pool2d(x, 16) for x in maps)
        safe = share.clamp(min=1e-6)
        reliability = torch.log((share / count.clamp(min=1e-6)).clamp(min=1e-6))
        cells = [(at / safe.detach()).flatten(2), (value / safe).flatten(1), reliability.flatten(1)]
        if prior is not None:
            maps = [prior.weight, prior.weight * prior.residual]
            both, residual = (F.avg_pool2d(x, 16) for x in maps)
            cells += [(residual / both.clamp(min=1e-6)).flatten(1), (both / safe).flatten(1)]
        return [*cells, (count > 0).flatten(1)]

    def _fit(
        self, queries: Tensor, centres: Tensor, keys: Tensor, at: Tensor, value: Tensor,
        reliability: Tensor, *more: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Estimates (B, heads, cells) and log distance (B, cells) for some of the cells.

        With a prior also the fit of the residuals against it, the spread of the residuals, the
        reliability and the share of the weights on cells where the prior is known, each
        (B, heads, cells).
        """
        *of_prior, known = more
        square = torch.cdist(centres.t().expand(at.shape[0], -1, -1), at.transpose(1, 2)).square()
        absent = ~known.unsqueeze(1)
        far = torch.log(square + self.floor.exp()).masked_fill(absent, -MASKED)
        alike = queries @ keys.transpose(2, 3) / FIT_KEY**0.5
        alike = alike + reliability.view(len(at), 1, 1, -1)
        weight = (alike - self.power.exp().view(1, -1, 1, 1) * far.unsqueeze(1)).softmax(-1)
        y, x = at.unbind(1)
        products = torch.stack([y, x, value, y * y, x * x, x * y, y * value, x * value], -1)
        nearest = square.masked_fill(absent, 1e6).amin(-1)
        distance = 0.5 * torch.log(nearest + 0.1)
        if not of_prior:
            moments = (weight @ products.unsqueeze(1)).unbind(-1)
            return self._plane(centres, *moments), distance
        residual, share = of_prior
        products = torch.cat([products, value.square().unsqueeze(-1)], -1)
        more_products = torch.stack(
            [torch.ones_like(y), y, x, residual, y * y, x * x, x * y, y * residual, x * residual,
             residual * residual], -1,
        ) * share.unsqueeze(-1)  # fmt: skip
        moments = weight @ torch.cat([products, more_products], -1).unsqueeze(1)
        estimate = self._plane(centres, *moments[..., :8].unbind(-1))
        support = moments[..., 9]
        rest = moments[..., 10:] / support.unsqueeze(-1).clamp(min=1e-4)
        shifted = self._plane(centres, *rest[..., :8].unbind(-1))
        spread = torch.sqrt((rest[..., 8] - rest[..., 2].square()).clamp(min=0.0) + 1e-4)
        plain = torch.sqrt((moments[..., 8] - moments[..., 2].square()).clamp(min=0.0) + 1e-4)
        reliability = torch.log(plain / spread).clamp(-3.0, 3.0)
        return estimate, distance, shifted, spread, reliability, support

    def _plane(
        self, centres: Tensor, my: Tensor, mx: Tensor, mz: Tensor, yy: Tensor, xx: Tensor,
        xy: Tensor, yz: Tensor, xz: Tensor,
    ) -> Tensor:  # fmt: skip
        """The plane with these weighted moments at the centres, (B, heads, cells)."""
        yy, xx = (yy - my * my).clamp(min=0.0), (xx - mx * mx).clamp(min=0.0)
        xy, yz, xz = xy - mx * my, yz - my * mz, xz - mx * mz
        damping = self.ridge.exp().view(1, -1, 1) * (yy + xx) + 1e-2
        yy, xx = yy + damping, xx + damping
        determinant = (yy * xx - xy * xy).clamp(min=1e-4)
        slope_y, slope_x = (xx * yz - xy * xz) / determinant, (yy * xz - xy * yz) / determinant
        tilt = slope_y * (centres[0] - my) + slope_x * (centres[1] - mx)
        # far outside the points a plane runs away: half a unit of log depth is as far as it may go
        return mz + 0.5 * torch.tanh(tilt / 0.5)


def _resize(x: Tensor, size: torch.Size | tuple[int, int]) -> Tensor:
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=False)


def _neighbours(x: Tensor) -> Tensor:
    """The 3 x 3 neighbourhood of a map (B, 1, h, w) as channels (B, 9, h, w), edges repeated."""
    height, width = x.shape[-2:]
    padded = F.pad(x, (1, 1, 1, 1), mode="replicate")
    shifts = [(i, j) for i in range(3) for j in range(3)]
    return torch.cat([padded[..., i : i + height, j : j + width] for i, j in shifts], dim=1)


def _bilinear_logits() -> Tensor:
    """Logits (36,) that make a softmax over 3 x 3 neighbours enlarge twofold bilinearly."""
    ends = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.75, 0.25]])  # of the two halves of a cell
    weights = torch.einsum("ai,bj->ijab", ends, ends).reshape(9, 4)
    return weights.clamp(min=1e-3).log().flatten()


class Block(nn.Module):
    """One level's features, (B, out, h, w), from all inputs of the level and hints of a prior."""

    def __init__(self, channels: int, out: int, hints: int = 0):
        super().__init__()
        self.enter = nn.Conv2d(channels, out, 3, padding=1)
        self.first = nn.Conv2d(out, out, 3, padding=1)
        self.second = nn.Conv2d(out, out, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        if hints:
            self.enter_prior = nn.Conv2d(hints, out, 3, padding=1, bias=False)
            nn.init.zeros_(self.enter_prior.weight)

    def forward(self, x: Tensor, hints: Tensor | None = None) -> Tensor:
        x = self.enter(x) if hints is None else self.enter(x) + self.enter_prior(hints)
        x = F.relu(x)
        return F.relu(x + self.second(F.relu(self.first(x))))


class Head(nn.Module):
    """How the features of a level move its depth: weights of candidates, and a remainder."""

    def __init__(self, channels: int, candidates: int):
        super().__init__()
        self.candidates = candidates
        self.weigh = nn.Conv2d(channels, candidates + 1 + 10 + 1, 1)
        nn.init.normal_(self.weigh.weight, std=1e-2)
        bias = torch.zeros(candidates + 12)
        bias[0] = KEEP if candidates == 9 else 0.0
        bias[candidates + 1 : -1] = torch.tensor((STAY, *NEIGHBOURS))
        self.weigh.bias = nn.Parameter(bias)
        self.weigh_prior = nn.Conv2d(channels, candidates, 1)
        nn.init.zeros_(self.weigh_prior.weight)
        side = torch.full((candidates,), PRIOR_SIDE if candidates == 9 else 0.0)
        if candidates == 9:
            side[4] = 0.0
        self.weigh_prior.bias = nn.Parameter(PRIOR_BIAS + side)
        self.gain_prior = nn.Parameter(torch.tensor(PRIOR_GAIN))

    def forward(
        self, features: Tensor, before: Tensor, candidates: Tensor, residual: Residual,
        of_prior: tuple[Tensor, Tensor, Tensor] | None = None,
    ) -> Tensor:  # fmt: skip
        """The depth of the level, (B, 1, h, w): `before` moved towards the weighted candidates.

        candidates (B, n, h, w) are depths; of_prior: as many more from the prior, where they are
        known, and the reliability of the prior.
        """
        weights = self.weigh(features).float()
        follow, correct, rest = weights.tensor_split((self.candidates + 1, self.candidates + 11), 1)
        if of_prior is not None:
            more, valid, reliability = of_prior
            candidates = torch.cat([candidates, more], 1)
            logits = self.weigh_prior(features).float() + self.gain_prior * reliability
            logits = torch.where(valid > 0, logits, MASKED)
            follow = torch.cat([follow, logits], 1)
        moved = (follow.softmax(1)[:, 1:] * (candidates - before)).sum(1, keepdim=True)
        nothing = torch.zeros_like(residual.share)
        reliability = torch.cat([nothing, _neighbours(residual.reliability)], dim=1)
        corrections = torch.cat([nothing, _neighbours(residual.mean)], dim=1)
        corrected = ((correct + reliability).softmax(1) * corrections).sum(1, keepdim=True)
        return cast(Tensor, before + moved + corrected + rest)


class Outputs(NamedTuple):
    """Everything the network computes; training looks at all of it.

    depths: metres at 1/16, 1/8, 1/4, 1/2 and full size; features (B, 16, h, w) and residual of
    the level at 1/2; inlier_logits: (B, 1, H, W), read at the points.
    """

    depths: list[Tensor]
    features: Tensor
    hints: Tensor
    inlier_logits: Tensor


class Compact(nn.Module):
    """Dense depth (B, 1, H, W) in metres from rgb (B, 3, H, W) and sparse (B, 1, H, W) metres.

    H and W are multiples of 32; 0 in `sparse` is unknown. Without any point the answer is
    finite, with median depth taken as 1 m. prior (B, 1, H, W): a dense depth in metres, aligned
    to the points, 0 where unknown.
    """

    def __init__(self) -> None:
        super().__init__()
        width, deep = DECODER_CHANNELS, ENCODER_CHANNELS
        self.encoder = Encoder()
        self.inlier_weights = InlierWeights()
        self.fit = PointFit()
        hints = 4  # depth so far, residual, its spread, share of known pixels
        channels = {
            "s32": deep["s32"],
            "s16": width["s32"] + deep["s16"] + hints + FIT_HEADS + 1,
            "s8": width["s16"] + deep["s8"] + hints + 1,
            "s4": width["s8"] + deep["s4"] + hints,
            "s2": width["s2"] + deep["s2"] + hints + 12,
        }
        self.decoder = nn.ModuleDict(
            {
                level: Block(count, width[level], PRIOR_HINTS.get(level, 0))
                for level, count in channels.items()
            }
        )
        self.narrow = nn.Conv2d(width["s4"], width["s2"], 1)
        self.heads = nn.ModuleDict(
            {
                level: Head(width[level], FIT_HEADS if level == "s16" else 9)
                for level in ("s16", "s8", "s4", "s2")
            }
        )
        self.enlarge = nn.Conv2d(width["s2"], 36, 1)
        nn.init.normal_(self.enlarge.weight, std=1e-2)
        self.enlarge.bias = nn.Parameter(_bilinear_logits())
        # how far the last step follows the change of the prior from 1/2 to full size
        self.enlarge_prior = nn.Conv2d(width["s2"], 4, 1)
        nn.init.zeros_(self.enlarge_prior.weight)
        self.enlarge_prior.bias = nn.Parameter(torch.full((4,), PRIOR_BIAS))
        self.gain_prior = nn.Parameter(torch.tensor(PRIOR_GAIN))
        self.scale = SigmaHead(width["s2"] + hints)

    def forward(self, rgb: Tensor, sparse: Tensor, prior: Tensor | None = None) -> Tensor:
        return self.outputs(rgb, sparse, prior).depths[-1]

    def with_sigma(
        self, rgb: Tensor, sparse: Tensor, prior: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Depth, and the expected absolute error of log depth, both (B, 1, H, W)."""
        outputs = self.outputs(rgb, sparse, prior)
        return outputs.depths[-1], self.sigma(outputs)

    def sigma(self, outputs: Outputs) -> Tensor:
        """The expected absolute error of log depth (B, 1, H, W); no gradient reaches the depth."""
        return cast(Tensor, self.scale(outputs.features.detach(), outputs.hints.detach()))

    def outputs(self, rgb: Tensor, sparse: Tensor, prior: Tensor | None = None) -> Outputs:
        """The depths of all levels and what the other outputs are computed from."""
        points = Points(sparse)
        guide = None if prior is None else Prior(prior, points)
        weights, inlier_logits = self.inlier_weights(points, guide)
        points.weigh(weights)
        guide = None if prior is None else Prior(prior, points)
        moments = points.moments()
        image = self.encoder(rgb)
        fit = self.fit(image["s16"], image["s32"], points, guide)
        features = self.decoder["s32"](image["s32"])
        depth = fit.estimates.mean(1, keepdim=True)
        extra = [fit.estimates - depth, fit.distance]
        depths = []
        for level, stride in STRIDES.items():
            size = image[level].shape[-2:]
            if level == "s16":
                before, candidates = depth, fit.estimates
            else:
                before = _resize(depth, size)
                candidates = F.interpolate(_neighbours(depth), scale_factor=2.0, mode="nearest")
            residual = _residual(moments, before, stride)
            share = torch.log1p(residual.share * stride * stride)
            hints = [before, residual.mean, residual.spread, share]
            parts = [_resize(features, size), image[level], *hints, *extra]
            inputs = [torch.cat([x.to(features.dtype) for x in parts], 1)]
            of_prior = None
            if guide is not None and fit.of_prior is not None:
                hints_of_prior = _prior_hints(guide, fit.of_prior, before, level)
                inputs.append(hints_of_prior.to(features.dtype))
                of_prior = _prior_candidates(guide, fit.of_prior, depth, level)
            features = self.decoder[level](*inputs)
            depth = self.heads[level](features, before, candidates, residual, of_prior)
            depths.append(depth)
            if self.training:  # every level answers for its own step only
                depth = depth.detach()
            extra = [_resize(fit.distance, (size[0] * 2, size[1] * 2))] if level == "s16" else []
            if level == "s4":
                extra, features = [F.pixel_unshuffle(rgb, 2)], self.narrow(features)
        depths.append(self._enlarge(features, depth, guide, fit.of_prior))
        metres = [torch.exp(depth + points.median) for depth in depths]
        return Outputs(metres, features, torch.cat(hints, 1), inlier_logits)

    def _enlarge(
        self, features: Tensor, depth: Tensor, prior: Prior | None, fit: PriorFit | None
    ) -> Tensor:
        """Full size: every pixel a mixture of the 3 x 3 depths at 1/2 around it.

        The change of the prior from the same mixture of its own values is added in part.
        """
        weights = self.enlarge(features).float()
        weights = weights.reshape(len(depth), 9, 4, *depth.shape[-2:]).softmax(1)
        mixed = (weights * _neighbours(depth).unsqueeze(2)).sum(1)
        if prior is not None and fit is not None:
            value, valid = prior.at(2)
            reliability = _resize(fit.reliability.mean(1, keepdim=True), depth.shape[-2:])
            share = self.enlarge_prior(features).float() + self.gain_prior * reliability
            blurred = (weights * _neighbours(value).unsqueeze(2)).sum(1)
            change = F.pixel_unshuffle(prior.value, 2) - blurred
            # a 3 x 3 neighbourhood and a pixel all known
            known = (-F.max_pool2d(-valid, 3, 1, 1)) * F.pixel_unshuffle(prior.valid, 2)
            mixed = mixed + torch.sigmoid(share) * known * change
        return F.pixel_shuffle(mixed, 2)


class SigmaHead(nn.Module):
    """The expected absolute error of log depth at full size, from features at 1/2."""

    def __init__(self, channels: int):
        super().__init__()
        self.enter = nn.Conv2d(channels, 16, 3, padding=1)
        self.leave = nn.Conv2d(16, 1, 1)
        nn.init.zeros_(self.leave.weight)
        self.leave.bias = nn.Parameter(torch.tensor([-3.0]))

    def forward(self, features: Tensor, hints: Tensor) -> Tensor:
        x = torch.cat([features, hints.to(features.dtype)], 1)
        log_scale = self.leave(F.relu(self.enter(x))).float()
        size = (2 * x.shape[-2], 2 * x.shape[-1])
        return torch.exp(_resize(log_scale, size).clamp(-7.0, 2.0))


def _prior_hints(prior: Prior, fit: PriorFit, before: Tensor, level: str) -> Tensor:
    """The prior as a level's features see it, (B, PRIOR_HINTS[level], h, w)."""
    if level != "s16":
        return prior.hints(before, STRIDES[level])
    value, valid = prior.at(16)
    fits = [(fit.estimates - before) * fit.valid, fit.spread * fit.valid, fit.reliability]
    return torch.cat([*fits, (value - before) * valid, valid], 1)


def _prior_candidates(
    prior: Prior, fit: PriorFit, depth: Tensor, level: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Depths that follow the prior, where they are known (B, n, h, w), and its reliability.

    At 1/16 the fits; elsewhere the depths of the coarser neighbours plus the change of the prior
    from there to here.
    """
    if level == "s16":
        return fit.estimates, fit.valid, fit.reliability
    stride = STRIDES[level]
    (value, valid), (coarse, known) = prior.at(stride), prior.at(2 * stride)
    both = torch.cat([_neighbours(depth - coarse), _neighbours(known)], 1)
    offset, known = F.interpolate(both, scale_factor=2.0, mode="nearest").chunk(2, 1)
    reliability = _resize(fit.reliability.mean(1, keepdim=True), value.shape[-2:])
    return value + offset, valid * known, reliability


definitions = {
    "compact": ModelDefinition(
        name="compact",
        summary="the program's own network, trained on rendered scenes only",
        licence="Apache-2.0",
        input_kind="rgb+sparse",
        size=Multiple(32, longest=1280),
        static_graph=True,
        normalisation=Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD),
        output_kind="depth",
        layers=("decoder.s32", "decoder.s16", "decoder.s8", "decoder.s4", "decoder.s2"),
        defaults=RefineDefaults(layer="decoder.s8", lr="3%"),
        build=Compact,
        checkpoint=Path(__file__).parent / "weights" / "compact.safetensors",
    ),
}
