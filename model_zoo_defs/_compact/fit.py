"""Weighted local planes through the points at 1/16."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._compact.encoder import ENCODER_CHANNELS
from model_zoo_defs._compact.points import MASKED, Points, resize
from model_zoo_defs._compact.prior import Prior

# Planes that are fitted to each cell, with weights of their own.
FIT_HEADS = 4
# Numbers in a key or query of a cell, which say how far a point counts there.
FIT_KEY = 16
# Log distance in cells to the nearest point, where there is none.
FAR = 5.0
# A cell's prior is known if at least this part of the weights is on cells where it is known.
LEAST_SUPPORT = 1e-4
# So many cells are fitted at a time: bounds the memory.
FIT_CHUNK = 1024


def _cell_grid(height: int, width: int, like: Tensor) -> Tensor:
    """Returns row and column of every cell's centre, (2, height, width), in cells.

    On the device of the tensor `like`.
    """
    rows = torch.arange(height, device=like.device, dtype=torch.float32) + 0.5
    columns = torch.arange(width, device=like.device, dtype=torch.float32) + 0.5
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"))


class PriorFit(NamedTuple):
    """Fits of the points' residuals against the prior at 1/16, each (B, heads, h, w)."""

    estimates: Tensor
    """Log depth minus the median: the prior plus the fitted residual."""
    std: Tensor
    """Standard deviation of the residuals near the cell."""
    reliability: Tensor
    """Log of the standard deviation of the points' values over that of their residuals.

    Both are near the cell; it is positive where the prior explains the points.
    """
    valid: Tensor
    """1 where the prior is known, at the cell and at points that count there, else 0."""


class Fit(NamedTuple):
    """Planes through the points at 1/16."""

    estimates: Tensor
    """Log depth minus the median, one for each head, (B, heads, h, w)."""
    distance: Tensor
    """Log distance in cells to the nearest points, (B, 1, h, w)."""
    of_prior: PriorFit | None = None
    """Fit of the residuals against the prior; None without a prior."""


class PointFit(nn.Module):
    """Weighted local planes through the points, one estimate per head, at 1/16.

    The weight of a cell with points is exp(query . key) / distance^(2 p) times the mean weight of
    its points; p, the ridge of the plane's slope (relative to the std of the points) and the
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
        """Returns the values in each cell at 1/16 of local planes through the points.

        With a prior, planes are also fitted to the points' residuals against it.

        Args:
            near: Features of the image at 1/16 (B, c, h, w).
            far: Features of the image at 1/32.
            points: The points, with inlier weights.
            prior: Another network's depth; None without.
        """
        # Queries of all cells, and keys of those that have points in any image of the batch. What
        # the points of a cell say is in `cells`, whether there are any comes last.
        height, width = near.shape[-2:]
        features = F.relu(self.near(near) + resize(self.far(far), (height, width)))
        queries = self._per_head(self.query(features))
        keys = self._per_head(self.key(features))
        cells = self._cells(points, prior)
        has_points = cells[-1].any(0)
        if not bool(has_points.any()):
            return self._without_points(near, prior)
        keys = keys[:, :, has_points]
        cells = [values[..., has_points] for values in cells]
        # Positions about the middle of the image.
        centres = _cell_grid(height, width, near).flatten(1)
        middle = centres.mean(1, keepdim=True)  # small numbers keep the moments exact
        centres = centres - middle
        cells[0] = cells[0] - middle
        # The moments are small differences of large sums, which bfloat16 would leave nothing of.
        with torch.autocast(near.device.type, enabled=False):
            fits_of_chunks = []
            for first in range(0, height * width, FIT_CHUNK):
                chunk = slice(first, first + FIT_CHUNK)
                fits_of_chunks.append(
                    self._fit(queries[:, :, chunk], centres[:, chunk], keys, *cells)
                )
        fits = [torch.cat(chunks, dim=-1) for chunks in zip(*fits_of_chunks, strict=True)]
        maps = [values.reshape(*values.shape[:-1], height, width) for values in fits]
        estimates, distance, *of_prior = maps
        if prior is None:
            return Fit(estimates, distance.unsqueeze(1))
        # The prior is known where its own pixel is, and enough of what its residuals are fitted to.
        residual, std, reliability, support = of_prior
        value, valid = prior.at(16)
        valid = valid * (support > LEAST_SUPPORT)
        fit = PriorFit(value + residual, std, reliability * valid, valid)
        return Fit(estimates, distance.unsqueeze(1), fit)

    @staticmethod
    def _without_points(near: Tensor, prior: Prior | None) -> Fit:
        """Returns the fits of images without points: the prior itself, else 0, which means 1 m.

        The tensor near, (B, c, h, w), has their size.
        """
        zeros = torch.zeros_like(near[:, :FIT_HEADS], dtype=torch.float32)
        distance = zeros[:, :1] + FAR
        if prior is None:
            return Fit(zeros, distance)
        value, valid = prior.at(16)
        return Fit(zeros, distance, PriorFit(value + zeros, zeros + 1.0, zeros, valid + zeros))

    @staticmethod
    def _per_head(x: Tensor) -> Tensor:
        """Returns keys or queries (B, heads · key, h, w) as (B, heads, cells, key), in float32."""
        return x.float().reshape(len(x), FIT_HEADS, FIT_KEY, -1).transpose(2, 3)

    @staticmethod
    def _cells(points: Points, prior: Prior | None) -> list[Tensor]:
        """Returns weighted means over the points of each cell at 1/16, (B, cells) each.

        In order: position in cells (B, 2, cells), value and log weight; with a prior, the residual
        against it and the fraction of points where it is known; last, whether the cell has a point.
        """
        # Sums over the points of each cell.
        weight = points.at(points.weight)
        value = points.at(points.value)
        weighted_positions = [axis / 16.0 * weight.detach() for axis in points.positions()]
        addends = [torch.ones_like(weight), weight, value * weight, *weighted_positions]
        if prior is not None:
            addends += [prior.weight, prior.weight * prior.residual]
        sums = points.pooled(addends, 16)
        count, density, value, at, of_prior = sums.tensor_split((1, 2, 3, 5), 1)
        # Divided by the weights.
        safe = density.clamp(min=1e-6)
        reliability = torch.log((density / count.clamp(min=1e-6)).clamp(min=1e-6))
        cells = [(at / safe.detach()).flatten(2), (value / safe).flatten(1), reliability.flatten(1)]
        if prior is not None:
            both, residual = of_prior.tensor_split(2, 1)
            cells += [(residual / both.clamp(min=1e-6)).flatten(1), (both / safe).flatten(1)]
        return [*cells, (count > 0).flatten(1)]

    def _fit(
        self, queries: Tensor, centres: Tensor, keys: Tensor, at: Tensor, value: Tensor,
        reliability: Tensor, *more: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Returns planes at a chunk of the cells, through the C cells that have points.

        Args:
            queries: Queries of the chunk's cells (B, heads, cells, key).
            centres: Row and column of their centres (2, cells).
            keys: Keys of the cells with points (B, heads, C, key).
            at: Position of their points (B, 2, C), as `centres`.
            value: Value of their points (B, C), log depth minus the median.
            reliability: Log weight of their points (B, C).
            *more: With a prior, residual and known fraction (B, C); then whether a cell of this
                image has points, (B, C) bool.

        Returns:
            Estimates (B, heads, cells) and log distance (B, cells). With a prior also the fit of
            the residuals against it, their standard deviation, the reliability and the fraction of
            the weights on cells where the prior is known, each (B, heads, cells).
        """
        # How much each cell with points counts for each query: near, reliable and alike.
        *of_prior, known = more
        square = torch.cdist(centres.t().expand(at.shape[0], -1, -1), at.transpose(1, 2)).square()
        absent = ~known.unsqueeze(1)
        far = torch.log(square + self.floor.exp()).masked_fill(absent, -MASKED)
        alike = queries @ keys.transpose(2, 3) / FIT_KEY**0.5
        alike = alike + reliability.view(len(at), 1, 1, -1)
        weight = (alike - self.power.exp().view(1, -1, 1, 1) * far.unsqueeze(1)).softmax(-1)
        # The plane through the weighted points, and the distance of the nearest.
        y, x = at.unbind(1)
        products = torch.stack([y, x, value, y * y, x * x, x * y, y * value, x * value], -1)
        nearest = square.masked_fill(absent, 1e6).amin(-1)
        distance = 0.5 * torch.log(nearest + 0.1)
        if not of_prior:
            return self._plane(centres, weight @ products.unsqueeze(1)), distance
        # With a prior also the plane through the residuals against it.
        residual, support_at = of_prior
        products = torch.cat([products, value.square().unsqueeze(-1)], -1)
        more_products = torch.stack(
            [torch.ones_like(y), y, x, residual, y * y, x * x, x * y, y * residual, x * residual,
             residual * residual], -1,
        ) * support_at.unsqueeze(-1)  # fmt: skip
        moments = weight @ torch.cat([products, more_products], -1).unsqueeze(1)
        estimate = self._plane(centres, moments[..., :8])
        support = moments[..., 9]
        rest = moments[..., 10:] / support.unsqueeze(-1).clamp(min=LEAST_SUPPORT)
        shifted = self._plane(centres, rest[..., :8])
        # How much smaller the residuals are than the depths themselves.
        std = torch.sqrt((rest[..., 8] - rest[..., 2].square()).clamp(min=0.0) + 1e-4)
        plain = torch.sqrt((moments[..., 8] - moments[..., 2].square()).clamp(min=0.0) + 1e-4)
        reliability = torch.log(plain / std).clamp(-3.0, 3.0)
        return estimate, distance, shifted, std, reliability, support

    def _plane(self, centres: Tensor, moments: Tensor) -> Tensor:
        """Returns the value (B, heads, cells) at the centres of the plane with these moments.

        The slope is damped by `ridge`.

        Args:
            centres: Row and column of the centres (2, cells).
            moments: Weighted means (B, heads, cells, 8) of y, x, z, yy, xx, xy, yz and xz, where z
                is the value at row y and column x.
        """
        # Covariances about the means of y, x and z.
        my, mx, mz, yy, xx, xy, yz, xz = moments.unbind(-1)
        yy = (yy - my * my).clamp(min=0.0)
        xx = (xx - mx * mx).clamp(min=0.0)
        xy = xy - mx * my
        yz = yz - my * mz
        xz = xz - mx * mz
        damping = self.ridge.exp().view(1, -1, 1) * (yy + xx) + 1e-2
        yy = yy + damping
        xx = xx + damping
        determinant = (yy * xx - xy * xy).clamp(min=1e-4)
        slope_y = (xx * yz - xy * xz) / determinant
        slope_x = (yy * xz - xy * yz) / determinant
        tilt = slope_y * (centres[0] - my) + slope_x * (centres[1] - mx)
        # far outside the points a plane runs away: half a unit of log depth is as far as it may go
        return mz + 0.5 * torch.tanh(tilt / 0.5)
