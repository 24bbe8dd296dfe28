"""The gate says nothing of good inputs, of the samples and of real frames, in all formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions, ScanOptions
from pnpdepth_cli.dataset.plausible import plausible_map
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.scans import read_scan
from tests.io.scan_files import compressed_pcd_bytes, npy_bytes, pcd_bytes, ply_bytes

SAMPLES = Path(__file__).parents[2] / "samples"
SCALES = {
    "tum_fr": 5000.0, "icl_nuim": 5000.0, "7scenes": 1000.0, "realsense": 1000.0,
    "metric3d": 1000.0, "kitti": 256.0, "nyu": None, "samples": None,
}  # fmt: skip
SPOKEN = ("warning", "without return", "that is none", "far plane", "1,000 times", "implausible")
"""What the lines of the gate's rules have, but not the line of a good file."""


def said_of(scale: float | None = None, **files: Path) -> list[str]:
    """What the gate says of a frame whose points are all kept."""
    options = ReadOptions(scan=ScanOptions(keep_occluded=True))
    notes = read_frame(FrameFiles(sparse_scale=scale, **files), options).notes
    return [note for note in notes if any(word in note for word in SPOKEN)]


def words(path: Path) -> list[str]:
    """What the gate says of one depth map, as ground truth, and as sparse depth."""
    scale = next(value for name, value in SCALES.items() if name in str(path))
    depth = read_depth(path, scale=scale)
    values, notes = plausible_map(depth.values, depth.reading, "gt", "--gt-scale", scale)
    np.testing.assert_array_equal(values, depth.values)
    return [*notes, *said_of(scale, sparse=path)]


PATTERNS = (
    "depth/*.png", "*.depth.png", "sparse/*.png", "gt/*.png", "velodyne_raw/*.png", "gt.png",
    "groundtruth/*.png", "sync_depth*.png", "sparse.png", "image_02/*.npz", "depth.npy",
)  # fmt: skip


def maps(root: Path) -> list[Path]:
    return sorted({path for pattern in PATTERNS for path in root.glob(f"**/{pattern}")})


@pytest.mark.slow
def test_nothing_is_said_of_the_samples_in_any_format(tmp_path: Path) -> None:
    for path in maps(SAMPLES):
        assert words(path) == [], path
    values = read_depth(SAMPLES / "street" / "sparse.png").values
    rows, columns = np.nonzero(values)
    listed = np.column_stack([columns, rows, values[rows, columns]])
    np.save(tmp_path / "list.npy", listed)
    np.savetxt(tmp_path / "list.txt", listed)
    for suffix in (".npy", ".exr", ".tiff", ".pfm", ".npz"):
        write_depth(tmp_path / f"map{suffix}", values)
    image, calib = (SAMPLES / "street" / name for name in ("rgb.png", "calib.txt"))
    for path in sorted(tmp_path.iterdir()):
        assert said_of(image=image, sparse=path, calib=calib) == [], path


def test_nothing_is_said_of_real_frames(shared_data: Path) -> None:
    paths = maps(shared_data)
    assert len(paths) > 120
    for path in paths:
        assert words(path) == [], path


def test_nothing_is_said_of_scans_in_any_format(shared_data: Path, tmp_path: Path) -> None:
    street = SAMPLES / "street"
    kitti = shared_data / "kitti_object"
    frames = [(street / "rgb.png", street / "000000.bin", street / "calib.txt")]
    for scan in sorted((kitti / "velodyne").glob("*.bin")):
        name = scan.stem
        frames += [(kitti / f"image_2/{name}.png", scan, kitti / f"calib/{name}.txt")]
    for image, scan, calib in frames:
        xyz = read_scan(scan)[0]
        whole = np.column_stack([xyz, np.ones((len(xyz), 3))]).astype("<f4")
        formats = {
            "a.npy": npy_bytes(xyz),
            "a.pcd": pcd_bytes(xyz),
            "b.pcd": compressed_pcd_bytes(xyz),
            "a.ply": ply_bytes(xyz),
            "6.bin": whole.tobytes(),
        }
        for name, content in formats.items():
            (tmp_path / name).write_bytes(content)
        for path in (scan, *(tmp_path / name for name in formats)):
            assert said_of(image=image, sparse=path, calib=calib) == [], path
