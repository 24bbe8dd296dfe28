"""Bags of ROS 1, ROS 2 and MCAP, as files and as the source of a batch."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.commands.bag_frames import RECORD, write_frames
from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import find_frames, unpack
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.commands.requests import FramesRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles, ScanOptions
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.errors import FileFormatError, InputError, OutputError, UsageError
from pnpdepth_cli.io.bags.messages import Stamped, nearest_pairs
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.file_bytes import read_json
from pnpdepth_cli.io.poses import read_poses
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.sensors.pixels import Points
from tests.bags import (
    FOCAL_PX,
    HEIGHT,
    IMAGES,
    POINTS,
    RECTIFIED_PX,
    WIDTH,
    depth_m,
    write_bag,
)
from tests.commands.frames import frame_on_disk
from tests.data_sets import read_frames

KINDS = ("ros1.bag", "ros2", "drive.mcap")


def written(bag: Path, folder: Path, **options: object) -> list[str]:
    """What was said while the frames of a bag were written."""
    messages: list[str] = []
    write_frames(FramesRequest(bag=bag, output=folder, **options), messages.append)  # type: ignore[arg-type]
    return messages


def extracted(folder: Path, kind: str = "a.mcap", **bag: Any) -> list[str]:
    """The same of a bag in a folder, whose frames are in its frames/."""
    folder.mkdir(exist_ok=True)
    return written(write_bag(folder / kind, **bag), folder / "frames")


def points_of(frame: FrameFiles) -> Points:
    """The scan of a frame that was written, in its image."""
    assert frame.sparse is not None
    options = ScanOptions(calib=frame.calib)
    return read_scan_points(frame.sparse, options, (HEIGHT, WIDTH)).points


def record_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = read_json(folder / "frames" / RECORD)
    return content


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_becomes_calibrated_frames(kind: str, compressed: bool, tmp_path: Path) -> None:
    extracted(tmp_path, kind, compressed=compressed)
    topic = f"{IMAGES}/compressed" if compressed else IMAGES
    record = record_of(tmp_path)
    assert (record["image_topic"], record["points_topic"]) == (topic, POINTS)
    frames = read_frames(tmp_path / "frames")
    assert [frame.name for frame in frames] == [f"1700000000_0{n}0000" for n in (0, 3, 6)]
    pixels = read_rgb(frames[1].image).values  # type: ignore[arg-type]
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(pixels[5, 5] * 255, [200, 41, 41], atol=4 if compressed else 0)
    assert frames[1].sparse is not None
    assert len(read_scan(frames[1].sparse)[0]) == 150
    calibration = read_calibration(tmp_path / "frames" / "calib.txt")
    assert calibration.camera.size == (HEIGHT, WIDTH)
    turn, shift = calibration.scanner
    np.testing.assert_allclose(turn, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(shift, [0, -0.2, 0], atol=1e-9)
    points = points_of(frames[1])
    # y = 0, z = -0.1667 in the LiDAR is 0.0333 m above the camera's axis, 5 m ahead
    np.testing.assert_allclose(points.depth, 5)
    assert np.abs(points.xy - [31.5, 23.5 - 60 * 0.03333 / 5]).sum(axis=1).min() < 0.01


@pytest.mark.parametrize("compressed", ["", "; compressedDepth"])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_depth_images_are_sparse_depth(encoding: str, compressed: str, tmp_path: Path) -> None:
    depth, error = depth_m(), 0.004 if encoding + compressed == "32FC1; compressedDepth" else 1e-6
    extracted(tmp_path, "ros1.bag", depth=encoding + compressed)
    for frame in read_frames(tmp_path / "frames"):
        np.testing.assert_allclose(read_depth(frame.sparse).values, depth, rtol=error)  # type: ignore[arg-type]
    extracted(tmp_path / "wide", depth=encoding + compressed, depth_focal=30.0)
    points = points_of(read_frames(tmp_path / "wide/frames")[0])  # of half the focal length
    np.testing.assert_allclose(points.xy[:, 0] % 2, 0.5, atol=0.01)  # 31.5 + 2 · (u − 31.5)
    # another camera, 0.05 m to the left: f · 0.05 m / 4 m = 0.75 pixels
    extracted(tmp_path / "other", depth=encoding + compressed, depth_frame="depth")
    points = points_of(read_frames(tmp_path / "other/frames")[0])
    np.testing.assert_allclose(points.depth, 4, rtol=error)
    x, y = points.xy.T
    np.testing.assert_allclose(x + 0.75, np.rint(x + 0.75), atol=0.01)
    assert (x.min(), y.min(), len(points)) == pytest.approx((0.25, 10, 38 * 63), abs=0.01)


def test_a_batch_writes_the_frames_of_a_bag_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, frame = write_bag(tmp_path / "drive.mcap"), frame_on_disk(tmp_path)
    network = ["--model", str(frame.model), "--checkpoint", str(frame.checkpoint)]
    command = ["batch", str(bag), "-o", str(tmp_path / "out"), *network, "--iterations", "1"]
    times = []
    for text, again in (("wrote 3 frames to", "3 to do"), ("", "all of them done already")):
        assert run(command) == 0
        printed = capsys.readouterr().err
        assert text in printed
        assert again in printed
        images = (tmp_path / "out_frames/rgb").iterdir()
        times.append({path: path.stat().st_mtime_ns for path in images})
    assert len(times[0]) == 3
    assert times[0] == times[1]


def test_topics_can_be_named_and_images_without_a_scan_in_time_are_none(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive.mcap")
    with pytest.raises(InputError, match="--tolerance"):
        written(bag, tmp_path / "none", tolerance=0.001)
    with pytest.raises(UsageError, match="/rear"):
        written(bag, tmp_path / "frames", topics=("/rear",))
    assert len(written(bag, tmp_path / "frames", topics=(POINTS, IMAGES))) == 3


@pytest.mark.parametrize("clock_s", [-1_699_999_000.5, -2.0])
def test_the_log_brings_two_clocks_together(clock_s: float, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "ros1.bag", clock_s=clock_s)
    messages = written(bag, tmp_path / "frames", tolerance=0.01)
    assert any("--clock-offset" in message for message in messages)
    record = record_of(tmp_path)
    # points are stamped 4 ms after their image and logged 1 ms later, images at once
    assert record["seconds_added_to_points"] == pytest.approx(0.001 - clock_s, abs=1e-6)
    assert (record["frames"], record["images_without_scan"]) == (3, 0)
    written(bag, tmp_path / "given", tolerance=0.01, clock_offset=-clock_s)
    for name in ("frames", "given"):
        assert len(list((tmp_path / name / "sparse").iterdir())) == 3
    with pytest.raises(InputError, match="--clock-offset"):
        written(bag, tmp_path / "none", clock_offset=0.0)


def test_a_bag_without_calibration_gets_a_note_that_names_it(tmp_path: Path) -> None:
    assert "refine with --extrinsics" in extracted(tmp_path / "a", static=False)[-1]
    assert read_calibration(tmp_path / "a/frames/calib.txt").scanner is None
    assert "refine with --calib" in extracted(tmp_path / "b", info=False)[-1]


@pytest.mark.parametrize(
    ("topic", "focal_px"), [("/front/image_rect_color", RECTIFIED_PX), (IMAGES, FOCAL_PX)]
)
def test_images_are_rectified_by_their_topic(topic: str, focal_px: float, tmp_path: Path) -> None:
    said = extracted(tmp_path, topic=topic, rectified=True)
    assert any(text.startswith("camera: ") for text in said)
    camera = read_calibration(tmp_path / "frames" / "calib.txt").camera
    assert camera.intrinsics[0, 0] == focal_px


def test_frames_of_a_bag_are_replaced_and_other_folders_left_alone(tmp_path: Path) -> None:
    bag, folder = write_bag(tmp_path / "drive.mcap"), tmp_path / "frames"
    folder.mkdir()
    written(bag, folder)
    with pytest.raises(OutputError, match="--overwrite"):
        written(bag, folder)
    every = sorted(path.name for path in (folder / "sparse").iterdir())
    written(bag, folder, between=(1, 99), every=2, overwrite=True)
    assert sorted(path.name for path in (folder / "sparse").iterdir()) == every[1::2]
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "thesis.tex").touch()
    with pytest.raises(OutputError, match="own"):
        written(bag, tmp_path / "own", overwrite=True)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("part", [0.0, 0.5])
def test_a_bag_that_is_cut_short_is_one_line(kind: str, part: float, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / kind)
    file = next(bag.glob("*.db3")) if bag.is_dir() else bag
    data = file.read_bytes()
    file.write_bytes(data[: int(part * len(data))])
    with pytest.raises(FileFormatError) as caught:
        written(bag, tmp_path / "frames")
    assert "\n" not in str(caught.value)


def test_each_image_gets_the_nearest_scan_within_the_tolerance() -> None:
    def stream() -> list[tuple[bool, Stamped]]:
        times = [(False, 0.0), (True, 0.04), (True, 0.06), (False, 0.1), (True, 0.2), (False, 0.29)]
        return [(is_image, Stamped(time_s=t, message=t)) for is_image, t in times]

    pairs = [(i.message, s and s.message) for i, s in nearest_pairs(stream(), 0.095)]
    assert pairs == [(0.04, 0.0), (0.06, 0.1), (0.2, 0.29)]
    assert [s for _, s in nearest_pairs(stream(), 0.01)] == [None] * 3


def test_files_behind_a_planted_link_are_not_removed(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / KINDS[0])
    written(bag, tmp_path / "frames")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/precious.txt").write_text("mine")
    shutil.rmtree(tmp_path / "frames/sparse")
    (tmp_path / "frames/sparse").symlink_to(tmp_path / "mine")
    with pytest.raises(OutputError):
        written(bag, tmp_path / "frames", overwrite=True)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["precious.txt"]


FORWARD = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
"""The camera in base: z is base's x."""


@pytest.mark.parametrize("kind", KINDS)
def test_the_camera_moves_as_the_body_that_it_is_fixed_to(kind: str, tmp_path: Path) -> None:
    assert extracted(tmp_path, kind, poses="odometry")[-1] == "poses: of /odom"
    rows = read_poses(tmp_path / "frames/poses.txt")
    assert rows.shape == (3, 3, 4)
    np.testing.assert_allclose(rows[:, :, :3], [FORWARD] * 3, atol=1e-9)
    np.testing.assert_allclose(rows[:, :, 3], [[1, 0, 0], [1.3, 0, 0], [1.6, 0, 0]], atol=1e-5)
    assert record_of(tmp_path)["poses"] == "/odom"


def test_a_pose_message_is_the_cameras_own(tmp_path: Path) -> None:
    extracted(tmp_path, poses="pose")
    rows = read_poses(tmp_path / "frames/poses.txt")
    np.testing.assert_allclose(rows[:, :, :3], [np.eye(3)] * 3, atol=1e-9)
    np.testing.assert_allclose(rows[:, 0, 3], [0, 0.3, 0.6], atol=1e-5)
    assert "/odom" in extracted(tmp_path / "loose", poses="odometry", static=False)[-1]
    assert not (tmp_path / "loose/frames/poses.txt").exists()


def test_a_batch_of_a_bag_accumulates_with_its_poses(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive.mcap", poses="odometry")
    request = BatchRequest(
        source=bag, output=tmp_path / "out", refine=RefineRequest(), accumulate=1
    )
    (neighbour,) = find_frames(unpack(request, lambda text: None)).frames[0].neighbours
    assert neighbour.poses.startswith(str(tmp_path / "out_frames/poses.txt"))
