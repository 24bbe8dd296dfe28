"""Recordings of phones, as their apps write them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.dataset.layouts import list_frames
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.dataset.read_options import ReadOptions
from pnpdepth_cli.errors import InputError
from tests.colmap_models import write_text_model
from tests.data_sets import HEIGHT, WIDTH, read_frames, record3d, stray_scanner, video
from tests.empty_files import touch


@pytest.mark.parametrize(("make", "confident"), [(stray_scanner, 0.75), (record3d, 1.0)])
def test_a_phones_recording_has_metres_camera_pose_and_confident_points(
    make: Callable[[Path], None], confident: float, tmp_path: Path
) -> None:
    make(tmp_path)
    frame = read_frame(read_frames(tmp_path)[2], ReadOptions())
    assert len(frame.points) == confident * HEIGHT * WIDTH / 4
    np.testing.assert_allclose(frame.points.depth, 2)
    assert frame.image is not None
    assert frame.image.shape[:2] == frame.points.size == (HEIGHT, WIDTH)
    assert frame.camera is not None
    assert frame.camera.intrinsics.tolist() == [[30, 0, WIDTH / 2], [0, 30, 12], [0, 0, 1]]
    assert frame.pose is not None
    np.testing.assert_allclose(frame.pose, [[1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0]])


def test_each_frame_of_a_video_belongs_to_the_depth_of_its_number(tmp_path: Path) -> None:
    stray_scanner(tmp_path, 12)
    frames = read_frames(tmp_path)
    for number in (11, 2, 3, 0):
        image = read_frame(frames[number], ReadOptions()).image
        assert image is not None
        np.testing.assert_allclose(image.mean(), (20 + 15 * number) / 255, atol=0.02)


def test_depth_maps_smaller_than_images_are_millimetres(tmp_path: Path) -> None:
    stray_scanner(tmp_path / "phone")
    (tmp_path / "phone/depth").rename(tmp_path / "sparse")
    video(tmp_path / "rgb.mov", [90, 90, 90])
    frame = read_frame(read_frames(tmp_path, "pairs")[1], ReadOptions())
    np.testing.assert_allclose(frame.points.depth, 2)
    assert frame.sources["sparse"].assumed


def test_what_is_no_video_or_cannot_be_read_is_refused(tmp_path: Path) -> None:
    stray_scanner(tmp_path)
    frames = read_frames(tmp_path)
    (tmp_path / "rgb.mp4").write_text("#EXTM3U\nhttp://localhost/video.ts\n")
    with pytest.raises(InputError, match=r"rgb\.mp4"):
        read_frame(frames[0], ReadOptions())
    (tmp_path / "odometry.csv").write_text("header\n0, 0, x, 0, 0, 0, 0, 0, 1\n")
    with pytest.raises(InputError, match=r"odometry\.csv"):
        list_frames(tmp_path)


def test_nerfstudios_folder_has_its_model_in_colmap(tmp_path: Path) -> None:
    write_text_model(tmp_path / "colmap/sparse/0", names=("frame_00001.png",))
    touch(tmp_path / "images/frame_00001.png", tmp_path / "images_2/frame_00001.png")
    (frame,) = read_frames(tmp_path, "colmap")
    assert frame.sparse == tmp_path / "colmap/sparse/0"
    assert read_frames(tmp_path / "colmap/sparse/0", "colmap")[0].image == frame.image
