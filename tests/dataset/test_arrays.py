"""The camera of a frame is found, recorded, and used for its point cloud."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.dataset.arrays import camera_of_file
from pnpdepth_cli.dataset.frame_record import CameraRecord, FrameRecord
from pnpdepth_cli.dataset.read_options import ScanOptions
from pnpdepth_cli.errors import SizeError, UsageError
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from tests.commands.batches import batch, done, pairs_on_disk
from tests.commands.frames import FrameOnDisk, frame_on_disk, run

CALIB = "K: [50, 0, 30, 0, 50, 20, 0, 0, 1]\n"


def camera_of(record: FrameRecord) -> CameraRecord:
    assert record.camera is not None
    return record.camera


def test_a_calibration_beside_a_depth_map_is_that_of_the_camera(frame: FrameOnDisk) -> None:
    calib = frame.folder / "k.txt"
    calib.write_text(f"{CALIB}distortion: [-0.1, 0, 0, 0]\n")
    record = run(frame, scan=ScanOptions(calib=calib))
    assert camera_of(record).intrinsics == [[50, 0, 30], [0, 50, 20], [0, 0, 1]]
    assert camera_of(record).distortion == [-0.1, 0, 0, 0]
    calib.write_text(f"{CALIB}size: [64, 48]\n")
    with pytest.raises(SizeError, match=r"\b64×48"):
        run(frame, scan=ScanOptions(calib=calib), overwrite=True)


def test_exif_is_used_where_nothing_else_gives_the_camera_of_a_view(frame: FrameOnDisk) -> None:
    image = Image.open(frame.image)
    exif = image.getexif()
    exif[0x8769] = {0xA405: 26}
    photo = frame.folder / "img.jpg"
    image.save(photo, exif=exif)
    record = run(replace(frame, image=photo), view_3d=True)
    assert " 26 mm" in camera_of(record).source
    assert any("no distortion (EXIF" in note for note in record.notes)


def test_the_camera_of_a_part_sees_the_same_directions(tmp_path: Path) -> None:
    part = FramePart(halved=True, crop=(20, 30), anchor="bottom")
    frame, calib = frame_on_disk(tmp_path, 60, 80), tmp_path / "k.txt"
    calib.write_text(CALIB)
    record = run(frame, part=part, scan=ScanOptions(calib=calib))
    camera, _ = camera_of(record).read()
    whole, _ = camera_of_file(calib, None, (60, 80))
    xy = np.array([[33.0, 41.0], [50.0, 47.0]])
    rays = unproject(whole, xy, np.ones(2))
    assert pixels_of(camera, rays) == pytest.approx(part.in_crop(xy, (60, 80)), abs=1e-4)


def test_a_batch_records_the_cameras_of_its_frames(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path, ("a",))
    with pytest.raises(UsageError, match="--calib"):
        batch(root, html=tmp_path.parent / "report", html_3d=True)
    for focal_px in ("50", "60"):  # another calibration makes the frame new
        (root / "calib.txt").write_text(CALIB.replace("50", focal_px))
        assert done(root) == ["a"]
    record = FrameRecord.read(root / "out/a.json")
    assert camera_of(record).intrinsics[0][0] == 60
