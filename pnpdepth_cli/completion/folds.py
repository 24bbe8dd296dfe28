"""Folds of sparse points, to score a method at points that it was not given.

A point that was not given must be as far from the given points as an ordinary pixel is from all
points. Else the score is not that of the image's depth. Points at random pixels are so by
themselves. LiDAR points lie close together along a scan line and far apart across. Each would be
predicted from its neighbour on the line, so a fold has whole scan lines. Of other clustered points
it has whole cells of a grid (blocked cross-validation, Roberts et al. 2017). The cells are as large
as makes the distances agree.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_lines

_GROWTH = 1.5  # of a cell's side from trial to trial
_MAX_SIDE = 0.25  # of a cell, as a fraction of the image's shorter side
_SAMPLED = 2000  # pixels and points whose distances are measured
_SLACK = 1.15  # a cell need not be larger for the last few per cent of distance


def spatial_folds(points: SparsePoints, folds: int, *, seed: int = 0) -> Tensor:
    """Returns (N,) int64, the fold 0 … folds − 1 of each point; folds are about equally large.

    With fewer points than folds every point has a fold of its own. Neighbouring scan lines of a
    LiDAR are in different folds.
    """
    generator = torch.Generator().manual_seed(seed)
    line = scan_lines(points.xy.cpu().numpy(), points.size)
    if line is not None:
        first = torch.randint(folds, (1,), generator=generator)
        return (torch.from_numpy(line) + first) % folds
    target = _distance_of_pixels(points, generator)
    side, best = 0.0, _folds_of_cells(points, 0.0, folds, generator)
    while _distance_held_out(points, best, generator) * _SLACK < target:
        side = side * _GROWTH if side else max(1.0, target)
        if side > _MAX_SIDE * min(points.size):
            break
        best = _folds_of_cells(points, side, folds, generator)
    return best


def _folds_of_cells(
    points: SparsePoints, side: float, folds: int, generator: torch.Generator
) -> Tensor:
    """Folds of whole cells with this side in pixels; 0 has every point in a cell of its own."""
    count = len(points)
    if side:
        cells = torch.floor(points.xy.cpu() / side).long()
        _, cell = torch.unique(cells, dim=0, return_inverse=True)
    else:
        cell = torch.arange(count)
    order = torch.randperm(int(cell.max()) + 1, generator=generator)
    # cells one after the other in random order, cut where a fold is full
    position = torch.empty(count, dtype=torch.long)
    position[order[cell].argsort(stable=True)] = torch.arange(count)
    first = torch.full((len(order),), count).scatter_reduce(0, cell, position, "amin")
    return (first[cell] * folds // count).clamp_max(folds - 1)


def _distance_of_pixels(points: SparsePoints, generator: torch.Generator) -> float:
    """The median distance from pixels to their nearest point.

    The pixels are in the box around the middle 96 % of the points: a LiDAR has no points in the
    sky.
    """
    low, high = (torch.quantile(_some(points.xy.cpu(), generator), q, dim=0) for q in (0.02, 0.98))
    xy = low + (high - low) * torch.rand(_SAMPLED, 2, generator=generator)
    return float(nearest_points(points, xy.double(), 1)[0].median())


def _distance_held_out(points: SparsePoints, fold: Tensor, generator: torch.Generator) -> float:
    """The median distance from points of the first fold to the nearest of another."""
    held = fold == 0
    if bool(held.all()):
        return math.inf
    xy = _some(points.xy[held].cpu(), generator)
    return float(nearest_points(points.select(~held), xy.double(), 1)[0].median())


def _some(xy: Tensor, generator: torch.Generator) -> Tensor:
    """At most `_SAMPLED` of the coordinates."""
    if len(xy) <= _SAMPLED:
        return xy
    return xy[torch.randperm(len(xy), generator=generator)[:_SAMPLED]]
