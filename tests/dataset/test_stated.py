"""What a user states of directions, axes, layouts and units is obeyed or refused, in all files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from pnpdepth_cli import choices
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions, ScanOptions
from pnpdepth_cli.dataset.layouts import list_frames
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.poses import poses_of_frames
from pnpdepth_cli.io.scans import read_scan
from tests.colmap_models import write_binary_model, write_text_model
from tests.data_sets import MAKERS
from tests.dataset.test_evidence import FLOATS, INDOOR, TRUTH, save, some, warnings_of
from tests.io.scan_files import FILES as SCANS

STREET = Path(__file__).parents[2] / "samples" / "street"


def read(sparse: Path, image: Path, **options: object) -> Frame:
    return read_frame(FrameFiles(image=image, sparse=sparse), ReadOptions(**options))


@pytest.mark.parametrize("name", SCANS)
def test_the_direction_of_extrinsics_is_obeyed_or_refused_of_every_scan(
    name: str, tmp_path: Path
) -> None:
    xyz = read_scan(STREET / "000000.bin")[0][::20]
    (tmp_path / name).write_bytes(SCANS[name](xyz))
    stated = read_calibration(STREET / "calib.txt").scanner
    assert stated is not None
    for file, pose in (("right.txt", stated), ("inverse.txt", stated.inverse())):
        np.savetxt(tmp_path / file, pose.square()[:3])
    k = read_calibration(STREET / "calib.txt").camera.intrinsics.ravel().tolist()
    (tmp_path / "k.yaml").write_text(f"K: {k}\n")
    both = [
        ScanOptions(calib=tmp_path / "k.yaml", extrinsics=tmp_path / file, keep_occluded=True)
        for file in ("right.txt", "inverse.txt")
    ]
    frame = read(tmp_path / name, STREET / "rgb.png", scan=both[0])
    alone = ScanOptions(calib=STREET / "calib.txt", keep_occluded=True)
    expected = read(tmp_path / name, STREET / "rgb.png", scan=alone)
    np.testing.assert_allclose(frame.points.xy, expected.points.xy, atol=1e-3)
    try:
        inverted = read(tmp_path / name, STREET / "rgb.png", scan=both[1])
    except (InputError, UsageError):
        return
    assert any("inverse" in note for note in warnings_of(inverted))


@pytest.mark.parametrize("away", [np.array([50.0, 20, 3]), np.array([448123.0, 5411876, 312])])
@pytest.mark.parametrize("suffix", [".npy", ".csv", ".txt"])
def test_a_list_without_header_and_with_a_pose_is_a_cloud(
    suffix: str, away: np.ndarray, tmp_path: Path
) -> None:
    np.save(tmp_path / "scan.npy", read_scan(STREET / "000000.bin")[0][::4])
    xyz = np.load(tmp_path / "scan.npy").astype(float)
    stored = xyz + away
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".npy":
        np.save(path, stored)
    else:
        np.savetxt(path, stored, fmt="%.4f", delimiter="," if suffix == ".csv" else " ")
    right = read_calibration(STREET / "calib.txt")
    assert right.scanner is not None
    pose = right.scanner.square()[:3]
    pose[:, 3] -= pose[:, :3] @ away
    np.savetxt(tmp_path / "pose.txt", pose)
    text = f"K: {right.camera.intrinsics.ravel().tolist()}\n"
    (tmp_path / "k.yaml").write_text(text)
    shift = f"R: {pose[:, :3].tolist()}\nt: {pose[:, 3].tolist()}\n"
    (tmp_path / "both.yaml").write_text(text + shift)
    expected = read(
        tmp_path / "scan.npy",
        STREET / "rgb.png",
        scan=ScanOptions(calib=STREET / "calib.txt", keep_occluded=True),
    )
    for scan in (
        ScanOptions(calib=tmp_path / "k.yaml", extrinsics=tmp_path / "pose.txt"),
        ScanOptions(calib=tmp_path / "both.yaml"),
    ):
        scan = replace(scan, keep_occluded=True)
        frame = read(path, STREET / "rgb.png", scan=scan)
        assert warnings_of(frame) == []
        assert len(frame.points) == pytest.approx(len(expected.points), rel=1e-3)
        farthest = float(expected.points.depth.max())
        assert float(frame.points.depth.max()) == pytest.approx(farthest, abs=0.02)


@pytest.mark.parametrize("name", FLOATS)
def test_a_list_of_pixels_beside_a_calibration_stays_one(name: str, tmp_path: Path) -> None:
    right = some(TRUTH).astype(np.float32)
    path = save(tmp_path / name, right)
    text = "K: [525, 0, 319.5, 0, 525, 239.5, 0, 0, 1]\n"
    (tmp_path / "k.yaml").write_text(text)
    frame = read(path, INDOOR / "rgb.png", scan=ScanOptions(calib=tmp_path / "k.yaml"))
    x, y = frame.points.xy.numpy().astype(int).T
    np.testing.assert_allclose(frame.points.depth, right[y, x], rtol=1e-6)


@pytest.mark.parametrize("name", FLOATS)
def test_stated_distances_become_depth_in_every_file_of_floats(name: str, tmp_path: Path) -> None:
    right = some(TRUTH).astype(np.float32)
    row, column = np.indices(right.shape)
    rays = np.sqrt(((column - 319.5) / 525) ** 2 + ((row - 239.5) / 525) ** 2 + 1)
    path = save(tmp_path / name, (right * rays).astype(np.float32))
    (tmp_path / "k.yaml").write_text("K: [525, 0, 319.5, 0, 525, 239.5, 0, 0, 1]\n")
    scan = ScanOptions(calib=tmp_path / "k.yaml")
    frame = read(path, INDOOR / "rgb.png", scan=scan, sparse_range=True)
    x, y = frame.points.xy.numpy().astype(int).T
    np.testing.assert_allclose(frame.points.depth, right[y, x], rtol=1e-4)
    with pytest.raises(UsageError):
        read(path, INDOOR / "rgb.png", sparse_range=True)


@pytest.mark.parametrize("is_binary", [False, True])
def test_the_unit_of_a_model_is_obeyed(is_binary: bool, tmp_path: Path) -> None:
    (write_binary_model if is_binary else write_text_model)(tmp_path / "model")
    image = tmp_path / ("dir/1.png" if is_binary else "a.png")
    image.parent.mkdir(exist_ok=True)
    Image.new("RGB", (64, 48), (90, 120, 60)).save(image)
    one = read(tmp_path / "model", image, unit_scale=1.0)
    two = read(tmp_path / "model", image, unit_scale=2.5)
    np.testing.assert_allclose(two.points.depth, 2.5 * one.points.depth, rtol=1e-6)
    with pytest.raises(UsageError):
        read(tmp_path / "model", image, depth_scale=1000.0)


TURN = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
CAMERAS = [np.column_stack([TURN, np.array([step, 2.0, 3.0])]) for step in (0.0, 0.5, 1.0)]


def rows_of(poses: list[np.ndarray], kind: str) -> str:
    """Poses as a file of this kind has them."""
    lines = list[str]()
    for number, pose in enumerate(poses):
        square = np.vstack([pose, [0, 0, 0, 1]])
        numbers = {"12": pose.ravel(), "16": square.ravel()}.get(kind)
        if numbers is None:
            quaternion = Rotation.from_matrix(pose[:, :3]).as_quat()
            numbers = [float(number), *pose[:, 3], *quaternion]
        lines.append(" ".join(f"{value:.9f}" for value in numbers))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("file", ["12", "16", "tum", "transforms.json"])
@pytest.mark.parametrize("kind", choices.POSE_KINDS)
def test_a_stated_kind_of_poses_is_obeyed_in_every_file(
    file: str, kind: str, tmp_path: Path
) -> None:
    # The same cameras, as poses of this kind store them.
    stored = list[np.ndarray]()
    for pose in CAMERAS:
        square = np.vstack([pose, [0, 0, 0, 1]])
        if kind == "opengl":
            square = square @ np.diag([1, -1, -1, 1])
        elif kind == "world-to-camera":
            square = np.linalg.inv(square)
        stored.append(square[:3])
    path = tmp_path / (file if file.endswith(".json") else "poses.txt")
    names = ["0.000", "1.000", "2.000"]
    if file == "transforms.json":
        frames = [
            {"file_path": f"{name}.png", "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]}
            for name, pose in zip(names, stored, strict=True)
        ]
        path.write_text(json.dumps({"frames": frames}))
    else:
        path.write_text(rows_of(stored, file))
    poses, how = poses_of_frames(path, names, kind)
    np.testing.assert_allclose(poses, CAMERAS, atol=1e-7)
    assert ("OpenGL" in how) == (kind == "opengl")


@pytest.mark.parametrize("name", MAKERS)
def test_a_stated_layout_is_obeyed_or_refused(name: str, tmp_path: Path) -> None:
    make, expected = MAKERS[name]
    make(tmp_path)
    for stated in choices.LAYOUTS:
        try:
            layout, frames, _ = list_frames(tmp_path, stated)
        except InputError:
            assert stated != name
            continue
        assert layout == stated
        if stated == name:
            assert [frame.name for frame in frames] == expected
