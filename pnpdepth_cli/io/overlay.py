"""Sparse depth drawn on its image, to check by eye that the two belong together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.colours import depth_scale, dimmed, grey_of
from pnpdepth_cli.io.page import Panel, depth_page, draw_discs, magnification, resized, save_page


def overlay(
    rgb: NDArray[np.float32],
    xy: NDArray[np.float32],
    depth: NDArray[np.float32],
    path: Path,
) -> None:
    """Writes a PNG with N points in the colours of their depth on the grey image, nearest on top.

    Args:
        rgb: (H, W, 3) in 0..1.
        xy: (N, 2) pixel coordinates.
        depth: (N,) metres.
        path: The PNG.

    Raises:
        OutputError: The file cannot be written.
    """
    scale = depth_scale(depth)
    factor = magnification(rgb.shape, columns=1, legend=True)
    ground = resized(dimmed(grey_of(rgb)), factor, smooth=True)
    far_first = np.argsort(-depth, kind="stable")
    pixels = draw_discs(ground, xy, scale.paint(depth), factor, far_first)
    panel = Panel(title="Sparse depth", pixels=pixels, remark=f"{len(depth):,} points")
    save_page(depth_page([panel], 1, scale), path)
