"""From linear light to the picture a camera stores: exposure, lens, noise, compression."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
from PIL import Image

from model_zoo_defs.training.rendering.shapes import FloatArray


def photographed(
    colour: FloatArray, rng: np.random.Generator, *, clean: bool = False
) -> npt.NDArray[np.uint8]:
    """Returns the stored picture (H, W, 3) of linear light (H, W, 3).

    clean leaves out what spoils a picture (noise, blur, compression); exposure stays.
    """
    height, width = colour.shape[:2]
    # The mean of log light decides the exposure, so a bright window may burn out.
    level = float(np.exp(np.log(np.maximum(colour.mean(axis=2), 1e-4)).mean()))
    key = rng.uniform(0.09, 0.11) if clean else rng.uniform(0.10, 0.30)
    picture = colour * np.float32(key / level)
    balance = rng.normal(1.0, 0.01 if clean else 0.06, 3).astype(np.float32)
    picture = picture * balance
    picture = picture * (1 + picture / 9) / (1 + picture)
    picture = np.clip(picture * 1.35, 0, 1) ** np.float32(1 / rng.uniform(1.9, 2.3))
    grey = picture.mean(axis=2, keepdims=True)
    picture = grey + (picture - grey) * np.float32(rng.uniform(0.8, 1.3))
    if clean:
        return _bytes(picture)
    if rng.random() < 0.6:
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j].astype(np.float32)
        picture = picture * (1 - np.float32(rng.uniform(0, 0.3)) * (x * x + y * y) / 2)[..., None]
    if rng.random() < 0.6:
        picture = _blurred(picture, float(rng.uniform(0.1, 0.9)))
    if rng.random() < 0.8:
        sigma = float(rng.choice([0.003, 0.006, 0.01, 0.015, 0.03])) * (
            0.4 + np.sqrt(np.clip(grey, 0, 1))
        )
        picture = picture + sigma * rng.standard_normal(picture.shape, dtype=np.float32)
    stored = _bytes(picture)
    if rng.random() < 0.6:
        stored = _compressed(stored, int(rng.integers(55, 97)))
    return stored


def _bytes(picture: FloatArray) -> npt.NDArray[np.uint8]:
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)


def _blurred(picture: FloatArray, sigma: float) -> FloatArray:
    side = np.float32(np.exp(-0.5 / sigma**2))
    for axis in (0, 1):
        ends = np.concatenate(
            [picture.take([0], axis), picture, picture.take([-1], axis)], axis=axis
        )
        low = ends.take(range(picture.shape[axis]), axis)
        high = ends.take(range(2, picture.shape[axis] + 2), axis)
        picture = (picture + side * (low + high)) / (1 + 2 * side)
    return picture


def _compressed(picture: npt.NDArray[np.uint8], quality: int) -> npt.NDArray[np.uint8]:
    memory = io.BytesIO()
    Image.fromarray(picture).save(memory, "JPEG", quality=quality)
    return np.asarray(Image.open(memory).convert("RGB"))
