"""The camera of a frame is found, recorded, and used for its point cloud."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.refinement.frame_camera import (
    camera_from_json,
    camera_of_fov,
    camera_to_json,
)
from pnpdepth_cli.commands.sparse.options import ScanOptions
from pnpdepth_cli.errors import SizeError, UsageError
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.point_cloud import depth_edges
from tests.colmap_models import HEIGHT, WIDTH, write_text_model
from tests.commands.batches import batch, done, pairs_on_disk
from tests.commands.frames import FrameOnDisk, frame_on_disk, run
from tests.commands.scan_frames import FOCAL_PX, scan_on_disk
from tests.kitti_drives import write_calibrations


def points_of(path: Path) -> np.ndarray:
    return read_scan(path).points[:, :3]


def pixels_kept(depth: Path) -> int:
    values = read_depth(depth).values
    return int(((values > 0) & ~depth_edges(values, 0.05)).sum())


def test_the_cloud_of_a_field_of_view_has_the_points_of_the_depth(frame: FrameOnDisk) -> None:
    record = run(frame, ply=True, fov_deg=60.0, format="npy").record
    path = frame.folder / "out" / "img.ply"
    assert record["outputs"]["cloud"] == str(path)
    kept = pixels_kept(frame.folder / "out" / "img_depth.npy")
    assert record["cloud"] == {"points": kept, "frame": "camera"}
    assert len(points_of(path)) == kept > 100
    focal = 31 / math.tan(math.radians(30))  # of an image of 62×46
    assert record["camera"]["intrinsics"] == [[focal, 0, 30.5], [0, focal, 22.5], [0, 0, 1]]
    assert any("(--fov 60)" in note for note in record["notes"])


def test_a_calibration_beside_a_depth_map_is_that_of_the_camera(frame: FrameOnDisk) -> None:
    calib = frame.folder / "k.txt"
    calib.write_text("K: [50, 0, 30, 0, 50, 20, 0, 0, 1]\ndistortion: [-0.1, 0, 0, 0]\n")
    record = run(frame, ply=True, scan=ScanOptions(calib=calib)).record
    assert record["camera"]["intrinsics"] == [[50, 0, 30], [0, 50, 20], [0, 0, 1]]
    assert record["camera"]["distortion"] == [-0.1, 0, 0, 0]
    calib.write_text("K: [50, 0, 30, 0, 50, 20, 0, 0, 1]\nsize: [64, 48]\n")
    with pytest.raises(SizeError, match=r"\b64×48"):
        run(frame, ply=True, scan=ScanOptions(calib=calib), overwrite=True)


def test_kittis_camera_is_known_without_a_calibration_of_the_scanner(frame: FrameOnDisk) -> None:
    write_calibrations(frame.folder / "calib", size=frame.depth.shape)
    (frame.folder / "calib/calib_velo_to_cam.txt").unlink()
    calib = frame.folder / "calib/calib_cam_to_cam.txt"
    record = run(frame, ply=True, scan=ScanOptions(calib=calib)).record
    assert record["camera"]["intrinsics"][0][0] == 60
    assert record["cloud"]["points"] > 100


def test_exif_is_used_where_nothing_else_gives_the_camera(frame: FrameOnDisk) -> None:
    image = Image.open(frame.image)
    exif = image.getexif()
    exif[0x8769] = {0xA405: 26}
    photo = frame.folder / "img.jpg"
    image.save(photo, exif=exif)
    record = run(replace(frame, image=photo), ply=True).record
    assert " 26 mm" in record["camera"]["source"]
    assert any("no distortion (EXIF" in note for note in record["notes"])


def test_a_colmap_model_gives_camera_and_pose(tmp_path: Path) -> None:
    frame = frame_on_disk(tmp_path, HEIGHT, WIDTH)
    write_text_model(tmp_path / "sparse", names=("x.png", "img.png"), camera="SIMPLE_RADIAL")
    with pytest.raises(UsageError, match=r"the camera is known .* leave out --fov"):
        run(frame, fov_deg=60.0, sparse=tmp_path / "sparse")
    record = run(frame, ply=True, sparse=tmp_path / "sparse").record
    assert record["cloud"]["frame"] == "world"
    assert record["camera"]["distortion"] == [-0.1, 0, 0, 0]
    assert record["camera"]["pose"] == [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0]]
    x, z = points_of(tmp_path / "out" / "img.ply").T[[0, 2]]
    assert 3 < np.median(z) < 5
    camera, _ = camera_from_json(record["camera"])
    corners = np.array([[0, 0], [WIDTH - 1, HEIGHT - 1]])
    left, right = unproject(camera, corners, np.ones(2))[:, 0]
    assert x.min() == pytest.approx(left * z[x.argmin()] - 0.1, abs=0.3)
    assert x.max() == pytest.approx(right * z[x.argmax()] - 0.1, abs=0.3)


def test_a_scan_gives_the_camera_of_its_calibration(tmp_path: Path) -> None:
    frame, scan = frame_on_disk(tmp_path), scan_on_disk(tmp_path)
    changes = {"image": scan.image, "sparse": scan.scan, "scan": ScanOptions(calib=scan.calib)}
    record = run(frame, ply=True, **changes).record
    assert record["camera"]["intrinsics"] == [[FOCAL_PX, 0, 31.5], [0, FOCAL_PX, 23.5], [0, 0, 1]]
    assert record["cloud"]["frame"] == "camera"
    assert record["cloud"]["points"] == len(points_of(tmp_path / "out" / "img.ply")) > 100


def test_the_camera_of_a_part_sees_the_same_directions(tmp_path: Path) -> None:
    part = FramePart(halved=True, crop=(20, 30), anchor="bottom")
    outputs = {"ply": True, "fov_deg": 70.0}
    frame = frame_on_disk(tmp_path, 60, 80)
    record = run(frame, part=part, **outputs).record
    camera, whole = camera_from_json(record["camera"])[0], camera_of_fov(70, (60, 80))
    xy = np.array([[33.0, 41.0], [50.0, 47.0]])
    rays = unproject(whole, xy, np.ones(2))
    assert pixels_of(camera, rays) == pytest.approx(part.in_crop(xy, (60, 80)), abs=1e-4)


def test_a_record_holds_the_camera_exactly() -> None:
    pose = np.column_stack([np.eye(3), [0.1, 0.2, 0.3]])
    camera = Camera(
        intrinsics=np.array([[50.1, 0, 31.3], [0, 51, 22], [0, 0, 1]]),
        distortion=(0.1, 0.2, 0.0, 0.0),
        lens="fisheye",
        source="s",
    )
    entry = json.loads(json.dumps(camera_to_json(camera, pose)))
    again, pose_again = camera_from_json(entry)
    assert camera_to_json(again, pose_again) == entry
    assert (again.intrinsics == camera.intrinsics).all()


def test_a_batch_writes_a_cloud_of_each_frame_and_a_lost_one_again(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path, ("a", "b"))
    with pytest.raises(UsageError, match="--ply needs the camera"):
        batch(root, refine={"ply": True})
    (root / "calib.txt").write_text("K: [50, 0, 30, 0, 50, 20, 0, 0, 1]\n")
    assert done(root, refine={"ply": True}) == ["a", "b"]
    (root / "out/b.ply").unlink()
    assert done(root, refine={"ply": True}) == ["b"]
    assert len(points_of(root / "out/b.ply")) > 100
    (root / "calib.txt").write_text("K: [60, 0, 30, 0, 60, 20, 0, 0, 1]\n")
    assert done(root, refine={"ply": True}) == ["a", "b"]
