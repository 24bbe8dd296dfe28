"""Renders samples/drive/: python -m model_zoo_defs.training.rendering.make_drive_sample.

Three frames of a street, 0.6 m apart, with projected laser scans, true depth, intrinsics and the
poses of the camera, in the layout `pairs`. The scene is that of samples/street at half the size.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from model_zoo_defs.training.rendering.camera_effects import photographed
from model_zoo_defs.training.rendering.make_samples import (
    SAMPLE_SEED,
    STREET_SCALE,
    STREET_SCENE,
    laser_axes,
    laser_scan,
    projected,
    write_depth,
)
from model_zoo_defs.training.rendering.shading import seen
from model_zoo_defs.training.scenes.scenes import build, generator
from model_zoo_defs.training.scenes.world import looking

FRAMES = 3
STEP_M = 0.6
"""Distance from frame to frame."""
_AMBIENT_RAYS = 12
"""Rays a pixel for ambient occlusion."""
# KITTI's camera, as `make_samples` has it, at half the size.
_SIZE = (187, 621)
_FOCAL_PX = 360.77
_CX = 304.53
_CY = 86.18
_POSE = "1 0 0 0 0 1 0 0 0 0 1 {ahead:g}\n"  # the camera moves along its own axis


def make_drive(folder: Path) -> None:
    """Writes rgb/, sparse/, gt/ and calib/ of the frames, and poses.txt."""
    rng = generator(SAMPLE_SEED, STREET_SCENE, 0)
    # The scene of samples/street. The camera is in the right lane, 1.65 m above the road, and
    # looks along the street, a hair to the left and down.
    world, plan = build("street", rng)
    start = looking(
        (float(plan.high[0]) * 0.55, 0.0, 1.65), (0.02, -0.01, 0.0), fov_deg=80, size=_SIZE
    )
    start = replace(start, fx=_FOCAL_PX, fy=_FOCAL_PX, cx=_CX, cy=_CY)
    # A frame every step, along the camera's own axis.
    for kind in ("rgb", "sparse", "gt", "calib"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    turn = laser_axes()
    for number in range(FRAMES):
        name = f"drive_{number:03}"
        ahead = STEP_M * number
        view = replace(
            start, position=start.position + (start.axes[:, 2] * ahead).astype(np.float32)
        )
        colour, depth = seen(world, view, rng, ambient_rays=_AMBIENT_RAYS)
        image = Image.fromarray(photographed(colour, rng, clean=True))
        image.save(folder / "rgb" / f"{name}.jpg", quality=90)
        write_depth(folder / "gt" / f"{name}.png", depth, STREET_SCALE)
        scan = laser_scan(world, view, turn, rng)
        write_depth(folder / "sparse" / f"{name}.png", projected(scan, turn, view), STREET_SCALE)
        (folder / "calib" / f"{name}.txt").write_text(
            f"K: [{_FOCAL_PX}, 0, {_CX}, 0, {_FOCAL_PX}, {_CY}, 0, 0, 1]\n"
        )
    # The poses.
    poses = [_POSE.format(ahead=STEP_M * number) for number in range(FRAMES)]
    (folder / "poses.txt").write_text("".join(poses))


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the frames below the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Render samples/drive.")
    parser.add_argument("--out", type=Path, required=True)
    make_drive(parser.parse_args(arguments).out / "drive")


if __name__ == "__main__":
    main()
