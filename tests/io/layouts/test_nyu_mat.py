"""The official file of NYU Depth v2, and the file of its test set, when they lie."""

from __future__ import annotations

from pathlib import Path

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
