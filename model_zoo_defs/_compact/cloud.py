"""The points of a batch and the neighbours of each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from model_zoo_defs._compact.points import Points

# How many of the nearest points send a message to a point.
NEIGHBOURS = 12
# How many points of a cell of the search grid, which holds about one, may be neighbours.
CELL_POINTS = 3
# So many points are searched at a time: bounds the memory.
CHUNK = 4096
# The longer side of the windows in training. A smaller image has the spacing that it would have at
# this size: few pixels between the points are no sign of a dense pattern there.
LEARNT_SIZE = 512
# The colour of a point is the mean of 5 x 5 pixels.
AROUND = torch.arange(-2, 3)
# An image with more points than this, as a depth camera's, is thinned,
DENSE = 40_000
# to one point in each of about so many cells, and one for each other depth in the cell.
CELLS = 20_000
# Points of a cell whose log depths follow each other by less than this have the same depth.
SAME_DEPTH = 0.02


class Cloud(NamedTuple):
    """The points of a batch, one below the other, and the neighbours of each in its image.

    value: log depth minus its median (n,). colour (n, 3): of the normalised image around the point.
    position: rows and columns (n, 2) in spacings, the side of the square that holds one point on
    average. log_spacing (n,): its log, in pixels of an image of LEARNT_SIZE at least. near, found:
    the neighbours' numbers (n, NEIGHBOURS), nearest first, and whether there is one. counts: points
    per image.

    Dense points are thinned (`thinned`). chosen (n,): the numbers of the points that are left among
    the N of the batch. sends (n,): whether they send messages. stand_in (N,): which of them stands
    for each point. of_images: how many of the N points each image has.
    """

    value: Tensor
    colour: Tensor
    position: Tensor
    log_spacing: Tensor
    near: Tensor
    found: Tensor
    counts: tuple[int, ...]
    chosen: Tensor
    sends: Tensor
    stand_in: Tensor
    of_images: tuple[int, ...]

    @classmethod
    def of(cls, points: Points, rgb: Tensor) -> Cloud:
        """The cloud of all points of a batch and its normalised images (B, 3, H, W)."""
        maps = zip(points.mask, points.value, rgb, strict=True)
        return cls.joined(
            [cls.of_image(mask[0] > 0, value[0], image) for mask, value, image in maps]
        )

    @classmethod
    def of_image(cls, mask: Tensor, value: Tensor, rgb: Tensor) -> Cloud:
        """The cloud of the points of one image: mask and value (H, W), rgb (3, H, W)."""
        # The points that stand for all, in units of their spacing, and their neighbours.
        rows, columns = torch.nonzero(mask, as_tuple=True)
        chosen, stand_in, sends = thinned(rows, columns, value[mask], mask.numel())
        rows, columns = rows[chosen], columns[chosen]
        spacing = max(1.0, math.sqrt(mask.numel() / max(1, int(sends.sum()))))
        position = torch.stack([rows, columns], 1).float() / spacing
        near, found = neighbours(position, sends)
        # The colour around each.
        down, right = torch.meshgrid(AROUND, AROUND, indexing="ij")
        y = (rows.unsqueeze(1) + down.flatten().to(rows.device)).clamp(0, rgb.shape[1] - 1)
        x = (columns.unsqueeze(1) + right.flatten().to(rows.device)).clamp(0, rgb.shape[2] - 1)
        colour = rgb.float().flatten(1)[:, y * rgb.shape[2] + x].mean(2).t()
        # A small image has the spacing that it would have at the size in training.
        enlarged = max(1.0, LEARNT_SIZE / max(mask.shape))
        log_spacing = torch.full_like(position[:, 0], math.log(enlarged * spacing))
        return cls(
            value=value[mask][chosen],
            colour=colour,
            position=position,
            log_spacing=log_spacing,
            near=near,
            found=found,
            counts=(len(chosen),),
            chosen=chosen,
            sends=sends,
            stand_in=stand_in,
            of_images=(len(stand_in),),
        )

    @classmethod
    def joined(cls, clouds: Sequence[Cloud]) -> Cloud:
        """One cloud of several."""
        counts = tuple(count for cloud in clouds for count in cloud.counts)
        starts = list(accumulate((len(cloud.value) for cloud in clouds), initial=0))
        points = accumulate((len(cloud.stand_in) for cloud in clouds), initial=0)
        return cls(
            value=torch.cat([cloud.value for cloud in clouds]),
            colour=torch.cat([cloud.colour for cloud in clouds]),
            position=torch.cat([cloud.position for cloud in clouds]),
            log_spacing=torch.cat([cloud.log_spacing for cloud in clouds]),
            near=torch.cat([c.near + start for c, start in zip(clouds, starts, strict=False)]),
            found=torch.cat([cloud.found for cloud in clouds]),
            counts=counts,
            chosen=torch.cat([c.chosen + n for c, n in zip(clouds, points, strict=False)]),
            sends=torch.cat([cloud.sends for cloud in clouds]),
            stand_in=torch.cat([c.stand_in + n for c, n in zip(clouds, starts, strict=False)]),
            of_images=tuple(count for cloud in clouds for count in cloud.of_images),
        )


class Thinned(NamedTuple):
    """Points that stand for all N."""

    chosen: Tensor  # (n,) their numbers
    stand_in: Tensor  # (N,) which of them stands for each
    sends: Tensor  # (n,) whether it sends messages


def thinned(rows: Tensor, columns: Tensor, value: Tensor, pixels: int) -> Thinned:
    """The points that stand for all N.

    Of each cell of a dense pattern the middle point is chosen, wherever its depth lies, so that as
    many of the chosen as of all points are outliers. These send messages. Where points of the cell
    have other depths, as at a jump or an outlier, one of each depth is chosen too. It only receives
    messages.

    Args:
        rows: Of the points (N,).
        columns: Of the points (N,).
        value: Log depth of the points (N,).
        pixels: Of the image.
    """
    if len(rows) <= DENSE:
        all_of_them = torch.arange(len(rows), device=rows.device)
        return Thinned(all_of_them, all_of_them, torch.ones_like(all_of_them, dtype=torch.bool))
    side = math.ceil(math.sqrt(pixels / CELLS))
    cell = rows // side * (int(columns.max()) // side + 1) + columns // side
    # The points cell by cell, in the order of their depths.
    order = torch.argsort(value)
    order = order[torch.argsort(cell[order], stable=True)]
    of_cell, depth = cell[order], value[order]
    new_cell = of_cell.diff(prepend=of_cell[:1] - 1) > 0
    new = new_cell | (depth.diff(prepend=depth[:1]) > SAME_DEPTH)
    group = torch.empty_like(order)
    group[order] = new.cumsum(0) - 1
    # Of each depth of a cell the middle one.
    first = torch.nonzero(new)[:, 0]
    last = torch.cat([first[1:], first.new_tensor([len(order)])])
    of_group = order[(first + last) // 2]
    # Of each cell the middle one in the order of rows, which stands for its depth as well.
    by_cell = torch.argsort(cell, stable=True)
    first = torch.nonzero(new_cell)[:, 0]
    last = torch.cat([first[1:], first.new_tensor([len(order)])])
    sender = by_cell[(first + last) // 2]
    of_group[group[sender]] = sender
    # In the order of the points.
    chosen, rank = of_group.sort()
    number = torch.empty_like(rank)
    number[rank] = torch.arange(len(rank), device=rank.device)
    return Thinned(chosen, number[group], torch.isin(chosen, sender))


def neighbours(position: Tensor, sends: Tensor) -> tuple[Tensor, Tensor]:
    """Numbers (n, NEIGHBOURS) of near points that send, nearest first, and whether there is one.

    A grid of unit cells is searched, 5 x 5 cells around each point and CELL_POINTS of each cell.

    Args:
        position: Rows and columns (n, 2), in units that hold about one point that sends.
        sends: Whether a point may be a neighbour (n,).
    """
    if not len(position):
        nothing = position.new_zeros((0, NEIGHBOURS), dtype=torch.long)
        return nothing, nothing > 0
    cells = position.long() + 2
    down, across = (int(x) + 3 for x in cells.amax(0))
    cell = cells[:, 0] * across + cells[:, 1]
    (senders,) = torch.nonzero(sends, as_tuple=True)
    order = senders[torch.argsort(cell[senders], stable=True)]
    count = torch.bincount(cell[senders], minlength=down * across)
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
        candidate = order[(start[around].unsqueeze(2) + pick).clamp(max=len(order) - 1)].flatten(1)
        square = (position[candidate] - position[own]).square().sum(2)
        square = square.masked_fill(~known | (candidate == own), math.inf)
        square, best = square.topk(NEIGHBOURS, largest=False)
        near.append(candidate.gather(1, best))
        found.append(square < math.inf)
    return torch.cat(near), torch.cat(found)
