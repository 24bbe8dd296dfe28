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

    Dense points are thinned (`thinned`): n points are chosen of the N of the batch.
    """

    value: Tensor
    """Log depth minus the median of the image, (n,)."""
    colour: Tensor
    """Colour (n, 3) of the normalised image around each point."""
    position: Tensor
    """Row and column (n, 2) in spacings, the side of the square that holds one point on average."""
    log_spacing: Tensor
    """Log of the spacing (n,), in pixels of an image of LEARNT_SIZE at least."""
    near: Tensor
    """Numbers of the neighbours (n, NEIGHBOURS) among the n points, nearest first."""
    found: Tensor
    """(n, NEIGHBOURS) bool, whether there is such a neighbour."""
    counts: tuple[int, ...]
    """How many of the n points each image has."""
    chosen: Tensor
    """Numbers (n,) of the points among the N of the batch."""
    sends: Tensor
    """(n,) bool, whether a point sends messages."""
    stand_in: Tensor
    """Numbers (N,) of the points among the n that stand for each of the N."""
    of_images: tuple[int, ...]
    """How many of the N points each image has."""

    @classmethod
    def of(cls, points: Points, rgb: Tensor) -> Cloud:
        """Returns the cloud of all points of a batch and its normalised images (B, 3, H, W)."""
        maps = zip(points.mask, points.value, rgb, strict=True)
        return cls.joined(
            [cls.of_image(mask[0] > 0, value[0], image) for mask, value, image in maps]
        )

    @classmethod
    def of_image(cls, mask: Tensor, value: Tensor, rgb: Tensor) -> Cloud:
        """Returns the cloud of the points of one image.

        Args:
            mask: (H, W) bool, where the points are.
            value: Log depth minus the median (H, W).
            rgb: Normalised image (3, H, W).
        """
        # The points that stand for all, in units of their spacing, and their neighbours.
        rows, columns = torch.nonzero(mask, as_tuple=True)
        chosen, stand_in, sends = thinned(rows, columns, value[mask], mask.numel())
        rows = rows[chosen]
        columns = columns[chosen]
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
        """Returns one cloud of several, whose numbers of points count on from cloud to cloud."""
        counts = tuple(count for cloud in clouds for count in cloud.counts)
        # Numbers of each cloud's first point, among all n and among all N.
        starts = list(accumulate((len(cloud.value) for cloud in clouds), initial=0))
        all_starts = list(accumulate((len(cloud.stand_in) for cloud in clouds), initial=0))
        return cls(
            value=torch.cat([cloud.value for cloud in clouds]),
            colour=torch.cat([cloud.colour for cloud in clouds]),
            position=torch.cat([cloud.position for cloud in clouds]),
            log_spacing=torch.cat([cloud.log_spacing for cloud in clouds]),
            near=torch.cat(
                [cloud.near + start for cloud, start in zip(clouds, starts, strict=False)]
            ),
            found=torch.cat([cloud.found for cloud in clouds]),
            counts=counts,
            chosen=torch.cat(
                [cloud.chosen + start for cloud, start in zip(clouds, all_starts, strict=False)]
            ),
            sends=torch.cat([cloud.sends for cloud in clouds]),
            stand_in=torch.cat(
                [cloud.stand_in + start for cloud, start in zip(clouds, starts, strict=False)]
            ),
            of_images=tuple(count for cloud in clouds for count in cloud.of_images),
        )


class Thinned(NamedTuple):
    """n points that stand for all N of an image."""

    chosen: Tensor
    """Their numbers (n,) among the N, in order."""
    stand_in: Tensor
    """Which of the n stands for each of the N, (N,)."""
    sends: Tensor
    """(n,) bool, whether it sends messages."""


def thinned(rows: Tensor, columns: Tensor, value: Tensor, pixels: int) -> Thinned:
    """Returns the points that stand for all N of an image: all of them unless they are dense.

    Of each cell of a dense pattern the middle point is chosen, wherever its depth lies, so that as
    many of the chosen as of all points are outliers. These send messages. Where points of the cell
    have other depths, as at a jump or an outlier, one of each depth is chosen too. It only receives
    messages.

    Args:
        rows: Rows of the points (N,).
        columns: Columns of the points (N,).
        value: Log depth of the points (N,).
        pixels: Number of pixels of the image.
    """
    if len(rows) <= DENSE:
        numbers = torch.arange(len(rows), device=rows.device)
        return Thinned(numbers, numbers, torch.ones_like(numbers, dtype=torch.bool))
    # The number of each point's cell.
    side = math.ceil(math.sqrt(pixels / CELLS))
    cell = rows // side * (int(columns.max()) // side + 1) + columns // side
    # The points cell by cell, in the order of their depths.
    order = torch.argsort(value)
    order = order[torch.argsort(cell[order], stable=True)]
    of_cell = cell[order]
    depth = value[order]
    # A group is points of a cell whose depths follow each other closely.
    begins_cell = of_cell.diff(prepend=of_cell[:1] - 1) > 0
    begins_group = begins_cell | (depth.diff(prepend=depth[:1]) > SAME_DEPTH)
    group = torch.empty_like(order)
    group[order] = begins_group.cumsum(0) - 1
    # Of each group the middle point.
    first = torch.nonzero(begins_group)[:, 0]
    last = torch.cat([first[1:], first.new_tensor([len(order)])])
    of_group = order[(first + last) // 2]
    # Of each cell the middle point in the order of rows, which stands for its group as well.
    by_cell = torch.argsort(cell, stable=True)
    first = torch.nonzero(begins_cell)[:, 0]
    last = torch.cat([first[1:], first.new_tensor([len(order)])])
    sender = by_cell[(first + last) // 2]
    of_group[group[sender]] = sender
    # In the order of the points.
    chosen, rank = of_group.sort()
    number = torch.empty_like(rank)
    number[rank] = torch.arange(len(rank), device=rank.device)
    return Thinned(chosen, number[group], torch.isin(chosen, sender))


def neighbours(position: Tensor, sends: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the numbers (n, NEIGHBOURS) of near points that send, nearest first, and a mask.

    The mask, of the same shape, is true where there is such a neighbour. A grid of unit cells is
    searched, 5 x 5 cells around each point and CELL_POINTS of each cell.

    Args:
        position: Rows and columns (n, 2), in units that hold about one point that sends.
        sends: Whether a point may be a neighbour (n,).
    """
    if not len(position):
        nothing = position.new_zeros((0, NEIGHBOURS), dtype=torch.long)
        return nothing, nothing > 0
    # The number of each point's cell, in a grid with two empty cells at every edge.
    cells = position.long() + 2
    down, across = (int(largest) + 3 for largest in cells.amax(0))
    cell = cells[:, 0] * across + cells[:, 1]
    # The senders cell by cell, where each cell begins, and how many it has.
    (senders,) = torch.nonzero(sends, as_tuple=True)
    order = senders[torch.argsort(cell[senders], stable=True)]
    count = torch.bincount(cell[senders], minlength=down * across)
    start = count.cumsum(0) - count
    # What is added to a cell's number for those around it.
    shifts = [rows * across + columns for rows in range(-2, 3) for columns in range(-2, 3)]
    shift = torch.tensor(shifts, device=cell.device)
    slot = torch.arange(CELL_POINTS, device=cell.device)
    near = []
    found = []
    for first in range(0, len(cell), CHUNK):
        own = torch.arange(first, min(first + CHUNK, len(cell)), device=cell.device).unsqueeze(1)
        around = cell[own] + shift
        # CELL_POINTS of each cell, evenly spread over the points of a full one.
        stride = (count[around].unsqueeze(2) / CELL_POINTS).clamp(min=1.0)
        pick = (slot * stride).long()
        known = (pick < count[around].unsqueeze(2)).flatten(1)
        candidate = order[(start[around].unsqueeze(2) + pick).clamp(max=len(order) - 1)].flatten(1)
        # The nearest of them, but for the point itself.
        square = (position[candidate] - position[own]).square().sum(2)
        square = square.masked_fill(~known | (candidate == own), math.inf)
        square, best = square.topk(NEIGHBOURS, largest=False)
        near.append(candidate.gather(1, best))
        found.append(square < math.inf)
    return torch.cat(near), torch.cat(found)
