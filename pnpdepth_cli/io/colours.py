"""Colours for depth and for change of error, and the ticks of their colour bars."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

UNKNOWN = 70
"""The grey of a pixel without depth: turbo has no such colour."""

_SIGNED = {
    "gain": ((25, 90, 190), (220, 105, 0)),
    "error": ((220, 105, 0), (25, 90, 190)),
    "change": ((1, 102, 94), (118, 42, 131)),
}
"""Colours of 1 and -1: better and worse, too far and too near, farther and
nearer. Blue and orange are told apart by colour-blind eyes."""

LOGARITHMIC_FROM = 8.0
"""Ratio of far to near from which the scale is logarithmic.

On a linear scale, nearly all of a street would have the colour of its far end.
"""


@dataclass(frozen=True, kw_only=True)
class DepthScale:
    """The colour of each depth: turbo from `low_m`, near and warm, to `high_m`, far and cold."""

    low_m: float
    high_m: float
    warm_is_far: bool = False  # whether the warm end is the far one, as for a standard deviation

    @property
    def logarithmic(self) -> bool:
        """True if the colours follow log depth."""
        return self.high_m / self.low_m > LOGARITHMIC_FROM

    def position(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Returns 0 at the near end to 1 at the far end, clipped, for depths of any shape."""
        bounded = np.clip(np.asarray(depth, dtype=np.float64), self.low_m, self.high_m)
        if self.logarithmic:
            return np.log(bounded / self.low_m) / math.log(self.high_m / self.low_m)
        return (bounded - self.low_m) / (self.high_m - self.low_m)

    def paint(self, depth: NDArray[np.floating]) -> Pixels:
        """Returns (..., 3) colours of depths of any shape; `UNKNOWN` where there is none."""
        known = np.isfinite(depth) & (depth > 0)
        position = self.position(np.where(known, depth, self.low_m))
        pixels = _turbo(position if self.warm_is_far else 1 - position)
        pixels[~known] = UNKNOWN
        return pixels

    def ticks(self) -> list[float]:
        """Returns round depths within the range, ascending."""
        if not self.logarithmic:
            return round_steps(self.low_m, self.high_m)
        decades = range(math.floor(math.log10(self.low_m)), math.ceil(math.log10(self.high_m)))
        digits = {1: (1, 2, 3, 5, 7), 2: (1, 2, 3, 5, 7), 3: (1, 2, 5)}.get(len(decades), (1,))
        candidates = [digit * 10.0**decade for decade in decades for digit in digits]
        return [value for value in candidates if self.low_m <= value <= self.high_m]


def depth_scale(*depths: NDArray[np.floating]) -> DepthScale:
    """Returns the scale over the 2nd to 98th percentile of all known depths together."""
    values = [np.asarray(d, dtype=np.float64).ravel() for d in depths]
    known = np.concatenate([v[np.isfinite(v) & (v > 0)] for v in values])
    if known.size == 0:
        return DepthScale(low_m=1.0, high_m=2.0)
    low, high = (float(v) for v in np.percentile(known, (2, 98)))
    if high - low < 0.01 * low:  # a single depth still needs a bar with two ends
        low, high = 0.95 * low, 1.05 * high
    return DepthScale(low_m=low, high_m=high)


def round_steps(low: float, high: float) -> list[float]:
    """Returns multiples of 1, 2 or 5 times a power of ten within the range, at most eleven."""
    rough = (high - low) / 10
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def grey_of(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """Returns (H, W) luma in 0..1 of an (H, W, 3) or (H, W) image in 0..1."""
    image = np.clip(np.nan_to_num(np.asarray(rgb, dtype=np.float32)), 0, 1)
    if image.ndim == 2:
        return image
    weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.asarray(image @ weights, dtype=np.float32)


def dim(grey: NDArray[np.float32]) -> Pixels:
    """Returns an (H, W, 3) dark grey image, on which coloured points stand out."""
    levels = np.rint(20 + 115 * grey).astype(np.uint8)
    return np.repeat(levels[:, :, None], 3, axis=2)


def paint_signed(
    strength: NDArray[np.floating], light: NDArray[np.floating], colors: str
) -> Pixels:
    """Returns (..., 3) colours of `_SIGNED` from -1 to 1, around the grey `light` 0..1 at 0."""
    above, below = _SIGNED[colors]
    signed = np.asarray(strength, dtype=np.float32)[..., None]
    amount = np.clip(np.abs(signed), 0, 1)
    base = 255 * np.asarray(light, dtype=np.float32)[..., None]
    hue = np.where(signed > 0, np.asarray(above, np.float32), np.asarray(below, np.float32))
    return np.asarray(np.rint((1 - amount) * base + amount * hue), dtype=np.uint8)


def signed_bar(colors: str, length: int) -> Pixels:
    """Returns (length, 3) colours of a legend of `paint_signed`."""
    return paint_signed(np.linspace(-1, 1, length), np.full(length, 0.88), colors)


def hex_colours(colours: Pixels) -> list[str]:
    """Returns (N, 3) colours as #rrggbb."""
    return [f"#{bytes(colour).hex()}" for colour in colours]


def _turbo(position: NDArray[np.float64]) -> Pixels:
    levels = np.arange(256, dtype=np.uint8)[:, None]
    table = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[:, 0, ::-1]
    # The last tenths of turbo are so dark at both ends that near and far look alike.
    index = np.rint(12 + 231 * np.clip(position, 0, 1)).astype(np.intp)
    return np.array(table[index], dtype=np.uint8)
