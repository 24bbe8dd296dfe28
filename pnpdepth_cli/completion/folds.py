"""Folds of sparse points, to score a method at points that it was not given.

A point that was not given must be as far from the given points as an ordinary pixel is from all
points. Else the score is not that of the image's depth. Points at random pixels are so by
themselves. LiDAR points lie close together along a scan line and far apart across. Each would be
predicted from its neighbour on the line, so a fold has whole scan lines. Of other clustered points
it has whole cells of a grid (blocked cross-validation, Roberts et al. 2017). The cells are as large
as makes the distances agree.

Of a depth map, depth is asked for in its holes. A pixel beside known ones is not as far from them,
so `under_holes` lays copies of the holes over the known pixels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_lines

_GROWTH = 1.5  # of a cell's side from trial to trial
_MAX_SIDE = 0.25  # of a cell, as a fraction of the image's shorter side
_SAMPLED = 2000  # pixels and points whose distances are measured
_BOX_FROM = 0.02  # quantiles of the points' coordinates, between which pixels are sampled
_BOX_TO = 0.98
_SLACK = 1.15  # a cell need not be larger for the last few per cent of distance
_CELLS = 2.0  # a point, at most, of a depth map: of its pixels at least half are known
_SQUARE = 1.5  # height of a map's pixel over its width, at most; lines are farther apart
_SURROUNDED = 0.5  # of its points, at least, whose four neighbours are known
_COPIES = 8  # of the holes, at most
_AROUND = np.ones((3, 3), np.bool_)  # a pixel and its eight neighbours: one hole


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
    # Cells grow until held-out points are as far from the others as pixels are from all.
    target = _distance_of_pixels(points, generator)
    side = 0.0
    best = _folds_of_cells(points, side, folds, generator)
    while _distance_held_out(points, best, generator) * _SLACK < target:
        side = side * _GROWTH if side else max(1.0, target)
        if side > _MAX_SIDE * min(points.size):
            break
        best = _folds_of_cells(points, side, folds, generator)
    return best


def under_holes(points: SparsePoints, folds: int, *, seed: int = 0) -> Tensor | None:
    """Returns (N,) the number of the copied hole that a point of a depth map is under, 0 for none.

    One of `folds` of the points is under one, at most.

    The map of what is unknown is moved over the known pixels, as a whole and around the image's
    edges, so that the distances to what stays known are those in the holes. Of the last copy only
    some holes are taken.

    Returns None for points that are no depth map with holes: those of a scanner, at random pixels,
    or of a map without a hole.
    """
    from scipy import ndimage

    grid = _PixelGrid.of(points)
    if grid is None:
        return None
    known = np.zeros(grid.shape, np.bool_)
    known[grid.row, grid.column] = True
    surrounded = ndimage.binary_erosion(known)
    if known.all() or surrounded.sum() < _SURROUNDED * known.sum():
        return None
    # Copies of the holes, until so many points are under them.
    rng = np.random.default_rng(seed)
    hidden = np.zeros_like(known)
    room = int(known.sum()) // folds
    for _ in range(_COPIES):
        moved = np.roll(~known, rng.integers(grid.shape), axis=(0, 1))
        copy = _some_holes(moved & known & ~hidden, room, rng)
        hidden |= copy
        room -= int(copy.sum())
    if not hidden.any():
        return None
    label, _ = ndimage.label(hidden, _AROUND)
    return torch.from_numpy(label[grid.row, grid.column])


class _PixelGrid(NamedTuple):
    """The pixels of the depth map that points are of, whose size can differ from the image's."""

    shape: tuple[int, int]
    row: NDArray[np.intp]
    """(N,) of each point."""
    column: NDArray[np.intp]
    """(N,) of each point."""

    @classmethod
    def of(cls, points: SparsePoints) -> _PixelGrid | None:
        """Returns the grid of points; None if they are no depth map, or most of it is unknown."""
        x, y = points.xy.cpu().double().numpy().T
        height, width = points.size
        rows = _PixelAxis.of(y, height)
        columns = _PixelAxis.of(x, width)
        if rows is None or columns is None:
            return None
        spacings = sorted([rows.spacing, columns.spacing])
        if spacings[1] > _SQUARE * spacings[0]:
            return None
        if rows.pixels * columns.pixels > _CELLS * len(points):
            return None
        return cls((rows.pixels, columns.pixels), rows.number, columns.number)


class _PixelAxis(NamedTuple):
    """The rows or the columns of pixels that points are of."""

    spacing: float  # of two pixels, in pixels of the image
    pixels: int  # how many there are along the axis
    number: NDArray[np.intp]  # (N,) of each point's pixel

    @classmethod
    def of(cls, coordinate: NDArray[np.float64], length: int) -> _PixelAxis | None:
        """Returns the axis for the points' coordinate (N,) in an image of this length, or None."""
        steps = np.diff(np.unique(coordinate))
        if not len(steps):  # all points are on one line
            return None
        # Areas of pixels scale with the image, as `SparsePoints.resized` moves them.
        spacing = float(np.median(steps))
        pixels = max(1, round(length / spacing))
        number = ((coordinate + 0.5) / spacing).astype(np.intp).clip(0, pixels - 1)
        return cls(spacing, pixels, number)


def _some_holes(holes: NDArray[np.bool_], room: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """The holes (R, C), or so many whole ones in random order that they have room, in pixels."""
    from scipy import ndimage

    if holes.sum() <= room:
        return holes
    label, count = ndimage.label(holes, _AROUND)
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    is_chosen = np.zeros(count + 1, np.bool_)  # by label, of which 0 is no hole
    for number in 1 + rng.permutation(count):
        if sizes[number] <= room:
            is_chosen[number] = True
            room -= sizes[number]
    chosen: NDArray[np.bool_] = is_chosen[label]
    return chosen


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
    # The points' positions in a list that has cell after cell, the cells in random order.
    order = torch.randperm(int(cell.max()) + 1, generator=generator)
    position = torch.empty(count, dtype=torch.long)
    position[order[cell].argsort(stable=True)] = torch.arange(count)
    # The list is cut where a fold is full; a cell is in the fold of its first point.
    first = torch.full((len(order),), count).scatter_reduce(0, cell, position, "amin")
    return (first[cell] * folds // count).clamp_max(folds - 1)


def _distance_of_pixels(points: SparsePoints, generator: torch.Generator) -> float:
    """The median distance from pixels to their nearest point.

    The pixels are in the box around the middle 96 % of the points: a LiDAR has no points in the
    sky.
    """
    low = torch.quantile(_sample(points.xy.cpu(), generator), _BOX_FROM, dim=0)
    high = torch.quantile(_sample(points.xy.cpu(), generator), _BOX_TO, dim=0)
    xy = low + (high - low) * torch.rand(_SAMPLED, 2, generator=generator)
    return float(nearest_points(points, xy.double(), 1)[0].median())


def _distance_held_out(points: SparsePoints, fold: Tensor, generator: torch.Generator) -> float:
    """The median distance from points of the first fold to the nearest of another."""
    held_out = fold == 0
    if bool(held_out.all()):
        return math.inf
    xy = _sample(points.xy[held_out].cpu(), generator)
    return float(nearest_points(points.select(~held_out), xy.double(), 1)[0].median())


def _sample(xy: Tensor, generator: torch.Generator) -> Tensor:
    """At most `_SAMPLED` of the coordinates."""
    if len(xy) <= _SAMPLED:
        return xy
    return xy[torch.randperm(len(xy), generator=generator)[:_SAMPLED]]
