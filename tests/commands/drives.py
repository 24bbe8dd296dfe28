"""A short drive on disk: frames of one camera that moves through a room, with poses."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pnpdepth_cli.io.depth import write_depth
from tests.commands.frames import frame_on_disk

HEIGHT, WIDTH, FOCAL_PX = 46, 62, 60.0
STEP_M = 0.1


def drive_on_disk(root: Path, frames: int = 4, *, points: int = 400) -> Path:
    """rgb/ sparse/ calib/ of so many frames, poses.txt, and net/ with a network.

    Every frame is 0.1 m ahead of the one before; there are two walls and a floor.
    """
    (root / "net").mkdir(parents=True)
    frame = frame_on_disk(root / "net", HEIGHT, WIDTH)
    for part in ("rgb", "sparse", "calib"):
        (root / part).mkdir()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    right, down = (x - 30.5) / FOCAL_PX, (y - 22.5) / FOCAL_PX
    image = cv2.imread(str(frame.image))
    rows = []
    for number in range(frames):
        with np.errstate(divide="ignore"):
            floor = np.where(down > 0, 1.5 / down, np.inf)
            left = np.where(right < 0, -1 / right, np.inf)
        depth = np.minimum(np.minimum(floor, left), 5 - STEP_M * number)
        known = np.random.default_rng(number).permutation(depth.size)[:points]
        sparse = np.zeros(depth.size, np.float32)
        sparse[known] = depth.flatten()[known]
        name = f"drive_{number:03}"
        write_depth(root / f"sparse/{name}.png", sparse.reshape(depth.shape), scale=1000)
        cv2.imwrite(str(root / f"rgb/{name}.png"), np.roll(image, number, axis=1))
        (root / f"calib/{name}.txt").write_text(
            f"K: [{FOCAL_PX}, 0, 30.5, 0, {FOCAL_PX}, 22.5, 0, 0, 1]\n"
        )
        rows.append(f"1 0 0 0 0 1 0 0 0 0 1 {STEP_M * number}")
    (root / "poses.txt").write_text("\n".join(rows) + "\n")
    return root
