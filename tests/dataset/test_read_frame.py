"""A frame of files, whole and in part, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.protocols import FramePart

STREET = Path(__file__).parents[2] / "samples" / "street"
"""An image of 375 × 1242 pixels, its scan, calibration and sparse depth."""
INDOOR = STREET.parent / "indoor"


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


@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_metres_of_the_ground_truth_are_doubted_only_where_the_points_have_others(
    factor: float, tmp_path: Path
) -> None:
    gt = tmp_path / "gt.npy"
    # Multiplied by a little, so that the points are no part of the ground truth.
    np.save(gt, read_depth(INDOOR / "gt.png").values * np.float32(1.001 * factor))
    files = FrameFiles(image=INDOOR / "rgb.png", sparse=INDOOR / "sparse.png", gt=gt)
    notes = read_frame(files, ReadOptions()).notes
    warnings = [note for note in notes if note.startswith("warning")]
    assert len(warnings) == (factor != 1)
    assert all(str(gt) in warning or "ground truth" in warning for warning in warnings)


@pytest.mark.parametrize(("count", "names"), [(1, ["depth"]), (2, ["depth 1", "depth 2"])])
def test_one_depth_map_has_no_number_and_two_have_theirs(count: int, names: list[str]) -> None:
    maps = (INDOOR / "predicted.npy",) * count
    files = FrameFiles(image=INDOOR / "rgb.png", sparse=INDOOR / "sparse.png", depths=maps)
    frame = read_frame(files, ReadOptions())
    assert [name for name in frame.sources if name.startswith("depth")] == names
