"""The official file of NYU Depth v2, and the file of its test set, when they lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.layouts import list_frames

h5py = pytest.importorskip("h5py")


def labeled(root: Path, count: int) -> None:
    with h5py.File(root / "nyu_depth_v2_labeled.mat", "w") as file:
        file.create_dataset("depths", shape=(count, 640, 480), dtype="<f4", chunks=(1, 64, 48))


def test_a_small_file_that_claims_a_billion_frames_is_refused(tmp_path: Path) -> None:
    labeled(tmp_path, 10**9)
    assert (tmp_path / "nyu_depth_v2_labeled.mat").stat().st_size < 10_000
    with pytest.raises(FileFormatError, match="claims 1,000,000,000 frames"):
        list_frames(tmp_path)


def test_a_test_set_that_is_larger_than_the_official_one_is_refused(tmp_path: Path) -> None:
    from scipy.io import savemat

    labeled(tmp_path, 3)
    split = tmp_path / "splits.mat"
    savemat(split, {"testNdxs": np.ones((1, 100_000), np.uint8)})
    with pytest.raises(FileFormatError, match=r"100,[0-9]{3} bytes; the official file has"):
        list_frames(tmp_path)
    savemat(split, {"testNdxs": np.array([[2], [3]])}, do_compression=True)
    assert [frame.name for frame in list_frames(tmp_path)[1].frames] == ["0002", "0003"]


def test_a_test_set_that_decompresses_to_much_more_is_read_no_further(tmp_path: Path) -> None:
    from scipy.io import savemat

    labeled(tmp_path, 3)
    numbers = np.full((1, 8_000_000), 9, np.uint8)
    numbers[0, :100_000] = 3
    savemat(tmp_path / "splits.mat", {"testNdxs": numbers}, do_compression=True)
    assert [frame.name for frame in list_frames(tmp_path)[1].frames] == ["0003"]
