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
    target = _distance_of_pixels(points, generator)
    side, best = 0.0, _folds_of_cells(points, 0.0, folds, generator)
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
        copy = np.roll(~known, rng.integers(grid.shape), axis=(0, 1)) & known & ~hidden
        copy = _some_holes(copy, room, rng)
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
        shape = list[int]()
        spacings = list[float]()
        index = list[NDArray[np.intp]]()
        for at, length in zip(points.xy.cpu().double().numpy().T[::-1], points.size, strict=True):
            steps = np.diff(np.unique(at))
            if not len(steps):
                return None
            # Areas of pixels scale with the image, as `SparsePoints.resized` moves them.
            spacing = float(np.median(steps))
            spacings.append(spacing)
            shape.append(max(1, round(length / spacing)))
            index.append(((at + 0.5) / spacing).astype(np.intp).clip(0, shape[-1] - 1))
        if max(spacings) > _SQUARE * min(spacings) or shape[0] * shape[1] > _CELLS * len(points):
            return None
        return cls((shape[0], shape[1]), *index)


def _some_holes(holes: NDArray[np.bool_], room: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """The holes (R, C), or so many whole ones in random order that they have room, in pixels."""
    from scipy import ndimage

    if holes.sum() <= room:
        return holes
    label, count = ndimage.label(holes, _AROUND)
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    taken = np.zeros(count + 1, np.bool_)
    for number in 1 + rng.permutation(count):
        if sizes[number] <= room:
            taken[number] = True
            room -= sizes[number]
    chosen: NDArray[np.bool_] = taken[label]
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
