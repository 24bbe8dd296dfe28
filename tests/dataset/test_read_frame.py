"""A frame of files, whole and in part."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.protocols import FramePart

STREET = Path(__file__).parents[2] / "samples" / "street"
"""An image of 375 × 1242 pixels, its scan, calibration and sparse depth."""


@pytest.mark.parametrize("name", ["000000.bin", "sparse.png"])
def test_a_part_of_a_frame_is_the_same_without_its_image(name: str, tmp_path: Path) -> None:
    calib = tmp_path / "calib.txt"
    text = (STREET / "calib.txt").read_text()
    calib.write_text(f"{text}\nS_rect_02: 1242 375\n")
    depth = tmp_path / "depth.npy"
    np.save(depth, np.linspace(1, 60, 375 * 1242).reshape(375, 1242))
    files = FrameFiles(
        image=STREET / "rgb.png",
        sparse=STREET / name,
        depths=(depth,),
        calib=calib,
        part=FramePart(crop=(100, 200), anchor="bottom"),
        one_view=True,
        is_first=False,
    )
    with_image = read_frame(files, ReadOptions())
    without_image = read_frame(replace(files, image=None), ReadOptions())
    assert without_image.size == with_image.size == (100, 200)
    assert with_image.camera is not None
    assert without_image.camera is not None
    np.testing.assert_array_equal(without_image.camera.intrinsics, with_image.camera.intrinsics)
    np.testing.assert_array_equal(without_image.points.xy, with_image.points.xy)
    np.testing.assert_array_equal(without_image.predicted[0], with_image.predicted[0])
