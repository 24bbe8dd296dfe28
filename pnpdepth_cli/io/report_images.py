"""The pictures of a report: views of bounded size, small ones for its list, and the error map."""

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
"""What a frame can be looked at in: the two sides of a slider, the map of errors, its inputs."""

_VIEW_SIZE = 960  # of the longer side, at most
_SMALL = 480  # smaller views are enlarged by a whole number, so that their pixels stay square
_THUMB_SIZE = 160
_QUALITY = 85
_STRONGEST_PERCENTILE = 95.0
_SWATCHES = 9

Depth = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class ErrorMap:
    """A map of errors, and the metres from which on an error has the full colour."""

    pixels: Pixels
    strongest_m: float


def image_paths(folder: Path, key: str, views: Sequence[str]) -> list[Path]:
    """The files of a frame that has these views."""
    return [folder / f"{key}_{name}.jpg" for name in (*views, "thumb", "map_thumb")]


def save_images(folder: Path, key: str, views: Mapping[str, Pixels], *, thumb: str) -> None:
    """The files of `image_paths` are there; the first small one is of the view `thumb`."""
    for name, pixels in views.items():
        _save(folder / f"{key}_{name}.jpg", _fitted(pixels))
    for name, view in (("thumb", thumb), ("map_thumb", "map")):
        pixels = views[view]
        factor = min(1.0, _THUMB_SIZE / max(pixels.shape[:2]))
        _save(folder / f"{key}_{name}.jpg", resized(pixels, factor))


def error_map(prediction: Depth, truth: Depth, grey: NDArray[np.float32] | None) -> ErrorMap:
    """Where the prediction is too far and where too near, over a grey picture where neither is.

    All are (H, W); depths in metres, 0 where there is none or it does not count.
    """
    both = (prediction > 0) & (truth > 0)
    error = prediction[both].astype(np.float64) - truth[both]
    wrong = np.abs(error[error != 0])
    strongest = float(np.percentile(wrong, _STRONGEST_PERCENTILE)) if wrong.size else 1.0
    ground = np.full(truth.shape, 0.3, np.float32) if grey is None else grey
    pixels = dimmed(np.asarray(0.6 * ground, np.float32))
    pixels[both] = paint_error(error / strongest, 0.66 + 0.3 * ground[both])
    return ErrorMap(pixels=pixels, strongest_m=strongest)


def gain_colours() -> list[str]:
    """The colours of an improvement map as #rrggbb, from worse to better."""
    return _hexadecimal(paint_gain(*_strengths()))


def error_colours() -> list[str]:
    """The colours of an error map, from too near to too far."""
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
        # Without the usual subsampling of colours, which blurs edges between them.
        Image.fromarray(np.ascontiguousarray(pixels)).save(
            temporary, "JPEG", quality=_QUALITY, subsampling=0
        )
