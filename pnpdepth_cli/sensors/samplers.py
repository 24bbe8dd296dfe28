"""Sparse depth sampled from dense depth by a pattern."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import NoPointsError, SizeError, UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.sensors.pixels import Points

Image = NDArray[np.float32]
Pixels = NDArray[np.intp]


class _Scene(NamedTuple):
    """A dense depth map that is sampled."""

    known: Pixels  # row-major indices of the pixels with known depth
    size: tuple[int, int]
    image: Image | None
    pattern: SamplePattern
    wanted: int  # number of points to sample
    seed: int


def sample_points(
    depth: NDArray[np.float32],
    pattern: SamplePattern,
    seed: int,
    *,
    image: Image | None = None,
) -> Points:
    """Returns points sampled from a dense depth map; the same seed gives the same points.

    Args:
        depth: (H, W) metres, 0 = unknown.
        pattern: Pattern of the pixels that are sampled.
        seed: Random seed of the pattern.
        image: (H, W, 3) in 0..1 of the same view, for `features`.

    Raises:
        NoPointsError: The depth map or the pattern leaves no point.
        UsageError: More points are asked for than are known.
        SizeError: Image and depth differ in size.
    """
    size = (depth.shape[0], depth.shape[1])
    if image is not None and image.shape[:2] != size:
        raise SizeError(
            f"the image is {image.shape[1]}×{image.shape[0]} but the depth is {size[1]}×{size[0]}"
        )
    known = np.flatnonzero(np.isfinite(depth) & (depth > 0))
    if not known.size:
        raise NoPointsError("the depth map has no pixel with known depth to sample from")
    scene = _Scene(known, size, image, pattern, pattern.wanted(known.size), seed)
    chosen = np.sort(SAMPLERS[pattern.kind](scene))
    if not chosen.size:
        raise NoPointsError(f"pattern {pattern.kind!r} leaves no point; ask for more")
    row, column = np.divmod(chosen, size[1])
    return Points(
        xy=np.stack([column, row], axis=1).astype(np.float32),
        depth=depth.ravel()[chosen].astype(np.float32),
        size=size,
    )


def _uniform(scene: _Scene) -> Pixels:
    count = scene.wanted
    if count > scene.known.size:
        raise UsageError(f"{count:,} points of {scene.known.size:,} known pixels; ask for fewer")
    return np.random.default_rng(scene.seed).choice(scene.known, count, replace=False)


def _shuffle(scene: _Scene) -> Pixels:
    """The first of the known pixels as numpy's legacy generator shuffles them (Marigold-DC)."""
    rows = scene.known[:, None].copy()  # rows of an array are shuffled unlike a flat one
    np.random.RandomState(scene.seed).shuffle(rows)
    return rows[: scene.wanted, 0]


def _grid(scene: _Scene) -> Pixels:
    """Known pixels of a square grid whose spacing gives a full map the wanted count."""
    height, width = scene.size
    fraction = scene.pattern.fraction
    spacing = fraction**-0.5 if fraction else max(1.0, (height * width / scene.wanted) ** 0.5)
    rows, columns = (
        np.floor((np.arange(max(1, round(side / spacing))) + 0.5) * spacing).clip(max=side - 1)
        for side in (height, width)
    )
    nodes = rows.astype(np.intp)[:, None] * width + columns.astype(np.intp)
    return np.intersect1d(nodes, scene.known)


def _lines(scene: _Scene) -> Pixels:
    """All known pixels of evenly spaced rows."""
    height, width = scene.size
    count = scene.pattern.wanted(height)
    if count > height:
        raise UsageError(f"{count:,} lines do not fit {height:,} rows; ask for fewer")
    rows = np.floor((np.arange(count) + 0.5) * height / count).astype(np.intp)
    return scene.known[np.isin(scene.known // width, rows)]


def _features(scene: _Scene) -> Pixels:
    """The strongest ORB corners with known depth, as structure from motion has its points."""
    if scene.image is None:
        raise UsageError("pattern 'features' needs the image that the depth belongs to")
    grey = cv2.cvtColor(scene.image.clip(0, 1), cv2.COLOR_RGB2GRAY)
    # Corners of several pyramid levels share pixels; three times as many leave enough when merged.
    wanted = scene.wanted
    detector = cv2.ORB_create(nfeatures=3 * wanted + 100, edgeThreshold=4, fastThreshold=5)  # type: ignore[attr-defined]
    corners = detector.detect(np.rint(255 * grey).astype(np.uint8))
    xy = np.array([c.pt for c in sorted(corners, key=lambda corner: -corner.response)])
    column, row = np.rint(xy.reshape(-1, 2)).astype(np.intp).T
    pixels = list(dict.fromkeys((row * scene.size[1] + column).tolist()))
    return np.array(pixels, np.intp)[np.isin(pixels, scene.known)][:wanted]


_FUNCTIONS = (_uniform, _shuffle, _grid, _lines, _features)
SAMPLERS = {function.__name__.removeprefix("_"): function for function in _FUNCTIONS}
"""What returns row-major indices of pixels, by a name of `choices.PATTERNS`."""
