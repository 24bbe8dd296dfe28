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

_GROWTH = 1.5  # factor on a cell's side from trial to trial
_MAX_SIDE = 0.25  # of a cell, over the image's shorter side
_SAMPLED = 2000  # pixels and points whose distances are measured
_BOX_FROM = 0.02  # quantile of the points' coordinates from which on pixels are sampled
_BOX_TO = 0.98  # quantile up to which they are
_SLACK = 1.15  # wanted distance over that of a fold, up to which cells need not grow
_MAX_PIXELS_A_POINT = 2.0  # of a depth map, of whose pixels at least half are known
_MAX_ASPECT = 1.5  # longer over shorter side of a map's pixel; scan lines are farther apart
_MIN_SURROUNDED = 0.5  # fraction of a map's known pixels whose four neighbours are known
_MAX_COPIES = 8  # of the holes
_AROUND = np.ones((3, 3), np.bool_)  # a pixel and its eight neighbours: one hole


def spatial_folds(points: SparsePoints, folds: int, *, seed: int = 0) -> Tensor:
    """Returns (N,) int64, the fold 0 … folds − 1 of each point; folds are about equally large.

    A point of one fold is about as far from those of the others as an ordinary pixel is from all
    points. Neighbouring scan lines of a LiDAR are in different folds. With fewer points than folds
    every point has a fold of its own.

    Args:
        points: The N points.
        folds: Number of folds.
        seed: Random seed of the folds.
    """
    generator = torch.Generator().manual_seed(seed)
    # Of a LiDAR, whole scan lines in turn.
    line = scan_lines(points.xy.cpu().numpy(), points.size)
    if line is not None:
        first = torch.randint(folds, (1,), generator=generator)
        return (torch.from_numpy(line) + first) % folds
    # Of other points, cells that grow until the first fold is as far from the others as pixels are
    # from all points. A side of 0 has each point in a cell of its own.
    wanted_px = _distance_of_pixels(points, generator)
    side_px = 0.0
    fold = _folds_of_cells(points, side_px, folds, generator)
    while _distance_held_out(points, fold, generator) * _SLACK < wanted_px:
        side_px = side_px * _GROWTH if side_px else max(1.0, wanted_px)
        # Cells that large would make folds of whole parts of the image; the last ones stay.
        if side_px > _MAX_SIDE * min(points.size):
            break
        fold = _folds_of_cells(points, side_px, folds, generator)
    return fold


def under_holes(points: SparsePoints, folds: int, *, seed: int = 0) -> Tensor | None:
    """Returns (N,) int, which copied hole of a depth map each point lies under; 0 for none.

    Copied holes have the numbers 1, 2, …. The map of what is unknown is moved over the known
    pixels, as a whole and around the image's edges, so that the distances to what stays known are
    those in the holes. Of the last copy only some holes are taken.

    None for points that are no depth map with holes: those of a scanner, at random pixels, or of a
    map without a hole.

    Args:
        points: The N points.
        folds: Number of points for each one that may lie under a copied hole.
        seed: Random seed of the moves.
    """
    from scipy import ndimage

    grid = _PixelGrid.of(points)
    if grid is None:
        return None
    known = np.zeros(grid.shape, np.bool_)
    known[grid.row, grid.column] = True
    # Without a hole there is nothing to copy. Where most pixels have an unknown neighbour, as of
    # random pixels, there are gaps everywhere instead of holes.
    is_surrounded = ndimage.binary_erosion(known)
    if known.all() or is_surrounded.sum() < _MIN_SURROUNDED * known.sum():
        return None
    # Copies of the holes, until enough pixels are under them.
    rng = np.random.default_rng(seed)
    is_under = np.zeros_like(known)
    room = int(known.sum()) // folds  # pixels that may still come under holes
    for _ in range(_MAX_COPIES):
        moved = np.roll(~known, rng.integers(grid.shape), axis=(0, 1))
        copy = _some_holes(moved & known & ~is_under, room, rng)
        is_under |= copy
        room -= int(copy.sum())
    if not is_under.any():  # no copied hole has room among the known pixels
        return None
    label, _ = ndimage.label(is_under, _AROUND)
    return torch.from_numpy(label[grid.row, grid.column])


class _PixelGrid(NamedTuple):
    """The pixels of the depth map that N points are of, whose size can differ from the image's."""

    shape: tuple[int, int]
    """Rows and columns of pixels of the depth map."""
    row: NDArray[np.intp]
    """(N,) row of each point's pixel."""
    column: NDArray[np.intp]
    """(N,) column of each point's pixel."""

    @classmethod
    def of(cls, points: SparsePoints) -> _PixelGrid | None:
        """Returns the pixels of the points; None if they are no depth map, or it is mostly unknown.

        A depth map's rows are about as far apart as its columns, unlike the lines of a scanner.
        """
        x, y = points.xy.cpu().double().numpy().T
        height, width = points.size
        rows = _PixelAxis.of(y, height)
        columns = _PixelAxis.of(x, width)
        if rows is None or columns is None:  # all points are on one line
            return None
        smaller, larger = sorted([rows.spacing, columns.spacing])
        if larger > _MAX_ASPECT * smaller:  # scan lines
            return None
        if rows.pixels * columns.pixels > _MAX_PIXELS_A_POINT * len(points):  # mostly unknown
            return None
        return cls((rows.pixels, columns.pixels), rows.number, columns.number)


class _PixelAxis(NamedTuple):
    """The rows, or the columns, of the pixels of a depth map that N points are of."""

    spacing: float
    """Distance of two neighbouring pixels, in pixels of the image."""
    pixels: int
    """How many rows or columns there are."""
    number: NDArray[np.intp]
    """(N,) number of each point's row or column."""

    @classmethod
    def of(cls, coordinate: NDArray[np.float64], length: int) -> _PixelAxis | None:
        """Returns the rows or columns by the steps between coordinates; None if all are the same.

        Args:
            coordinate: y (N,) of the points for rows, x for columns, in pixels of the image.
            length: Height or width of the image.
        """
        steps = np.diff(np.unique(coordinate))
        if not len(steps):  # all points are on one line
            return None
        # Pixels are areas: the first one reaches from −0.5 to −0.5 + spacing in the image, as
        # `SparsePoints.resized` moves coordinates.
        spacing = float(np.median(steps))
        pixels = max(1, round(length / spacing))
        number = ((coordinate + 0.5) / spacing).astype(np.intp).clip(0, pixels - 1)
        return cls(spacing, pixels, number)


def _some_holes(holes: NDArray[np.bool_], room: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """All of the holes (R, C) if they have room, else whole ones as they fit in random order.

    Args:
        holes: Where holes are, (R, C) bool. Pixels that touch, also by a corner, are one hole.
        room: Number of pixels that holes may have in all.
        rng: Source of the order.
    """
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
    """(N,) int64, the fold of each point, where points of one cell of a grid are in one fold.

    Args:
        points: The N points.
        side: Side of the square cells in pixels; 0: every point is in a cell of its own.
        folds: Number of folds.
        generator: Source of the cells' order.
    """
    count = len(points)
    if side:
        cells = torch.floor(points.xy.cpu() / side).long()
        _, cell = torch.unique(cells, dim=0, return_inverse=True)
    else:
        cell = torch.arange(count)
    # Each point's position in a list that has cell after cell, the cells in random order.
    rank_of_cell = torch.randperm(int(cell.max()) + 1, generator=generator)
    position = torch.empty(count, dtype=torch.long)
    position[rank_of_cell[cell].argsort(stable=True)] = torch.arange(count)
    # The list is cut into folds of equal length; a cell is in the fold of its first point.
    first_position = torch.full_like(rank_of_cell, count).scatter_reduce(0, cell, position, "amin")
    return first_position[cell] * folds // count


def _distance_of_pixels(points: SparsePoints, generator: torch.Generator) -> float:
    """The median distance in pixels from random pixels to their nearest point.

    The pixels are in the box around the middle 96 % of the points: a LiDAR has no points in the
    sky.

    Args:
        points: The points.
        generator: Source of the pixels.
    """
    low = torch.quantile(_sample(points.xy.cpu(), generator), _BOX_FROM, dim=0)
    high = torch.quantile(_sample(points.xy.cpu(), generator), _BOX_TO, dim=0)
    xy = low + (high - low) * torch.rand(_SAMPLED, 2, generator=generator)
    distance, _ = nearest_points(points, xy.double(), 1)
    return float(distance.median())


def _distance_held_out(points: SparsePoints, fold: Tensor, generator: torch.Generator) -> float:
    """The median distance in pixels from points of the first fold to the nearest of another.

    ∞ if all points are in the first fold.

    Args:
        points: The N points.
        fold: Fold (N,) of each point, of which 0 is the first.
        generator: Source of the points whose distance is measured, where they are many.
    """
    held_out = fold == 0
    if bool(held_out.all()):
        return math.inf
    xy = _sample(points.xy[held_out].cpu(), generator)
    distance, _ = nearest_points(points.select(~held_out), xy.double(), 1)
    return float(distance.median())


def _sample(xy: Tensor, generator: torch.Generator) -> Tensor:
    """The coordinates (N, 2), or `_SAMPLED` of them at random if there are more."""
    if len(xy) <= _SAMPLED:
        return xy
    return xy[torch.randperm(len(xy), generator=generator)[:_SAMPLED]]
