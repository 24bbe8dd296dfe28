"""Scenes of flat boxes whose image is not registered to their depth."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.completion.image_registration import ImageRegistration
from pnpdepth_cli.points import SparsePoints

SIZE = (240, 320)
UNREGISTERED = ImageRegistration(zoom=0.9, right=-5.0, down=3.0)


def frame(
    seed: int, registration: ImageRegistration | None = None, count: int = 500, gap_px: int = 0
) -> tuple[NDArray[np.float32], SparsePoints]:
    """Image and random points of a frame with this registration; None: it is registered.

    It shows forty boxes in front of a wall. No point is within `gap_px` of a jump of depth, as on
    phones, which are unsure of those.
    """
    rng = np.random.default_rng(seed)
    height, width = (2 * side for side in SIZE)
    depth = np.full((height, width), 6.0, np.float32)
    rgb = np.full((height, width, 3), 0.5, np.float32)
    for distance in sorted(rng.uniform(1.0, 5.0, 40), reverse=True):
        top = int(rng.integers(height - 40))
        left = int(rng.integers(width - 40))
        bottom = top + int(rng.integers(30, 120))
        right = left + int(rng.integers(30, 120))
        depth[top:bottom, left:right] = distance
        rgb[top:bottom, left:right] = rng.uniform(0, 1, 3)
    rgb += rng.normal(0, 0.02, rgb.shape).astype(np.float32)
    inner = tuple(slice(side // 2, side // 2 + side) for side in SIZE)
    if registration is not None:  # as the other camera sees the scene: moved by the inverse
        zoom = 1 / registration.zoom
        right = -registration.right * zoom
        down = -registration.down * zoom
        rgb = ImageRegistration(zoom=zoom, right=right, down=down).apply_to(rgb)
    rgb = np.clip(rgb[inner], 0, 1)
    depth = depth[inner]
    jump = cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0.1
    beside = cv2.dilate(jump.astype(np.uint8), np.ones(2 * (2 * gap_px + 1,))) > 0
    far = np.flatnonzero(~beside) if gap_px else depth.size
    chosen = np.random.default_rng(seed).choice(far, count, replace=False)
    rows, columns = np.unravel_index(chosen, depth.shape)
    xy = torch.from_numpy(np.stack([columns, rows], axis=1).astype(np.float32))
    return rgb, SparsePoints(xy=xy, depth=torch.from_numpy(depth[rows, columns]), size=SIZE)
