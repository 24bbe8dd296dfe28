"""The images of a report: views of bounded size, thumbnails, and the error map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.colours import Pixels, dimmed, paint_error, paint_gain
from pnpdepth_cli.io.page import resized

VIEWS = ("first", "second", "map", "image", "sparse")
"""Views of a frame: the two sides of a slider, the map of errors, and its inputs."""

_VIEW_SIZE = 960  # of the longer side, at most
_SMALL = 480  # smaller views are enlarged by a whole number, so that their pixels stay square
_THUMB_SIZE = 160
_QUALITY = 85
_STRONGEST_PERCENTILE = 95.0
_SWATCHES = 9

Depth = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class ErrorMap:
    """A map of errors."""

    pixels: Pixels
    """(H, W, 3) colours."""

    strongest_m: float
    """Error from which on the colour is full, metres."""


def image_paths(folder: Path, key: str, views: Sequence[str]) -> list[Path]:
    """Returns the files of a frame that has these views."""
    return [folder / f"{key}_{name}.jpg" for name in (*views, "thumb", "map_thumb")]


def save_images(folder: Path, key: str, views: Mapping[str, Pixels], *, thumb: str) -> None:
    """Writes the files of `image_paths`.

    Args:
        folder: The report's folder for images.
        key: Start of their names.
        views: (H, W, 3) by the name of the view.
        thumb: The view that the first thumbnail shows.

    Raises:
        OutputError: A file cannot be written.
    """
    for name, pixels in views.items():
        _save(folder / f"{key}_{name}.jpg", _fitted(pixels))
    for name, view in (("thumb", thumb), ("map_thumb", "map")):
        pixels = views[view]
        factor = min(1.0, _THUMB_SIZE / max(pixels.shape[:2]))
        _save(folder / f"{key}_{name}.jpg", resized(pixels, factor))


def error_map(prediction: Depth, ground_truth: Depth, grey: NDArray[np.float32] | None) -> ErrorMap:
    """Returns the map of where the prediction is too far or too near, over the grey image.

    Args:
        prediction: (H, W) metres, 0 where there is none.
        ground_truth: (H, W) metres, 0 where it is unknown or does not count.
        grey: (H, W) in 0..1; None for a uniform ground.
    """
    both = (prediction > 0) & (ground_truth > 0)
    error = prediction[both].astype(np.float64) - ground_truth[both]
    sizes = np.abs(error[error != 0])
    strongest = float(np.percentile(sizes, _STRONGEST_PERCENTILE)) if sizes.size else 1.0
    ground = np.full(ground_truth.shape, 0.3, np.float32) if grey is None else grey
    pixels = dimmed(np.asarray(0.6 * ground, np.float32))
    pixels[both] = paint_error(error / strongest, 0.66 + 0.3 * ground[both])
    return ErrorMap(pixels=pixels, strongest_m=strongest)


def gain_colours(colors: str) -> list[str]:
    """Returns the colours of an improvement map as #rrggbb, from worse to better.

    Args:
        colors: One of `choices.COLORS`.
    """
    return _hexadecimal(paint_gain(*_strengths(), colors))


def error_colours() -> list[str]:
    """Returns the colours of an error map as #rrggbb, from too near to too far."""
    return _hexadecimal(paint_error(*_strengths()))


def _strengths() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.linspace(-1, 1, _SWATCHES), np.full(_SWATCHES, 0.88)


def _hexadecimal(colours: NDArray[Any]) -> list[str]:
    return [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in colours.tolist()]


def _fitted(pixels: Pixels) -> Pixels:
    longest = max(pixels.shape[:2])
    factor = _VIEW_SIZE // longest if longest < _SMALL else min(1.0, _VIEW_SIZE / longest)
    return resized(pixels, factor)


def _save(path: Path, pixels: Pixels) -> None:
    from PIL import Image

    with atomic_path(path) as temporary:
        # Without chroma subsampling, which blurs edges between colours.
        Image.fromarray(np.ascontiguousarray(pixels)).save(
            temporary, "JPEG", quality=_QUALITY, subsampling=0
        )
