"""Relative networks of a wanted error, made from ground truth.

The error of log depth is a smooth field, one factor for each of some regions, and a power of depth.
Edges are blurred. Its amplitude is set so that the mean error is the wanted one after the best
affine fit of inverse depth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.cluster.vq import kmeans2

Map = NDArray[np.float64]

BLUR_PX = 1.5
REGIONS = 12
SMOOTH, OF_REGIONS, OF_POWER = 0.6, 0.7, 0.5
"""Parts of the smooth field, of the regions and of the power in the error."""


def simulated_depth(gt: NDArray[np.float32], error: float, rng: np.random.Generator) -> Map:
    """Returns (H, W) depth of a network whose mean |log| error is `error`, up to a factor.

    Args:
        gt: (H, W) metres, 0 = unknown; unknown pixels are like the nearest known one.
        error: Mean error of log depth after the best affine fit of inverse depth.
        rng: Random numbers.
    """
    known = gt > 0
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    log_depth = np.log(gt[tuple(nearest)].astype(float))
    height, width = gt.shape
    relative = (log_depth - log_depth.mean()) / (log_depth.std() + 1e-9)
    field = ndimage.zoom(rng.normal(size=(4, 5)), (height / 4, width / 5), order=3)
    regions = _regions(relative, rng)
    off = SMOOTH * field[:height, :width]
    off += OF_REGIONS * rng.normal(size=REGIONS)[regions]
    off += OF_POWER * rng.normal() * relative
    # The amplitude follows the error that it leads to.
    amplitude = error
    for _ in range(6):
        inverse = ndimage.gaussian_filter(np.exp(-(log_depth + amplitude * off)), BLUR_PX)
        amplitude *= np.clip(error / _error_of(inverse[known], gt[known]), 1 / 3, 3)
    inverse = ndimage.gaussian_filter(np.exp(-(log_depth + amplitude * off)), BLUR_PX)
    depth: Map = 1 / np.maximum(inverse, 1e-6)
    return depth


def as_outputs(depth: Map, rng: np.random.Generator) -> dict[str, Map]:
    """Returns what networks of this depth give, by what their numbers are."""
    inverse = 1 / depth
    factor = np.exp(rng.normal())
    shift = rng.uniform(-1, 1) * inverse.min()
    disparity = factor * (inverse - shift)
    tiny = 1e-3 * factor * inverse.min()
    return {
        "disparity": disparity,
        "metric": 1.15 * depth,
        "relative": np.exp(rng.normal()) * (depth + rng.uniform(-0.5, 1) * np.median(depth)),
        "log": np.exp(rng.normal()) * (np.log(depth) + rng.normal()),
        "sqrt": np.exp(rng.normal()) * np.sqrt(depth),
        "inverted": 1 / (disparity + tiny),
    }


def _regions(relative: Map, rng: np.random.Generator) -> NDArray[np.intp]:
    """(H, W) the number of each pixel's region, near in the image and in log depth."""
    height, width = relative.shape
    rows, columns = np.mgrid[:height, :width]
    places = np.stack([2 * rows / height, 2 * columns / width, 1.5 * relative], axis=-1)
    some = places[::8, ::8].reshape(-1, 3)
    centres, _ = kmeans2(some, REGIONS, minit="++", seed=int(rng.integers(1 << 30)))
    distance = np.stack([((places - centre) ** 2).sum(axis=-1) for centre in centres])
    return distance.argmin(axis=0)


def _error_of(inverse: Map, gt: NDArray[np.float32]) -> float:
    """The mean |log| error of inverse depth after its best affine fit, by relative errors."""
    system = np.stack([inverse, np.ones_like(inverse)], axis=1) * gt[:, None]
    scale, shift = np.linalg.lstsq(system, np.ones(len(gt)), rcond=None)[0]
    return float(np.abs(np.log(np.maximum(scale * inverse + shift, 1e-4) * gt)).mean())
