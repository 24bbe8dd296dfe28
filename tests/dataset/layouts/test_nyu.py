"""NYU Depth v2, and what is read of HDF5 files: whole, damaged, and lying."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.dataset.arrays import depth_of, read_image, shape_of
from pnpdepth_cli.dataset.frame_files import FrameFiles, Hdf5Array
from pnpdepth_cli.dataset.layouts import list_frames
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.protocols import ODOMETRY_PART
from tests.data_sets import ground_truth, nyu_h5, nyu_mat, read_frames
from tests.empty_files import touch

h5py = pytest.importorskip("h5py")


def image_of(frame: FrameFiles) -> np.ndarray:
    assert frame.image is not None
    return frame.part.apply(read_image(frame.image))


def test_nyu_frames_come_halved_and_cropped_to_228_by_304(tmp_path: Path) -> None:
    nyu_h5(tmp_path / "h5")
    frame = read_frames(tmp_path / "h5")[1]
    assert image_of(frame).shape == (228, 304, 3)
    assert ground_truth(frame).tolist() == np.full((228, 304), 9.0).tolist()
    nyu_mat(tmp_path / "mat")
    frame = read_frames(tmp_path / "mat")[2]
    np.testing.assert_array_equal(image_of(frame), np.float32(2) / np.float32(255))
    # columns 8 … 311 of every second pixel, 1 3 5 …: column c holds 2 c + 2 metres
    want = 2 * np.arange(8, 312) + 2
    assert (ground_truth(frame) == want).all()


def test_kitti_in_files_of_the_same_kind_is_cut_as_kitti_is(tmp_path: Path) -> None:
    depth = np.arange(376, dtype=np.float32)[:, None] + np.ones(1241, np.float32)
    with h5py.File(tmp_path / "00001.h5", "w") as file:
        file["rgb"], file["depth"] = np.zeros((3, 376, 1241), np.uint8), depth
    (frame,) = read_frames(tmp_path)
    assert frame.part == ODOMETRY_PART
    assert image_of(frame).shape == (228, 912, 3)
    np.testing.assert_array_equal(ground_truth(frame), depth[148:, 164:1076])


def test_the_official_file_is_split_by_the_file_beside_it(tmp_path: Path) -> None:
    nyu_mat(tmp_path)
    touch(tmp_path / "splits.mat")
    with pytest.raises(InputError, match=r"splits\.mat is not read; write the numbers"):
        read_frames(tmp_path)
    (tmp_path / "test.txt").write_text("2\n4\n")
    frames = read_frames(tmp_path)
    assert [frame.name for frame in frames] == ["0002", "0004"]
    assert [frame.image.index for frame in frames] == [1, 3]  # type: ignore[union-attr]
    (tmp_path / "test.txt").write_text("2\n5\n")
    with pytest.raises(FileFormatError, match="from 1 to 4"):
        read_frames(tmp_path)


def test_an_hdf5_file_that_is_damaged_is_named(tmp_path: Path) -> None:
    nyu_h5(tmp_path)
    path = tmp_path / "official" / "00001.h5"
    frame = read_frames(tmp_path)[0]
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(FileFormatError, match="cannot be read as HDF5"):
        ground_truth(frame)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("external link", "stored outside the file"),
        ("soft link", "stored outside the file"),
        ("external storage", "stored outside the file"),
        ("another name", "has no array depth"),
    ],
)
def test_an_array_that_is_elsewhere_is_refused(tmp_path: Path, kind: str, message: str) -> None:
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["depth"] = np.ones((4, 4), np.float32)
    (tmp_path / "raw").write_bytes(np.ones((4, 4), np.float32).tobytes())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if kind == "external link":
            file["depth"] = h5py.ExternalLink("secret.h5", "depth")
        elif kind == "soft link":
            file["depth"] = h5py.SoftLink("/other/depth")
            file["other"] = h5py.ExternalLink("secret.h5", "/")
        elif kind == "external storage":
            raw = [(str(tmp_path / "raw"), 0, 64)]
            file.create_dataset("depth", shape=(4, 4), dtype="<f4", external=raw)
    with pytest.raises(FileFormatError, match=message):
        shape_of(tmp_path / "a.h5", "depth")


def test_a_small_file_cannot_claim_a_billion_frames_or_values(tmp_path: Path) -> None:
    path = tmp_path / "nyu_depth_v2_labeled.mat"
    with h5py.File(path, "w") as file:
        file.create_dataset("depths", shape=(10**9, 640, 480), dtype="<f4", chunks=(1, 64, 48))
        file.create_dataset("depth", shape=(10**5, 10**5), dtype="<f4", chunks=(100, 100))
    assert path.stat().st_size < 10_000
    with pytest.raises(FileFormatError, match="claims 1,000,000,000 frames"):
        list_frames(tmp_path)
    with pytest.raises(FileFormatError, match=r"\b10,000,000,000 values"):
        depth_of(Hdf5Array(path=path, name="depth", axes=(0, 1)))
