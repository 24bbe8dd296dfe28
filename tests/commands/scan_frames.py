"""A small scene on disk: a scanner's view of a wall, its calibration, an image and the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.depth import write_depth

FOCAL_PX, HEIGHT, WIDTH = 60.0, 48, 64
CALIBRATION = f"""K: [{FOCAL_PX}, 0, 31.5, 0, {FOCAL_PX}, 23.5, 0, 0, 1]
R: [0, -1, 0, 0, 0, -1, 1, 0, 0]
t: [0.1, -0.05, -0.2]
"""


@dataclass(frozen=True)
class ScanOnDisk:
    """Files of one frame; xy (N, 2) are the pixel coordinates of the scan's points."""

    folder: Path
    image: Path
    scan: Path
    calib: Path
    gt: Path
    xy: NDArray[np.float64]
    depth: NDArray[np.float64]


def scan_on_disk(folder: Path) -> ScanOnDisk:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    truth = (4 + 0.02 * x).astype(np.float32)
    image, scan, calib, gt = (folder / n for n in ("img.png", "img.bin", "calib.txt", "gt.png"))
    rgb = np.stack([255 * x / WIDTH, 255 * y / HEIGHT, 128 + 0 * x], -1).astype(np.uint8)
    cv2.imwrite(str(image), rgb)
    write_depth(gt, truth, scale=1000)
    pixels = rng.permutation(HEIGHT * WIDTH)[:150]
    xy = np.column_stack([pixels % WIDTH, pixels // WIDTH]) + rng.uniform(-0.4, 0.4, (150, 2))
    depth = 4 + 0.02 * xy[:, 0]
    in_camera = np.column_stack([(xy - [31.5, 23.5]) / FOCAL_PX, np.ones(150)]) * depth[:, None]
    turn = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    points = (in_camera - [0.1, -0.05, -0.2]) @ turn
    np.column_stack([points, np.zeros(150)]).astype("<f4").tofile(scan)
    calib.write_text(CALIBRATION)
    return ScanOnDisk(folder, image, scan, calib, gt, xy, depth)
