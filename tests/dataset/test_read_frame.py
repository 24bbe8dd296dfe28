"""A frame on disk as it is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.io.depth import read_depth

INDOOR = Path(__file__).parents[2] / "samples" / "indoor"


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
