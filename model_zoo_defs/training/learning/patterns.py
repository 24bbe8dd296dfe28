"""Sparse depth with the patterns and errors of real sensors, drawn from dense depth.

`draw` picks one pattern at random, thins it with holes, and adds noise, outliers and a small shift
between depth and image. All maps are (H, W) float32 metres with
0 = unknown; the same generator state gives the same points.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]

PATTERNS = ("uniform", "scan lines", "grid", "corners", "window", "zones")
PATTERN_PROBABILITIES = (0.45, 0.25, 0.06, 0.1, 0.05, 0.09)


def draw(rng: Generator, depth: Depth, grey: Depth) -> Depth:
    """Returns points of one random pattern with random faults.

    Args:
        rng: Random numbers.
        depth: Dense depth.
        grey: The image (H, W) 0..1.
    """
    kind = PATTERNS[rng.choice(len(PATTERNS), p=PATTERN_PROBABILITIES)]
    if kind == "scan lines":
        sparse = scan_lines(rng, depth)
    elif kind == "zones":
        sparse = zones(rng, depth)
    else:
        count = int(np.exp(rng.uniform(np.log(5.0), np.log(depth.size / 8))))
        if kind == "window":
            sparse = keep(depth, window(rng, depth.shape) & uniform(rng, depth, 4 * count))
        elif kind == "corners":
            sparse = triangulated(rng, keep(depth, corners(rng, depth, grey, count)))
        elif kind == "grid":
            sparse = keep(depth, jittered_grid(rng, depth, count))
        else:
            sparse = keep(depth, uniform(rng, depth, count))
    # Holes.
    if rng.random() < 0.25:
        empty = window if rng.random() < 0.6 else strip
        sparse = keep(sparse, ~empty(rng, depth.shape))
    return faults(rng, sparse)


def strip(rng: Generator, shape: tuple[int, ...]) -> Mask:
    """Returns a mask of the image on one side of a random line: 0.1 to 0.7 of its pixels."""
    height, width = shape
    angle = rng.uniform(0.0, 2.0 * np.pi)
    rows, columns = np.indices(shape, dtype=np.float32)
    position = np.cos(angle) * rows / height + np.sin(angle) * columns / width
    return np.asarray(position < np.quantile(position[::4, ::4], rng.uniform(0.1, 0.7)))


def triangulated(rng: Generator, sparse: Depth) -> Depth:
    """Returns the points with errors of triangulation, which grow with depth, and outliers."""
    known = sparse > 0
    if not known.any():
        return sparse
    relative = sparse / np.float32(np.median(sparse[known]))
    sigma = np.float32(rng.uniform(0.0, 0.03)) * relative
    inverse = 1.0 + sigma * rng.standard_normal(sparse.shape, dtype=np.float32)
    outlier = rng.random(sparse.shape) < rng.uniform(0.01, 0.05)
    factor = np.exp(rng.normal(0.0, 0.6, sparse.shape)).astype(np.float32)
    inverse = np.where(outlier, factor, np.maximum(inverse, 0.2))
    return np.where(known, sparse / inverse, np.float32(0.0)).astype(np.float32)


def zones(rng: Generator, depth: Depth) -> Depth:
    """Returns points of a time-of-flight sensor: a depth per zone, holes, mixed edges."""
    # The middle pixel of each zone, and a pixel beside it.
    row_count, column_count = (int(count) for count in rng.integers(6, 33, 2))
    height, width = depth.shape
    rows = ((np.arange(row_count) + 0.5) * height / row_count).astype(int)
    columns = ((np.arange(column_count) + 0.5) * width / column_count).astype(int)
    at = np.ix_(rows, columns)
    zone_side = min(height // row_count, width // column_count)
    reach = np.minimum(int(rng.integers(1, 5)), zone_side // 2 + 1)
    aside = np.ix_(np.clip(rows + reach, 0, height - 1), np.clip(columns + reach, 0, width - 1))
    value = depth[at]
    second = depth[aside]
    # At edges a zone gives a mean of both.
    mixed = (rng.random(value.shape) < rng.uniform(0.0, 0.5)) & (second > 0)
    fraction = rng.random(value.shape, dtype=np.float32)
    value = np.where(mixed & (value > 0), fraction * value + (1.0 - fraction) * second, value)
    # Zones without an answer, by chance or beyond a range.
    returned = rng.random(value.shape) >= rng.uniform(0.0, 0.3)
    if rng.random() < 0.5:
        known = value[value > 0]
        limit = np.quantile(known, rng.uniform(0.5, 1.0)) if known.size else 0.0
        returned &= value <= limit
    sparse = np.zeros_like(depth)
    sparse[at] = np.where(returned, value, np.float32(0.0))
    return sparse


def keep(depth: Depth, mask: Mask) -> Depth:
    """Returns the depth where the mask is true, 0 elsewhere."""
    return np.where(mask, depth, np.float32(0.0))


def uniform(rng: Generator, depth: Depth, count: int) -> Mask:
    """Returns a mask of `count` known pixels, each as likely as any other; or of all."""
    known = np.flatnonzero(depth)
    mask = np.zeros(depth.size, dtype=bool)
    mask[rng.choice(known, size=min(count, known.size), replace=False)] = True
    return mask.reshape(depth.shape)


def jittered_grid(rng: Generator, depth: Depth, count: int) -> Mask:
    """Returns a mask of about `count` pixels on a grid, each moved by at most a part of a step."""
    height, width = depth.shape
    step = max(1.0, (depth.size / count) ** 0.5)
    jitter = rng.choice((0.0, rng.uniform(0.0, 1.0)))
    rows, columns = np.meshgrid(
        np.arange(rng.uniform(0.0, step), height, step),
        np.arange(rng.uniform(0.0, step), width, step),
        indexing="ij",
    )
    rows = rows + jitter * step * rng.uniform(-0.5, 0.5, rows.shape)
    columns = columns + jitter * step * rng.uniform(-0.5, 0.5, rows.shape)
    return _mask_at(depth.shape, rows, columns)


def corners(rng: Generator, depth: Depth, grey: Depth, count: int) -> Mask:
    """Returns a mask of `count` known pixels where the image `grey` (H, W) has much gradient."""
    dy, dx = np.gradient(grey)
    strength = np.hypot(dy, dx).ravel() + 1e-4
    # Drawn with weights strength^p: the largest keys of Efraimidis and Spirakis' reservoir.
    keys = np.log(rng.random(depth.size)) / (strength ** rng.uniform(0.7, 2.0))
    keys[depth.ravel() == 0] = -np.inf
    count = min(count, int(np.count_nonzero(depth)))
    mask = np.zeros(depth.size, dtype=bool)
    if count:
        mask[np.argpartition(keys, -count)[-count:]] = True
    return mask.reshape(depth.shape)


def window(rng: Generator, shape: tuple[int, ...]) -> Mask:
    """Returns a mask of a random rectangle or ellipse, of 10 to 80 per cent of the sides."""
    height, width = shape
    half = rng.uniform(0.05, 0.4, 2) * (height, width)
    centre = rng.uniform(0.1, 0.9, 2) * (height, width)
    rows = (np.arange(height)[:, None] - centre[0]) / half[0]
    columns = (np.arange(width)[None, :] - centre[1]) / half[1]
    if rng.random() < 0.5:
        return np.asarray(np.maximum(np.abs(rows), np.abs(columns)) < 1.0)
    return np.asarray(rows * rows + columns * columns < 1.0)


def scan_lines(rng: Generator, depth: Depth) -> Depth:
    """Returns points of a spinning LiDAR: slightly bowed lines, dense along them, none at the top.

    Some points lie behind the surface the camera sees at their pixel, because of the parallax
    between scanner and camera (`leak`).
    """
    height, width = depth.shape
    # Pixels from line to line.
    spacing = float(np.exp(rng.uniform(np.log(1.5), np.log(height / 4))))
    # Pixels along a line: single scanners are dense, also when their lines are far apart.
    stride = rng.uniform(1.0, 3.5)
    top = rng.uniform(0.0, 0.45) * height if rng.random() < 0.8 else 0.0
    lines = np.arange(top, height, spacing)
    across = np.arange(rng.uniform(0.0, stride), width, stride)
    bow = rng.uniform(-0.04, 0.04) * height
    tilt = rng.uniform(-0.03, 0.03) * height
    position = across / width * 2.0 - 1.0
    rows = lines[:, None] + (bow * position**2 + tilt * position)[None, :]
    # Points off their line, and some that do not return.
    rows = rows + rng.normal(0.0, 0.3, rows.shape)
    columns = across[None, :] + rng.uniform(-0.4, 0.4, rows.shape)
    returned = rng.random(rows.shape) >= rng.uniform(0.0, 0.4)
    mask = _mask_at(depth.shape, rows[returned], columns[returned])
    source = leak(rng, depth) if rng.random() < 0.7 else depth
    return keep(source, mask)


def leak(rng: Generator, depth: Depth) -> Depth:
    """Returns the depth map with the background's depth at some pixels beside depth edges.

    The background is visible past an edge k pixels away when the parallax between the two depths,
    focal x baseline x (1/near − 1/far), is more than k pixels.
    """
    known = depth[depth > 0]
    if not known.size:
        return depth
    height, width = depth.shape
    # For each pixel another one, some pixels away in about one direction.
    reach = rng.integers(1, 9, depth.shape)
    turn = rng.choice((-1.0, 1.0)) * rng.uniform(0.0, 0.5) + rng.choice(
        (0.0, np.pi / 2, -np.pi / 2)
    )
    rows, columns = np.indices(depth.shape)
    rows = np.clip(rows + np.rint(reach * np.sin(turn)).astype(int), 0, height - 1)
    columns = np.clip(columns + np.rint(reach * np.cos(turn)).astype(int), 0, width - 1)
    behind = depth[rows, columns]
    # Metres times pixels.
    focal_baseline = rng.uniform(2.0, 12.0) * float(np.percentile(known, 20))
    with np.errstate(divide="ignore", invalid="ignore"):
        parallax_px = focal_baseline * (1.0 / depth - 1.0 / behind)
    seen = (depth > 0) & (behind > 0) & (parallax_px > reach) & (rng.random(depth.shape) < 0.6)
    return np.where(seen, behind, depth)


def faults(rng: Generator, sparse: Depth) -> Depth:
    """Returns the points with random noise, outliers and shift; each may be absent."""
    mask = sparse > 0
    out = sparse.copy()
    # Noise in proportion to depth, or of structured light, with the square of the depth.
    if rng.random() < 0.5:
        out *= 1.0 + rng.uniform(0.0, 0.03) * rng.standard_normal(sparse.shape, dtype=np.float32)
    elif rng.random() < 0.3:
        gain = rng.uniform(0.0, 0.02) / max(float(sparse.max()), 1e-3)
        out += gain * sparse**2 * rng.standard_normal(sparse.shape, dtype=np.float32)
    if rng.random() < 0.4:
        most = 0.25 if rng.random() < 0.5 else 0.05
        out = outliers(rng, out, float(rng.uniform(0.0, most)))
    out = np.where(mask, np.maximum(out, np.float32(1e-3)), np.float32(0.0))
    if rng.random() < 0.1:
        out = _shifted(out, int(rng.integers(-2, 3)), int(rng.integers(-2, 3)))
    return out


def outliers(rng: Generator, sparse: Depth, fraction: float) -> Depth:
    """Returns the points with a fraction of outliers: scaled, uniform in the range, or swapped."""
    rows, columns = np.nonzero(sparse)
    chosen = rng.random(len(rows)) < fraction
    rows = rows[chosen]
    columns = columns[chosen]
    if not len(rows):
        return sparse
    known = sparse[sparse > 0]
    count = len(rows)
    kind = rng.integers(4)
    if kind == 0:
        changed = (sparse[rows, columns] * np.exp(rng.normal(0.0, 0.7, count))).astype(np.float32)
    elif kind == 1:
        changed = rng.uniform(0.5 * known.min(), 1.3 * known.max(), count).astype(np.float32)
    elif kind == 2:
        changed = rng.choice(known, count)
    else:
        changed = sparse[rows, columns] * rng.choice((rng.uniform(0.3, 0.8), rng.uniform(1.3, 3.0)))
    out = sparse.copy()
    out[rows, columns] = changed
    return out


def wrong_tracks(rng: Generator, sparse: Depth, fraction: float) -> Depth:
    """Returns the points with a fraction of outliers in groups of neighbours, a factor each.

    Such are the points of wrong tracks of structure from motion.
    """
    rows, columns = np.nonzero(sparse)
    out = sparse.copy()
    outliers_left = round(fraction * len(rows))
    spread = rng.uniform(0.2, 0.8)
    most = int(rng.integers(2, 13))
    while outliers_left > 0:
        # The nearest points of a random one.
        size = min(max(int(rng.integers(2, most + 1)), len(rows) // 500), outliers_left)
        centre = int(rng.integers(len(rows)))
        square = (rows - rows[centre]) ** 2 + (columns - columns[centre]) ** 2
        near = np.argpartition(square, size - 1)[:size]
        at = rows[near], columns[near]
        out[at] = sparse[at] * np.float32(np.exp(rng.normal(0.0, spread)))
        outliers_left -= size
    return out


def _shifted(sparse: Depth, down: int, right: int) -> Depth:
    """Returns the points moved by whole pixels; those that leave the image are lost."""
    height, width = sparse.shape
    reach = abs(down) + abs(right)
    padded = np.pad(sparse, reach)
    top = reach - down
    left = reach - right
    return padded[top : top + height, left : left + width].copy()


def _mask_at(
    shape: tuple[int, ...], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> Mask:
    """Returns a mask of the pixels nearest to these positions; those outside are left out."""
    mask = np.zeros(shape, dtype=bool)
    row = np.rint(rows).astype(int)
    column = np.rint(columns).astype(int)
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    mask[row[inside], column[inside]] = True
    return mask
