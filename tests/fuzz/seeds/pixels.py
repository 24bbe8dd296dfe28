"""Depth, points and images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pnpdepth_cli.io.depth import write_depth
from tests.fuzz.seeds.seed import HEIGHT, OUT, WIDTH, Seed


def write_seeds(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    """Returns depth in every format, sparse points, and images."""
    return [*_depths(folder, depth), *_images(folder, rng)]


def _depths(folder: Path, depth: np.ndarray) -> list[Seed]:
    names = [f"depth.{suffix}" for suffix in ("png", "exr", "npy", "npz", "pfm", "tif")]
    for name in names:
        write_depth(folder / name, depth)
    cv2.imwrite(str(folder / "double.tif"), depth.astype(np.float64))
    return [
        Seed(file=name, command=("sample", name, "--count", "20", *OUT))
        for name in (*names, "double.tif")
    ]


def _images(folder: Path, rng: np.random.Generator) -> list[Seed]:
    image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    names = [f"image.{suffix}" for suffix in ("png", "jpg", "webp", "tif")]
    for name in names:
        cv2.imwrite(str(folder / name), image)
    features = ("--count", "features:5")
    return [
        Seed(file=name, command=("sample", "gt.npy", *features, "--image", name, *OUT))
        for name in names
    ]
