"""Sparse depth as sensors give it, drawn from dense depth.

`draw` picks one pattern at random, thins it with holes, and adds what real sensors add: noise,
outliers, and a small shift between depth and picture. All maps are (H, W) float32 metres with
0 = unknown; the same generator state gives the same points.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]


def draw(rng: Generator, depth: Depth, grey: Depth) -> Depth:
    """Points of one random pattern with random faults; `grey` (H, W) 0..1 is the picture."""
    kind = rng.choice(5, p=(0.5, 0.28, 0.07, 0.08, 0.07))
    if kind == 1:
        sparse = scan_lines(rng, depth)
    else:
        count = int(np.exp(rng.uniform(np.log(5.0), np.log(depth.size / 8))))
        if kind == 4:
            sparse = keep(depth, window(rng, depth.shape) & uniform(rng, depth, 4 * count))
        else:
            pattern = {0: uniform, 2: jittered_grid}.get(int(kind))
            mask = pattern(rng, depth, count) if pattern else corners(rng, depth, grey, count)
            sparse = keep(depth, mask)
    if rng.random() < 0.2:
        sparse = keep(sparse, ~window(rng, depth.shape))
    return faults(rng, sparse)


def keep(depth: Depth, mask: Mask) -> Depth:
    """The depth where the mask is true, 0 elsewhere."""
    return np.where(mask, depth, np.float32(0.0))


def uniform(rng: Generator, depth: Depth, count: int) -> Mask:
    """`count` known pixels, each as likely as any other (all of them where fewer are known)."""
    known = np.flatnonzero(depth)
    mask = np.zeros(depth.size, dtype=bool)
    mask[rng.choice(known, size=min(count, known.size), replace=False)] = True
    return mask.reshape(depth.shape)


def jittered_grid(rng: Generator, depth: Depth, count: int) -> Mask:
    """About `count` pixels on a regular grid, each moved by at most a random part of a step."""
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
    """`count` known pixels where the picture has much gradient, as feature points have."""
    dy, dx = np.gradient(grey)
    strength = np.hypot(dy, dx).ravel() + 1e-4
    # the largest of strength^p times a random number (Efraimidis and Spirakis' reservoir keys)
    keys = np.log(rng.random(depth.size)) / (strength ** rng.uniform(0.7, 2.0))
    keys[depth.ravel() == 0] = -np.inf
    count = min(count, int(np.count_nonzero(depth)))
    mask = np.zeros(depth.size, dtype=bool)
    if count:
        mask[np.argpartition(keys, -count)[-count:]] = True
    return mask.reshape(depth.shape)


def window(rng: Generator, shape: tuple[int, ...]) -> Mask:
    """A random rectangle or ellipse of 10 to 80 per cent of the picture's sides."""
    height, width = shape
    half = rng.uniform(0.05, 0.4, 2) * (height, width)
    centre = rng.uniform(0.1, 0.9, 2) * (height, width)
    rows = (np.arange(height)[:, None] - centre[0]) / half[0]
    columns = (np.arange(width)[None, :] - centre[1]) / half[1]
    if rng.random() < 0.5:
        return np.asarray(np.maximum(np.abs(rows), np.abs(columns)) < 1.0)
    return np.asarray(rows * rows + columns * columns < 1.0)


def scan_lines(rng: Generator, depth: Depth) -> Depth:
    """Points of a spinning LiDAR: slightly bowed lines, dense along them, nothing at the top.

    Some points lie behind what the camera sees at their pixel: the scanner stands elsewhere and
    looks past the edges (`leak`).
    """
    height, width = depth.shape
    spacing = float(np.exp(rng.uniform(np.log(2.5), np.log(height / 8))))
    # single scanners are dense along the line, also when their lines are far apart
    stride = rng.uniform(1.0, 3.5)
    top = rng.uniform(0.0, 0.45) * height if rng.random() < 0.8 else 0.0
    lines = np.arange(top, height, spacing)
    across = np.arange(rng.uniform(0.0, stride), width, stride)
    bow, tilt = rng.uniform(-0.04, 0.04) * height, rng.uniform(-0.03, 0.03) * height
    place = across / width * 2.0 - 1.0
    rows = lines[:, None] + (bow * place**2 + tilt * place)[None, :]
    rows = rows + rng.normal(0.0, 0.3, rows.shape)
    columns = across[None, :] + rng.uniform(-0.4, 0.4, rows.shape)
    returned = rng.random(rows.shape) >= rng.uniform(0.0, 0.4)
    mask = _mask_at(depth.shape, rows[returned], columns[returned])
    source = leak(rng, depth) if rng.random() < 0.7 else depth
    return keep(source, mask)


def leak(rng: Generator, depth: Depth) -> Depth:
    """The depth map with some pixels beside depth edges showing the background behind them.

    A pixel looks past an edge k pixels away when the parallax between the two depths,
    focal x baseline x (1/near − 1/far), is more than k pixels.
    """
    known = depth[depth > 0]
    if not known.size:
        return depth
    height, width = depth.shape
    reach = rng.integers(1, 9, depth.shape)
    turn = rng.choice((-1.0, 1.0)) * rng.uniform(0.0, 0.5) + rng.choice(
        (0.0, np.pi / 2, -np.pi / 2)
    )
    rows, columns = np.indices(depth.shape)
    rows = np.clip(rows + np.rint(reach * np.sin(turn)).astype(int), 0, height - 1)
    columns = np.clip(columns + np.rint(reach * np.cos(turn)).astype(int), 0, width - 1)
    behind = depth[rows, columns]
    focal_baseline = rng.uniform(2.0, 12.0) * float(np.percentile(known, 20))
    with np.errstate(divide="ignore", invalid="ignore"):
        parallax_px = focal_baseline * (1.0 / depth - 1.0 / behind)
    seen = (depth > 0) & (behind > 0) & (parallax_px > reach) & (rng.random(depth.shape) < 0.6)
    return np.where(seen, behind, depth)


def faults(rng: Generator, sparse: Depth) -> Depth:
    """The points with noise, outliers and a shift against the picture, each of them sometimes."""
    mask = sparse > 0
    out = sparse.copy()
    if rng.random() < 0.5:
        out *= 1.0 + rng.uniform(0.0, 0.03) * rng.standard_normal(sparse.shape, dtype=np.float32)
    elif rng.random() < 0.3:
        # structured light: the error grows with the square of the depth
        share = rng.uniform(0.0, 0.02) / max(float(sparse.max()), 1e-3)
        out += share * sparse**2 * rng.standard_normal(sparse.shape, dtype=np.float32)
    if rng.random() < 0.3:
        share = rng.uniform(0.05, 0.2) if rng.random() < 0.1 else rng.uniform(0.0, 0.05)
        wrong = mask & (rng.random(sparse.shape) < share)
        out[wrong] *= np.exp(rng.normal(0.0, 0.7, int(wrong.sum()))).astype(np.float32)
    out = np.where(mask, np.maximum(out, np.float32(1e-3)), np.float32(0.0))
    if rng.random() < 0.1:
        out = _shifted(out, int(rng.integers(-2, 3)), int(rng.integers(-2, 3)))
    return out


def _shifted(x: Depth, down: int, right: int) -> Depth:
    height, width = x.shape
    reach = abs(down) + abs(right)
    padded = np.pad(x, reach)
    top, left = reach - down, reach - right
    return padded[top : top + height, left : left + width].copy()


def _mask_at(
    shape: tuple[int, ...], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> Mask:
    mask = np.zeros(shape, dtype=bool)
    r, c = np.rint(rows).astype(int), np.rint(columns).astype(int)
    inside = (r >= 0) & (r < shape[0]) & (c >= 0) & (c < shape[1])
    mask[r[inside], c[inside]] = True
    return mask
