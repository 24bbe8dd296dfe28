"""One valid file of each kind, and the command line that reads it; a module for each part of io."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pnpdepth_cli.io.depth import write_depth
from tests.fuzz.seeds import cameras, data_sets, networks, pixels, records, scans
from tests.fuzz.seeds.seed import HEIGHT, WIDTH, Seed

__all__ = ["Seed", "write_seeds"]


def write_seeds(folder: Path) -> list[Seed]:
    """Writes a valid file of each kind into the folder and returns them, in a fixed order.

    Args:
        folder: The working folder.
    """
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 9, (HEIGHT, WIDTH)).astype(np.float32)
    _write_common(folder, depth, rng)
    modules = (pixels, scans, cameras, data_sets, records, networks)
    return [seed for module in modules for seed in module.write_seeds(folder, depth, rng)]


def _write_common(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> None:
    """The valid files that commands need beside the damaged one."""
    np.save(folder / "gt.npy", depth)
    (folder / "k.txt").write_text(f"30 0 {WIDTH / 2} 0 30 {HEIGHT / 2} 0 0 1\n")
    (folder / "calib.txt").write_text(
        f"K: 30 0 {WIDTH / 2} 0 30 {HEIGHT / 2} 0 0 1\nR: 0 -1 0 0 0 -1 1 0 0\nt: 0 0 0\n"
    )
    scans.lidar_points(rng).tofile(folder / "good.bin")
    image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "rgb.png"), image)
    write_depth(folder / "sparse.png", np.where(rng.random(depth.shape) < 0.1, depth, 0))
