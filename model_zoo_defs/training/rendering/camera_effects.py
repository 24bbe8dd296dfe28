"""Camera model from linear light to a stored image: exposure, lens, noise, compression."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
from PIL import Image

from model_zoo_defs.training.rendering.shapes import FloatArray


def photographed(
    colour: FloatArray, rng: np.random.Generator, *, clean: bool = False
) -> npt.NDArray[np.uint8]:
    """Returns the stored image (H, W, 3) that a random camera takes.

    Args:
        colour: Linear light (H, W, 3) of any brightness.
        rng: Random numbers.
        clean: Whether vignetting, blur, noise and compression are left out; exposure and white
            balance stay.
    """
    height, width = colour.shape[:2]
    # The mean of log light decides the exposure, so a bright window may burn out.
    level = float(np.exp(np.log(np.maximum(colour.mean(axis=2), 1e-4)).mean()))
    key = rng.uniform(0.09, 0.11) if clean else rng.uniform(0.10, 0.30)
    image = colour * np.float32(key / level)
    balance = rng.normal(1.0, 0.01 if clean else 0.06, 3).astype(np.float32)
    image = image * balance
    image = image * (1 + image / 9) / (1 + image)
    image = np.clip(image * 1.35, 0, 1) ** np.float32(1 / rng.uniform(1.9, 2.3))
    grey = image.mean(axis=2, keepdims=True)
    image = grey + (image - grey) * np.float32(rng.uniform(0.8, 1.3))
    if clean:
        return _bytes(image)
    if rng.random() < 0.6:
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j].astype(np.float32)
        image = image * (1 - np.float32(rng.uniform(0, 0.3)) * (x * x + y * y) / 2)[..., None]
    if rng.random() < 0.6:
        image = _blurred(image, float(rng.uniform(0.1, 0.9)))
    if rng.random() < 0.8:
        sigma = float(rng.choice([0.003, 0.006, 0.01, 0.015, 0.03])) * (
            0.4 + np.sqrt(np.clip(grey, 0, 1))
        )
        image = image + sigma * rng.standard_normal(image.shape, dtype=np.float32)
    stored = _bytes(image)
    if rng.random() < 0.6:
        stored = _compressed(stored, int(rng.integers(55, 97)))
    return stored


def _bytes(image: FloatArray) -> npt.NDArray[np.uint8]:
    """Returns an image 0..1 as 0..255, clipped and rounded."""
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def _blurred(image: FloatArray, sigma: float) -> FloatArray:
    """Returns an image (H, W, 3) blurred by a Gaussian of below a pixel, of 3 taps an axis."""
    side = np.float32(np.exp(-0.5 / sigma**2))
    for axis in (0, 1):
        ends = np.concatenate([image.take([0], axis), image, image.take([-1], axis)], axis=axis)
        low = ends.take(range(image.shape[axis]), axis)
        high = ends.take(range(2, image.shape[axis] + 2), axis)
        image = (image + side * (low + high)) / (1 + 2 * side)
    return image


def _compressed(image: npt.NDArray[np.uint8], quality: int) -> npt.NDArray[np.uint8]:
    """Returns an image (H, W, 3) as JPEG of this quality gives it back."""
    memory = io.BytesIO()
    Image.fromarray(image).save(memory, "JPEG", quality=quality)
    return np.asarray(Image.open(memory).convert("RGB"))
