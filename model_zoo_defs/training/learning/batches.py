"""Batches for networks that learn metric depth: no augmentation changes the geometry of an image.

A batch holds windows of frames at their own scale, mirrored with probability 0.5, with changed
colours and, for networks that take them, sparse points. Batch number i depends only on the seed,
on i and on the frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from model_zoo_defs.training.learning.dataset import Frames
from model_zoo_defs.training.learning.patterns import keep, scan_lines, uniform

Depth = NDArray[np.float32]
Points = Callable[[Generator, Depth], Depth]


class Batch(NamedTuple):
    """rgb (B, 3, h, w) in 0..1, sparse (B, 1, H, W) and depth (B, 1, H, W) metres, 0 = unknown."""

    rgb: Tensor
    sparse: Tensor
    depth: Tensor


class Batches:
    """Endless batches; every folder of frames is drawn from equally often.

    Args:
        folders: Folders of rendered frames.
        seed: Random seed.
        points: Function that draws the sparse depth (H, W) of a window; None draws none.
        spliced: Fraction of the windows that are spliced from two frames.
    """

    def __init__(
        self, folders: Sequence[Path], seed: int, points: Points | None = None, spliced: float = 0.0
    ):
        self.sets = [Frames(folder) for folder in folders]
        self.seed = seed
        self.points = points
        self.spliced = spliced

    def batch(
        self, number: int, size: int, window: tuple[int, int], shown: tuple[int, int] | None = None
    ) -> Batch:
        """Returns a batch; the same number gives the same batch.

        Args:
            number: Number of the batch.
            size: Number of windows in it.
            window: (H, W) of the windows.
            shown: (h, w) that their images are resized to; None leaves them as they are.
        """
        rng = np.random.default_rng((self.seed, number))
        windows = [self._one_or_two(rng, window) for _ in range(size)]
        depth = np.stack([depth for _, depth in windows])
        sparse = np.stack([self._sparse(rng, window_depth) for window_depth in depth])
        rgb = torch.from_numpy(np.stack([rgb for rgb, _ in windows])).permute(0, 3, 1, 2)
        rgb = rgb.contiguous(memory_format=torch.channels_last).float() / 255.0
        if shown:
            rgb = F.interpolate(rgb, shown, mode="bilinear", antialias=True)
        return Batch(
            recoloured(rng, rgb),
            torch.from_numpy(sparse)[:, None],
            torch.from_numpy(depth)[:, None],
        )

    def _one_or_two(
        self, rng: Generator, window: tuple[int, int]
    ) -> tuple[NDArray[np.uint8], Depth]:
        """Returns image and depth of a window (H, W), of one frame or spliced from two."""
        first = self._window(rng, window)
        if self.spliced and rng.random() < self.spliced:
            return spliced(rng, first, self._window(rng, window))
        return first

    def _window(self, rng: Generator, window: tuple[int, int]) -> tuple[NDArray[np.uint8], Depth]:
        """Returns image and depth of a random window (H, W) of a random frame, often mirrored."""
        frames = self.sets[int(rng.integers(len(self.sets)))]
        while True:
            rgb, depth = frames[int(rng.integers(len(frames)))]
            top, left = (
                int(rng.integers(length - side + 1))
                for length, side in zip(depth.shape, window, strict=True)
            )
            cut = (slice(top, top + window[0]), slice(left, left + window[1]))
            rgb = rgb[cut]
            depth = depth[cut]
            if rng.random() < 0.5:
                rgb = rgb[:, ::-1]
                depth = depth[:, ::-1]
            # A window of hardly any known depth teaches little.
            if np.count_nonzero(depth) > depth.size // 10:
                return rgb, depth

    def _sparse(self, rng: Generator, depth: Depth) -> Depth:
        """Returns sparse depth of a window's depth (H, W); 0 everywhere if none is drawn."""
        return np.zeros_like(depth) if self.points is None else self.points(rng, depth)


def spliced(
    rng: Generator, one: tuple[NDArray[np.uint8], Depth], other: tuple[NDArray[np.uint8], Depth]
) -> tuple[NDArray[np.uint8], Depth]:
    """Returns a window with columns of one on the left and of the other on the right.

    Rows, and so metric depths, are kept: a camera of fixed height and pitch sees the floor of a row
    equally far in every column.

    Args:
        rng: Random numbers.
        one: Image and depth of a window.
        other: Image and depth of another one of the same size.
    """
    width = one[1].shape[1]
    seam = int(rng.integers(width // 4, width - width // 4 + 1))
    first = int(rng.integers(width - seam + 1))
    second = int(rng.integers(seam + 1))
    left_rgb, left = one
    right_rgb, right = other
    rgb = [left_rgb[:, first : first + seam], right_rgb[:, second : second + width - seam]]
    depth = [left[:, first : first + seam], right[:, second : second + width - seam]]
    return np.concatenate(rgb, axis=1), np.concatenate(depth, axis=1)


def recoloured(rng: Generator, rgb: Tensor) -> Tensor:
    """Returns images (B, 3, h, w) 0..1 with random exposure and colour, often permuted channels."""

    def per_image(values: NDArray[np.float64]) -> Tensor:
        """Returns numbers (B,) or (B, 3) as factors of images."""
        return torch.from_numpy(values.astype(np.float32)).view(len(rgb), -1, 1, 1)

    count = len(rgb)
    orders = [rng.permutation(3) if rng.random() < 0.5 else np.arange(3) for _ in range(count)]
    pairs = zip(rgb, orders, strict=True)
    rgb = torch.stack([image[torch.from_numpy(order)] for image, order in pairs])
    # Exposure and white balance, then saturation, contrast and gamma.
    exposure = rng.normal(0.0, 0.2, (count, 1))
    balance = rng.normal(0.0, 0.06, (count, 3))
    rgb = rgb * per_image(np.exp(exposure + balance))
    grey = rgb.mean(1, keepdim=True)
    rgb = grey + (rgb - grey) * per_image(rng.uniform(0.3, 1.3, count))
    rgb = 0.5 + (rgb - 0.5) * per_image(rng.uniform(0.8, 1.2, count))
    return rgb.clamp(0.0, 1.0) ** per_image(np.exp(rng.normal(0.0, 0.2, count)))


def some_points(rng: Generator, depth: Depth) -> Depth:
    """Returns sparse depth for networks that also take an image: random pixels or LiDAR scan lines.

    Half of the random pixel sets have the density of 500 of 228 x 304 pixels; the density of 500 of
    228 x 912 pixels lies in the range of the others.
    """
    kind = rng.random()
    if kind < 0.2:
        return scan_lines(rng, depth)
    # Fraction of the pixels: that of the paper's networks for NYU, or any in a range.
    fraction = 0.0072 if kind < 0.6 else np.exp(rng.uniform(np.log(0.0015), np.log(0.03)))
    return keep(depth, uniform(rng, depth, max(1, round(fraction * depth.size))))


def many_points(rng: Generator, depth: Depth) -> Depth:
    """Returns sparse depth for networks without an image: random pixels or LiDAR scan lines.

    Two thirds of the random pixel sets have 5 % of the pixels.
    """
    kind = rng.random()
    if kind < 0.4:
        return scan_lines(rng, depth)
    fraction = 0.05 if kind < 0.8 else np.exp(rng.uniform(np.log(0.005), np.log(0.2)))
    return keep(depth, uniform(rng, depth, max(1, round(fraction * depth.size))))
