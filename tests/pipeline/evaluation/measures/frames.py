"""Frames for the tests of measures."""

from __future__ import annotations

import numpy as np
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame

K = np.array([[50.0, 0, 20.0], [0, 60.0, 15.0], [0, 0, 1]])


def random_frame(seed: int, holes: float = 0.2) -> MeasuredFrame:
    """A frame of 30×40 pixels with holes in both depths, and sparse points."""
    rng = np.random.default_rng(seed)
    gt, depth = (rng.uniform(1, 30, (30, 40)) * (rng.random((30, 40)) > holes) for _ in range(2))
    return MeasuredFrame(
        depth=depth.astype(np.float32),
        gt=gt.astype(np.float32),
        intrinsics=K,
        sparse=(gt * (rng.random(gt.shape) < 0.03)).astype(np.float32),
    )


def plane(normal: tuple[float, float, float], distance: float) -> np.ndarray:
    """The depth (48, 72) of the plane normal · x = distance."""
    y, x = np.mgrid[:48, :72]
    rays = np.stack([(x - 20) / 50, (y - 15) / 60, np.ones(x.shape)], axis=-1)
    return np.asarray(distance / (rays @ np.array(normal)), np.float32)
