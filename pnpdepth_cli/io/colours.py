"""Colours of depth, and of signed values such as a change of depth or of its error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
"""Red, green and blue in the last axis."""

UNKNOWN = 70
"""The grey of a pixel without depth: turbo has no such colour."""

SIGNED = {"gain": ((25, 90, 190), (220, 105, 0)), "change": ((1, 102, 94), (118, 42, 131))}
"""Colours of 1 and -1: better and worse, farther and nearer. Blue and orange are told apart by
colour-blind eyes."""

LOGARITHMIC_FROM = 8.0
"""Ratio of far to near from which the scale is logarithmic; on a linear one, nearly all of a street
would have the colour of its far end."""

_TURBO_FIRST = 12
_TURBO_LAST = 243
"""The levels of turbo, of 0 to 255, that are used: beyond them both ends are so dark that near and
far look alike."""
_RANGE_PERCENTILES = (2, 98)
"""Percentiles of depth at the ends of the colours, so that a few depths do not stretch them."""
_NARROW = 0.01  # range as a fraction of the depth, below which the bar is widened
_WIDENED = 0.05  # of the depth, on both sides
_BAR_LIGHT = 0.88  # 0…1, of a value of 0 in a legend


@dataclass(frozen=True, kw_only=True)
class DepthScale:
    """The colour of each depth: turbo from `low_m`, near and warm, to `high_m`, far and cold."""

    low_m: float
    high_m: float

    @property
    def logarithmic(self) -> bool:
        """Whether the colours follow the logarithm of depth."""
        return self.high_m / self.low_m > LOGARITHMIC_FROM

    def paint(self, depth: NDArray[np.floating]) -> Pixels:
        """Returns the colours (..., 3) of depths of any shape; `UNKNOWN` where depth is unknown.

        Args:
            depth: Metres, 0 or not finite where unknown.
        """
        is_known = np.isfinite(depth) & (depth > 0)
        filled = np.where(is_known, depth, self.low_m)
        depths = np.clip(filled, self.low_m, self.high_m, dtype=float)
        # 0 at the near end of the scale, 1 at the far one.
        position = (depths - self.low_m) / (self.high_m - self.low_m)
        if self.logarithmic:
            position = np.log(depths / self.low_m) / math.log(self.high_m / self.low_m)
        # Near is warm, at the upper end of turbo; OpenCV gives blue, green and red.
        turbo_range = _TURBO_LAST - _TURBO_FIRST
        levels = np.rint(_TURBO_FIRST + turbo_range * (1 - position)).astype(np.intp)
        turbo = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)
        colours = turbo[:, 0, ::-1][levels]
        return np.where(is_known[..., None], colours, np.uint8(UNKNOWN))


def depth_scale(*depths: NDArray[np.floating]) -> DepthScale:
    """Returns the scale over the 2nd to 98th percentile of all known depths together.

    Args:
        depths: Depths of any shape in metres, 0 or not finite where unknown.
    """
    known_depths = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in depths])
    if not known_depths.size:
        return DepthScale(low_m=1.0, high_m=2.0)  # any scale, as nothing has its colours
    low, high = np.percentile(known_depths.astype(np.float64), _RANGE_PERCENTILES).tolist()
    if high - low < _NARROW * low:  # a single depth still needs a bar with two ends
        low = (1 - _WIDENED) * low
        high = (1 + _WIDENED) * high
    return DepthScale(low_m=low, high_m=high)


def paint_signed(values: NDArray[np.floating], light: NDArray[np.floating], colors: str) -> Pixels:
    """Returns the colours (..., 3) of signed values, from grey at 0 to full colour at -1 and 1.

    Args:
        values: Values of any shape; those beyond -1 and 1 have the full colour.
        light: Grey of the same shape, 0…1, at a value of 0.
        colors: Name of the two colours in `SIGNED`.
    """
    above, below = np.array(SIGNED[colors], np.float32)
    signed = values[..., None].astype(np.float32)
    amount = np.clip(np.abs(signed), 0, 1)
    base = 255 * light[..., None].astype(np.float32)
    hue = np.where(signed > 0, above, below)
    return np.asarray(np.rint((1 - amount) * base + amount * hue), np.uint8)


def signed_bar(colors: str, length: int) -> Pixels:
    """Returns the colours (length, 3) of the legend of a map of signed values, from -1 to 1.

    Args:
        colors: Name of the two colours in `SIGNED`: "gain" or "change".
        length: Number of colours.
    """
    return paint_signed(np.linspace(-1, 1, length), np.full(length, _BAR_LIGHT), colors)
