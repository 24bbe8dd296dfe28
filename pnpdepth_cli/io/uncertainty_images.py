"""PNGs of how far a depth map can be trusted: its standard deviation and its validity mask."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.colours import Pixels, depth_scale
from pnpdepth_cli.io.page import Panel, depth_page, magnification, resized, save_page

_HATCH_SPACING, _HATCH_WIDTH = 12, 3  # pixels of the page
_FADED, _LINE = 0.45, 0.8  # fractions of white


def sigma_preview(
    sigma: NDArray[np.float32], valid: NDArray[np.bool_] | None, path: Path, unit: str = "m"
) -> None:
    """Writes a PNG of a standard deviation, hatched where depth is not valid.

    Args:
        sigma: (H, W) metres.
        valid: (H, W). None: all is valid.
        path: The PNG.
        unit: Of sigma, where it is not the metre.

    Raises:
        OutputError: The file cannot be written.
    """
    scale = replace(depth_scale(sigma), warm_is_far=True)
    factor = magnification(sigma.shape, columns=1, legend=True)
    panel = Panel(
        title="Standard deviation",
        pixels=hatched(resized(scale.paint(sigma), factor), valid),
        remark="of the depth" if valid is None or valid.all() else "hatched: not valid",
    )
    save_page(depth_page([panel], 1, scale, unit), path)


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """Writes an 8-bit PNG, 255 where the mask (H, W) is true and 0 elsewhere."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(temporary, "PNG")


def hatched(pixels: Pixels, valid: NDArray[np.bool_] | None) -> Pixels:
    """Returns an image faded and with diagonal lines where its depth is not valid.

    Args:
        pixels: (H', W', 3).
        valid: (H, W), of any size. None: all is valid.
    """
    if valid is None or valid.all():
        return pixels
    height, width = pixels.shape[:2]
    mask = cv2.resize(valid.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) == 0
    y, x = np.ogrid[:height, :width]
    lines = (x + y) % _HATCH_SPACING < _HATCH_WIDTH
    white = np.where(lines, _LINE, _FADED)[mask][:, None]
    image = pixels.copy()
    image[mask] = np.rint((1 - white) * pixels[mask] + white * 255).astype(np.uint8)
    return image
