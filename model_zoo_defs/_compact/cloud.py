"""The points of a batch and the neighbours of each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple, Self

import torch
from torch import Tensor

from model_zoo_defs._compact.points import Points

NEIGHBOURS = 12
# How many points of a cell of the search grid, which holds about one, may be neighbours.
CELL_POINTS = 3
# So many points are searched at a time: bounds the memory.
CHUNK = 4096


class Cloud(NamedTuple):
    """The points of a batch, one below the other, and the neighbours of each in its image.

    value: log depth minus its median (n,). position: rows and columns (n, 2) in spacings, the side
    of the square that holds one point on average. log_spacing (n,): its log, in pixels. near,
    found: the neighbours' numbers (n, NEIGHBOURS), nearest first, and whether there is one.
    counts: points per image.
    """

    value: Tensor
    position: Tensor
    log_spacing: Tensor
    near: Tensor
    found: Tensor
    counts: tuple[int, ...]

    @classmethod
    def of(cls, points: Points) -> Self:
        """The cloud of all points of a batch."""
        known = points.mask.squeeze(1) > 0
        size = (int(known.shape[1]), int(known.shape[2]))
        clouds = []
        for mask, value in zip(known, points.value.squeeze(1), strict=True):
            rows, columns = torch.nonzero(mask, as_tuple=True)
            clouds.append(cls.of_image(rows.float(), columns.float(), size, value[mask]))
        return cls.joined(clouds)

    @classmethod
    def of_image(cls, rows: Tensor, columns: Tensor, size: tuple[int, int], value: Tensor) -> Self:
        """The cloud of one image's points at these pixels (n,) each; size is (height, width)."""
        spacing = max(1.0, math.sqrt(size[0] * size[1] / max(1, len(rows))))
        position = torch.stack([rows, columns], 1) / spacing
        near, found = neighbours(position)
        log_spacing = torch.full_like(rows, math.log(spacing))
        return cls(value, position, log_spacing, near, found, (len(rows),))

    @classmethod
    def joined(cls, clouds: Sequence[Self]) -> Self:
        """One cloud of several."""
        counts = tuple(count for cloud in clouds for count in cloud.counts)
        starts = accumulate((len(cloud.value) for cloud in clouds), initial=0)
        return cls(
            value=torch.cat([cloud.value for cloud in clouds]),
            position=torch.cat([cloud.position for cloud in clouds]),
            log_spacing=torch.cat([cloud.log_spacing for cloud in clouds]),
            near=torch.cat([c.near + start for c, start in zip(clouds, starts, strict=False)]),
            found=torch.cat([cloud.found for cloud in clouds]),
            counts=counts,
        )


def neighbours(position: Tensor) -> tuple[Tensor, Tensor]:
    """Numbers (n, NEIGHBOURS) of near points, nearest first, and whether there is one.

    A grid of unit cells is searched, 5 x 5 cells around each point and CELL_POINTS of each cell.

    Args:
        position: Rows and columns (n, 2), in units that hold about one point.
    """
    cells = position.long() + 2
    down, across = (int(x) + 3 for x in cells.amax(0)) if len(cells) else (5, 5)
    cell = cells[:, 0] * across + cells[:, 1]
    order = torch.argsort(cell, stable=True)
    count = torch.bincount(cell, minlength=down * across)
    start = count.cumsum(0) - count
    shifts = [i * across + j for i in range(-2, 3) for j in range(-2, 3)]
    shift = torch.tensor(shifts, device=cell.device)
    slot = torch.arange(CELL_POINTS, device=cell.device)
    near, found = [], []
    for first in range(0, len(cell), CHUNK):
        own = torch.arange(first, min(first + CHUNK, len(cell)), device=cell.device).unsqueeze(1)
        around = cell[own] + shift
        # evenly spread over the points of a full cell
        stride = (count[around].unsqueeze(2) / CELL_POINTS).clamp(min=1.0)
        pick = (slot * stride).long()
        known = (pick < count[around].unsqueeze(2)).flatten(1)
        candidate = order[(start[around].unsqueeze(2) + pick).clamp(max=len(cell) - 1)].flatten(1)
        square = (position[candidate] - position[own]).square().sum(2)
        square = square.masked_fill(~known | (candidate == own), math.inf)
        square, best = square.topk(NEIGHBOURS, largest=False)
        near.append(candidate.gather(1, best))
        found.append(square < math.inf)
    if not near:
        nothing = cell.new_zeros((0, NEIGHBOURS))
        return nothing, nothing > 0
    return torch.cat(near), torch.cat(found)
