"""COLMAP projects with the results that the exports read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pnpdepth_cli.dataset.frame_record import CameraRecord, FrameRecord
from pnpdepth_cli.dataset.sparse_depth import read_colmap_points
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import write_depth
from tests.builders import result_record
from tests.colmap_models import HEIGHT, WIDTH, write_text_model

DEPTH = (3.6 + 0.01 * np.mgrid[:HEIGHT, :WIDTH][1]).astype(np.float32)
NAMES = ("a", "b", "c")


def project(root: Path, camera: str = "PINHOLE") -> Path:
    """A COLMAP project of three images."""
    write_text_model(root / "sparse", names=tuple(f"{n}.png" for n in NAMES), camera=camera)
    (root / "images").mkdir()
    pixels = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    for name in NAMES:
        cv2.imwrite(str(root / "images" / f"{name}.png"), pixels)
    return root


def results(root: Path, depth: np.ndarray = DEPTH, unit_scale: float | None = None) -> Path:
    """What `batch` writes for the project that the exports read."""
    folder = root / "out"
    folder.mkdir()
    for name in NAMES:
        image = root / "images" / f"{name}.png"
        seen = read_colmap_points(root, image, (HEIGHT, WIDTH), unit_scale=unit_scale)
        write_depth(folder / f"{name}_depth.exr", depth * np.float32(unit_scale or 1))
        assert seen.camera is not None
        FrameRecord(
            unit=seen.unit,
            inputs={"image": FileRecord(path=str(image), kind="image"), "sparse": seen.record},
            result=result_record(
                camera=CameraRecord.of(seen.camera, seen.pose),
                size=(WIDTH, HEIGHT),
                outputs={"valid": f"{name}_valid.png"},
            ),
        ).write(folder / f"{name}.json")
    return folder
