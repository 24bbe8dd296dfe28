"""Makes samples/photos; run with -m and --out samples.

Photos of a room through a lens with radial distortion, and their sparse model by COLMAP: features,
matching and mapping with known intrinsics. Needs pycolmap.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from model_zoo_defs.training.rendering.camera_effects import photographed
from model_zoo_defs.training.rendering.make_samples import INDOOR_SCALE, SAMPLE_SEED, write_depth
from model_zoo_defs.training.rendering.shading import seen
from model_zoo_defs.training.rendering.shapes import FloatArray, rotation
from model_zoo_defs.training.scenes.scenes import build, generator, pick_view
from model_zoo_defs.training.scenes.world import View
from pnpdepth_cli.sensors.lens import undistort

SCENE = 6
"""Number of the room among those of the reserved seed."""
VIEW = 1
"""Number of the view that the first photo is taken near."""
PHOTOS = 8
WITH_GROUND_TRUTH = (3, 4)
"""Numbers of the photos whose true depth is written."""
HEIGHT = 360
WIDTH = 480
DISTORTION = (-0.12, 0.0, 0.0, 0.0)
"""Of the lens: k1, k2, p1 and p2 of OpenCV's radial-tangential model."""
_AMBIENT_RAYS = 8
"""Rays a pixel for ambient occlusion."""
_STEP_M = 0.12
"""Distance between two photos."""
_PIVOT_M = 3.0
"""Distance of the point that the camera keeps looking at."""


@dataclass(frozen=True, kw_only=True)
class LensView(View):
    """A camera with radial distortion."""

    def rays(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Returns origins and directions (n, 3) of the rays through these distorted pixels."""
        seen_at = np.column_stack(
            [
                (np.asarray(u, np.float64).ravel() - self.cx) / self.fx,
                (np.asarray(v, np.float64).ravel() - self.cy) / self.fy,
            ]
        )
        x, y = undistort(seen_at, "radial-tangential", DISTORTION).T
        return super().rays(x * self.fx + self.cx, y * self.fy + self.cy)


def make_photos(folder: Path) -> float:
    """Writes images/*.jpg and gt/*.png of a camera in a room; returns its focal length, pixels."""
    world, plan = build("room", generator(SAMPLE_SEED, SCENE, 0))
    rng = generator(SAMPLE_SEED, SCENE, 1 + VIEW)
    first = pick_view(world, plan, "room", rng, size=(HEIGHT, WIDTH))
    for name in ("images", "gt"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for number in range(PHOTOS):
        view = _moved(first, number)
        colour, depth = seen(world, view, rng, ambient_rays=_AMBIENT_RAYS)
        photo = Image.fromarray(photographed(colour, generator(SAMPLE_SEED, 0, 0), clean=True))
        photo.save(folder / "images" / f"{number:02}.jpg", quality=92)
        if number in WITH_GROUND_TRUTH:
            write_depth(folder / "gt" / f"{number:02}.png", depth, INDOOR_SCALE)

    return float(first.fx)


def _moved(first: View, number: int) -> LensView:
    """Returns the view of a photo: beside the first view, turned to keep looking at one point.

    The photos lie in a row whose middle is the first view; every second one is 0.1 m lower.
    """
    along = (number - (PHOTOS - 1) / 2) * _STEP_M
    right = first.axes[:, 0]
    down = first.axes[:, 1]
    position = first.position + along * right + 0.1 * (number % 2) * down
    turn = rotation(along / _PIVOT_M, 0.0, 0.0).astype(np.float32)
    moved = replace(first, position=position.astype(np.float32), axes=turn @ first.axes)
    values = {name: getattr(moved, name) for name in View.__annotations__}
    return LensView(**values)


def reconstruct(folder: Path, focal_px: float) -> None:
    """Writes sparse/0/, the model of the photos in images/, taken by one calibrated camera."""
    import pycolmap

    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory() as work:
        database = Path(work) / "database.db"
        # Features, with known intrinsics, and their matches.
        pycolmap.extract_features(
            database,
            folder / "images",
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(
                camera_model="SIMPLE_RADIAL",
                camera_params=f"{focal_px},{WIDTH / 2},{HEIGHT / 2},{DISTORTION[0]}",
            ),
            device=pycolmap.Device.cpu,
        )
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
        # The largest model of incremental mapping.
        options = pycolmap.IncrementalPipelineOptions(
            ba_refine_focal_length=False, ba_refine_extra_params=False, random_seed=0
        )
        models = pycolmap.incremental_mapping(
            database, folder / "images", Path(work) / "sparse", options
        )
        best = max(models.values(), key=lambda model: model.num_reg_images())
        target = folder / "sparse" / "0"
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        best.write_binary(target)


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the photos and their model below the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Render photos and run COLMAP on them.")
    parser.add_argument("--out", type=Path, required=True)
    folder = parser.parse_args(arguments).out / "photos"
    reconstruct(folder, make_photos(folder))


if __name__ == "__main__":
    main()
