"""Sparse points shared out into folds, so that a method can be scored on points it did not see.

A held-out point must be as far from the points that are kept as an ordinary pixel is from the
points there are, or the score is of something else than the picture's depth. Points strewn at
random have that by themselves. Those of a LiDAR stand close together along its lines and far apart
across them; held out one by one, each would be told by its neighbour. There whole cells of a grid
are held out (blocked cross-validation, Roberts et al. 2017), as large as makes the distances agree.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.points import SparsePoints

_GROWTH = 1.5
_LARGEST = 0.25  # a cell's side, of the picture's shorter one
_ASKED = 2000  # pixels and points whose distances are looked at
_SLACK = 1.15  # a cell need not be larger for the last few per cent of distance


def spatial_folds(points: SparsePoints, folds: int, *, seed: int = 0) -> Tensor:
    """(N,) int64: the fold 0 … folds − 1 of each point, the folds about equally large.

    With fewer points than folds every point has a fold of its own.
    """
    generator = torch.Generator().manual_seed(seed)
    wanted = _distance_of_pixels(points, generator)
    side, best = 0.0, _folds_of_cells(points, 0.0, folds, generator)
    while _distance_held_out(points, best, generator) * _SLACK < wanted:
        side = side * _GROWTH if side else max(1.0, wanted)
        if side > _LARGEST * min(points.size):
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
    # cells one after the other in random order, cut where a fold has its share of the points
    place = torch.empty(count, dtype=torch.long)
    place[order[cell].argsort(stable=True)] = torch.arange(count)
    first = torch.full((len(order),), count).scatter_reduce(0, cell, place, "amin")
    return (first[cell] * folds // count).clamp_max(folds - 1)


def _distance_of_pixels(points: SparsePoints, generator: torch.Generator) -> float:
    """The median distance to the nearest point, of pixels where the points are.

    A LiDAR sees no sky; there no distance is asked for. Those are pixels of the box around the
    middle 96 per cent of the points.
    """
    low, high = (torch.quantile(_some(points.xy.cpu(), generator), q, dim=0) for q in (0.02, 0.98))
    places = low + (high - low) * torch.rand(_ASKED, 2, generator=generator)
    return float(nearest_points(points, places.double(), 1)[0].median())


def _distance_held_out(points: SparsePoints, fold: Tensor, generator: torch.Generator) -> float:
    """The median distance from points of the first fold to the nearest of another."""
    held = fold == 0
    if bool(held.all()):
        return math.inf
    places = _some(points.xy[held].cpu(), generator)
    return float(nearest_points(points.select(~held), places.double(), 1)[0].median())


def _some(xy: Tensor, generator: torch.Generator) -> Tensor:
    """At most so many of the places as are looked at."""
    return xy if len(xy) <= _ASKED else xy[torch.randperm(len(xy), generator=generator)[:_ASKED]]
