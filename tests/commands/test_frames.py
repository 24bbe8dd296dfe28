"""Bags of ROS 1, ROS 2 and MCAP, as files and as the source of a batch."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

pytest.importorskip("rosbags")

from rosbags.highlevel import AnyReader

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.cli.main import run
from pnpdepth_cli.commands.frames import RECORD, write_frames
from pnpdepth_cli.commands.requests.frames_request import FramesRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles, ScanOptions
from pnpdepth_cli.dataset.frame_record import FrameRecord, ResultRecord
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.io.bags.messages import cloud_points, nearest_pairs
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.file_bytes import read_json
from pnpdepth_cli.io.poses import read_poses
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.sensors.projection import Points
from tests.bags import HEIGHT, IMAGES, POINTS, RECTIFIED_PX, WIDTH, depth_m, write_bag
from tests.commands.frames import frame_on_disk
from tests.data_sets import read_frames, touch

KINDS = ("ros1.bag", "ros2", "drive.mcap")


def written(bag: Path, folder: Path, **options: object) -> list[str]:
    """What was said while the frames of a bag were written."""
    messages: list[str] = []
    write_frames(FramesRequest(bag=bag, output=folder, **options), messages.append)
    return messages


def extracted(folder: Path, kind: str = "a.mcap", **bag: Any) -> list[str]:
    """The same of a bag in a folder, whose frames are in its frames/."""
    folder.mkdir(exist_ok=True)
    return written(write_bag(folder / kind, **bag), folder / "frames")


def points_of(frame: FrameFiles) -> Points:
    """The scan of a frame that was written, in its image."""
    return read_scan_points(frame.sparse, ScanOptions(calib=frame.calib), (HEIGHT, WIDTH)).points


SENSOR = "/device_0/sensor_0"


@pytest.mark.parametrize("unit_m", [0.001, 0.00025, 0.0001])
@pytest.mark.parametrize("kind", ["16UC1", "mono16", "16UC1; compressedDepth"])
def test_depth_has_the_unit_that_the_bag_says(kind: str, unit_m: float, tmp_path: Path) -> None:
    said = extracted(
        tmp_path,
        depth=kind,
        depth_topic=f"{SENSOR}/Depth_0/image/data",
        depth_frame="camera",
        unit=(f"{SENSOR}/option/Depth_Units/value", unit_m),
    )
    (path,) = sorted((tmp_path / "frames" / "sparse").iterdir())[:1]
    np.testing.assert_allclose(read_depth(path).values, depth_m(), atol=unit_m)
    assert any("Depth_Units" in line for line in said)


@pytest.mark.parametrize("kind", ["16UC1", "mono16", "16UC1; compressedDepth"])
def test_a_unit_of_depth_that_is_stated_goes_before_that_of_the_bag(
    kind: str, tmp_path: Path
) -> None:
    unit_m = 0.00025
    extracted(
        tmp_path,
        depth=kind,
        depth_topic=f"{SENSOR}/Depth_0/image/data",
        depth_frame="camera",
        unit=(f"{SENSOR}/option/Depth_Units/value", unit_m),
    )
    frames = tmp_path / "stated"
    said = written(tmp_path / "a.mcap", frames, depth_scale=2000.0)
    (path,) = sorted((frames / "sparse").iterdir())[:1]
    expected = np.rint(depth_m() / unit_m) / 2000
    np.testing.assert_allclose(read_depth(path).values, expected, rtol=1e-6)
    assert any("--depth-scale" in line for line in said)


def test_another_sensors_unit_is_not_this_ones(tmp_path: Path) -> None:
    other = "/device_0/sensor_1/option/Depth_Units/value"
    extracted(tmp_path, depth="mono16", depth_topic=f"{SENSOR}/Depth_0/data", unit=(other, 0.001))
    (path,) = sorted((tmp_path / "frames" / "sparse").iterdir())[:1]
    np.testing.assert_allclose(read_depth(path).values, depth_m())


@pytest.mark.parametrize("kind", ["mono16", "64FC1"])
def test_grey_images_of_16_bits_beside_colours_are_depth(kind: str, tmp_path: Path) -> None:
    said = extracted(tmp_path, depth=kind, depth_topic="/stereo/map")
    (path,) = sorted((tmp_path / "frames" / "sparse").iterdir())[:1]
    np.testing.assert_allclose(read_depth(path).values, depth_m())
    assert any("/stereo/map" in line for line in said)


@pytest.mark.parametrize("without", ["/depth/camera_info", "/front/camera_info"])
def test_depth_of_another_frame_without_its_camera_is_warned_of(
    without: str, tmp_path: Path
) -> None:
    said = extracted(tmp_path, depth="16UC1", depth_frame="depth", without=without)
    assert any(line.startswith("warning") for line in said)


FORWARD = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
"""The camera in base: z is base's x."""


class FromBag(NamedTuple):
    """The folder of the frames of a bag, the topic of its images, and what was said."""

    folder: Path
    topic: str
    said: list[str]


@pytest.fixture(
    scope="module",
    params=[(kind, topic) for kind in KINDS for topic in (IMAGES, f"{IMAGES}/compressed")],
    ids=lambda param: f"{param[0]}, {param[1]}",
)
def from_bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> FromBag:
    kind, topic = request.param
    folder = tmp_path_factory.mktemp("from_bag")
    said = extracted(folder, kind, topic=topic, poses="/odom")
    return FromBag(folder=folder / "frames", topic=topic, said=said)


def test_the_topics_of_a_bag_that_became_frames_are_recorded(from_bag: FromBag) -> None:
    assert from_bag.said[-1] == "poses: of /odom"
    record = read_json(from_bag.folder / RECORD)
    topics = [record[name] for name in ("image_topic", "points_topic", "poses")]
    assert topics == [from_bag.topic, POINTS, "/odom"]


def test_frames_of_a_bag_have_their_time_as_name_and_the_pixels_of_their_image(
    from_bag: FromBag,
) -> None:
    frames = read_frames(from_bag.folder)
    assert [frame.name for frame in frames] == [f"1700000000_0{n}0000" for n in (0, 3, 6)]
    pixels = read_rgb(frames[1].image).values
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    of_jpeg = 0 if from_bag.topic == IMAGES else 4
    np.testing.assert_allclose(pixels[5, 5] * 255, [200, 41, 41], atol=of_jpeg)


def test_frames_of_a_bag_have_the_camera_and_where_the_scanner_is(from_bag: FromBag) -> None:
    calibration = read_calibration(from_bag.folder / "calib.txt")
    assert calibration.camera.size == (HEIGHT, WIDTH)
    np.testing.assert_allclose(calibration.scanner.rotation, np.transpose(FORWARD), atol=1e-9)
    np.testing.assert_allclose(calibration.scanner.translation, [0, -0.2, 0], atol=1e-9)


def test_the_scan_of_a_frame_of_a_bag_lies_where_the_camera_sees_it(from_bag: FromBag) -> None:
    points = points_of(read_frames(from_bag.folder)[1])
    # y = 0, z = -0.1667 in the LiDAR is 0.0333 m above the camera's axis, 5 m ahead
    np.testing.assert_allclose(points.depth, [5] * 150)
    assert np.abs(points.xy - [31.5, 23.5 - 60 * 0.03333 / 5]).sum(axis=1).min() < 0.01


def test_frames_of_a_bag_have_the_poses_of_the_body_that_the_camera_is_fixed_to(
    from_bag: FromBag,
) -> None:
    poses = read_poses(from_bag.folder / "poses.txt")
    np.testing.assert_allclose(poses[:, :, :3], [FORWARD] * 3, atol=1e-9)
    np.testing.assert_allclose(poses[:, :, 3], [[1, 0, 0], [1.3, 0, 0], [1.6, 0, 0]], atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "error"),
    [("16UC1", 0), ("32FC1", 0), ("16UC1; compressedDepth", 0), ("32FC1; compressedDepth", 0.004)],
)
def test_depth_images_are_sparse_depth(kind: str, error: float, tmp_path: Path) -> None:
    extracted(tmp_path, "ros1.bag", depth=kind)
    for frame in read_frames(tmp_path / "frames"):
        np.testing.assert_allclose(read_depth(frame.sparse).values, depth_m(), rtol=error)
    extracted(tmp_path / "wide", depth=kind, depth_focal=30.0)
    points = points_of(read_frames(tmp_path / "wide/frames")[0])  # of half the focal length
    np.testing.assert_allclose(points.xy[:, 0] % 2, 0.5, atol=0.01)  # 31.5 + 2 · (u − 31.5)
    # another camera, 0.05 m to the left: f · 0.05 m / 4 m = 0.75 pixels
    extracted(tmp_path / "other", depth=kind, depth_frame="depth")
    points = points_of(read_frames(tmp_path / "other/frames")[0])
    np.testing.assert_allclose(points.depth, 4, rtol=error + 1e-6)
    x, y = points.xy.T
    np.testing.assert_allclose(x + 0.75, np.rint(x + 0.75), atol=0.01)
    assert (x.min(), y.min(), len(points)) == pytest.approx((0.25, 10, 38 * 63), abs=0.01)


def test_a_batch_writes_a_bag_out_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "drive.mcap", poses="/odom")
    frame = frame_on_disk(tmp_path)
    network = ["--model", str(frame.model), "--checkpoint", str(frame.checkpoint)]
    command = ["batch", str(bag), "-o", str(tmp_path / "out"), *network, "--iterations", "1"]
    times = []
    for texts in (("wrote 3 frames to", "3 to do"), ("all of them done already",)):
        assert run([*command, "--accumulate", "1"]) == 0
        printed = capsys.readouterr().err
        assert all(text in printed for text in texts)
        images = (tmp_path / "out_frames/rgb").iterdir()
        times.append({path: path.stat().st_mtime_ns for path in images})
    assert len(times[0]) == 3
    assert times[0] == times[1]
    (record,) = (FrameRecord.read(path) for path in (tmp_path / "out").glob("*_000000.json"))
    assert record.refined().neighbours[0].poses.startswith(str(tmp_path / "out_frames/poses.txt"))


def test_topics_can_be_named_and_images_without_a_scan_in_time_are_none(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive.mcap")
    with pytest.raises(InputError, match="--tolerance"):
        written(bag, tmp_path / "none", tolerance=0.001)
    with pytest.raises(UsageError, match="/rear"):
        written(bag, tmp_path / "frames", topics=("/rear",))
    assert IMAGES in written(bag, tmp_path / "frames", topics=(POINTS, IMAGES))[0]


@pytest.mark.parametrize("clock_s", [-1_699_999_000.5, -2.0])
def test_the_log_brings_two_clocks_together(clock_s: float, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "ros1.bag", clock_s=clock_s)
    messages = written(bag, tmp_path / "frames", tolerance=0.01)
    assert any("--clock-offset" in message for message in messages)
    record = read_json(tmp_path / "frames" / RECORD)
    # points are stamped 4 ms after their image and logged 1 ms later, images at once
    assert record["seconds_added_to_points"] == pytest.approx(0.001 - clock_s, abs=1e-6)
    assert (record["frames"], record["images_without_scan"]) == (3, 0)
    written(bag, tmp_path / "given", tolerance=0.01, clock_offset=-clock_s)
    for name in ("frames", "given"):
        assert len(list((tmp_path / name / "sparse").iterdir())) == 3
    with pytest.raises(InputError, match="--clock-offset"):
        written(bag, tmp_path / "none", clock_offset=0.0)


@pytest.mark.parametrize(
    ("bag", "said", "focal_px", "posed"),
    [
        ({"without": "/tf_static"}, "refine with --extrinsics", 60, False),
        ({"without": "/tf_static", "poses": "/odom"}, "/odom", 60, False),
        ({"without": "/front/camera_info"}, "refine with --calib", None, False),
        ({"topic": "/front/image_rect_color"}, "camera: ", RECTIFIED_PX, False),
        ({"poses": "/vio/pose"}, "poses: of /vio/pose", 60, True),
    ],
)
def test_what_a_bag_has_or_lacks_decides_the_calibration_and_is_said(
    bag: dict[str, str], said: str, focal_px: float | None, posed: bool, tmp_path: Path
) -> None:
    assert any(said in line for line in extracted(tmp_path, **bag))
    calib, poses = (tmp_path / "frames" / name for name in ("calib.txt", "poses.txt"))
    assert (calib.exists(), poses.exists()) == (focal_px is not None, posed)
    if calib.exists():
        calibration = read_calibration(calib)
        assert calibration.camera.intrinsics[0, 0] == focal_px
        assert (calibration.scanner is None) == ("without" in bag)
    if posed:  # the camera's own
        still = np.repeat(np.eye(3, 4)[None], 3, axis=0)
        still[:, 0, 3] = 0, 0.3, 0.6
        np.testing.assert_allclose(read_poses(poses), still, atol=1e-5)


def test_frames_of_a_bag_are_replaced_and_other_files_left_alone(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive.mcap")
    folder = tmp_path / "frames"
    folder.mkdir()
    written(bag, folder)
    with pytest.raises(OutputError, match="--overwrite"):
        written(bag, folder)
    every = sorted(path.name for path in (folder / "sparse").iterdir())
    written(bag, folder, between=(1, 99), every=2, overwrite=True)
    assert sorted(path.name for path in (folder / "sparse").iterdir()) == every[1::2]
    own = tmp_path / "own/thesis.tex"
    touch(own)
    (folder / "sparse").rename(tmp_path / "moved")
    (folder / "sparse").symlink_to(own.parent)
    for taken in (own.parent, folder):
        with pytest.raises(OutputError):
            written(bag, taken, overwrite=True)
    assert list(own.parent.iterdir()) == [own]


def test_the_users_own_files_beside_frames_stay_and_a_folder_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    bag = write_bag(tmp_path / "drive.mcap", without="/tf_static")
    written(bag, folder)
    name = next((folder / "rgb").iterdir()).stem
    own = [f"rgb/{name}.txt", "rgb/mine.png", f"sparse/{name}_mask.png", "poses.txt", "notes.md"]
    touch(*(folder / file for file in own))
    written(bag, folder, between=(1, 1), overwrite=True)
    assert all((folder / file).exists() for file in own)
    assert not (folder / f"rgb/{name}.png").exists()
    (folder / "rgb/more").mkdir()
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    with pytest.raises(OutputError, match="more"):
        written(bag, folder, overwrite=True)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("part", [0.0, 0.5])
def test_a_bag_that_is_cut_short_is_one_line(kind: str, part: float, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / kind)
    file = next(bag.glob("*.db3")) if bag.is_dir() else bag
    data = file.read_bytes()
    file.write_bytes(data[: int(part * len(data))])
    with pytest.raises(InputError) as caught:
        written(bag, tmp_path / "frames")
    assert "\n" not in str(caught.value)


def test_each_image_gets_the_nearest_scan_within_the_tolerance() -> None:
    times = [(False, 0.0), (True, 0.04), (True, 0.06), (False, 0.1), (True, 0.2), (False, 0.29)]
    messages = [(is_image, time_s, time_s) for is_image, time_s in times]
    pairs = [(image, scan) for _, image, scan in nearest_pairs(messages, 0.095)]
    assert pairs == [(0.04, 0.0), (0.06, 0.1), (0.2, 0.29)]
    assert [scan for *_, scan in nearest_pairs(messages, 0.01)] == [None] * 3


class OfBag(NamedTuple):
    """A frame that was refined, and the messages of the bag that it was exported to."""

    out: Path
    rgb: Path
    name: str
    messages: dict[str, Any]
    times_ns: set[int]

    @property
    def result(self) -> ResultRecord:
        return FrameRecord.read(self.out / f"{self.name}.json").refined()

    @property
    def time_ns(self) -> int:
        """The time in the name of the frame, which has microseconds."""
        return int(self.name.replace("_", "")) * 1000

    @property
    def camera(self) -> tuple[Camera, Any]:
        """The camera and its pose (3, 4) in the record."""
        camera = self.result.camera
        assert camera is not None
        return camera.read()

    @property
    def valid_depth(self) -> np.ndarray:
        """The depth (H, W) that was written, 0 where it is not valid."""
        written_depth = read_depth(self.out / f"{self.name}_depth.exr").values
        valid = read_rgb(self.out / f"{self.name}_valid.png").values[..., 0] > 0
        return np.where(valid, written_depth, 0)


@pytest.fixture(scope="module", params=["", "16UC1"], ids=["scan", "depth"])
def of_bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[OfBag]:
    """The three frames of a bag that were refined and became a bag again."""
    folder = tmp_path_factory.mktemp("of_bag")
    bag = write_bag(folder / "drive.mcap", poses="/odom", depth=request.param)
    out = folder / "out"
    again = folder / "again"
    options = ["--method", "alone", "--model", "fcrn-tiny", "--format", "exr"]
    assert run(["batch", str(bag), "-o", str(out), *options, "--uncertainty"]) == 0
    assert run(["export", str(out), "--to", "mcap", "-o", str(again)]) == 0
    # The messages of each topic, in the order of the frames.
    by_topic = dict[str, list[Any]]()
    with AnyReader([again]) as reader:
        for connection, time_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            by_topic.setdefault(connection.topic, []).append((time_ns, message))
    names = sorted(path.name.removesuffix("_depth.exr") for path in out.glob("*_depth.exr"))
    assert len(names) == 3
    return [
        OfBag(
            out=out,
            rgb=folder / "out_frames/rgb",
            name=name,
            messages={topic: messages[place][1] for topic, messages in by_topic.items()},
            times_ns={messages[place][0] for messages in by_topic.values()},
        )
        for place, name in enumerate(names)
    ]


def test_messages_of_a_refined_frame_have_the_time_of_its_name(of_bag: list[OfBag]) -> None:
    for frame in of_bag:
        assert frame.times_ns == {frame.time_ns}
        stamp = frame.messages["/camera/image"].header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == frame.time_ns


def test_a_bag_has_refined_depth_and_its_standard_deviation_bit_for_bit(
    of_bag: list[OfBag],
) -> None:
    for frame in of_bag:
        found = floats_of(frame.messages["/camera/depth/image"])
        known = frame.valid_depth > 0
        np.testing.assert_array_equal(np.isnan(found), ~known)
        assert found[known].tobytes() == frame.valid_depth[known].tobytes()
        sigma = read_depth(frame.out / f"{frame.name}_sigma.exr").values
        assert floats_of(frame.messages["/camera/depth/sigma"]).tobytes() == sigma.tobytes()


def test_a_bag_has_the_image_and_the_camera_of_a_refined_frame(of_bag: list[OfBag]) -> None:
    for frame in of_bag:
        pixels = frame.messages["/camera/image"].data.reshape(HEIGHT, WIDTH, 3) / np.float32(255)
        expected = read_rgb(next(frame.rgb.glob(f"{frame.name}.*"))).values
        np.testing.assert_allclose(pixels, expected, atol=1e-6)
        camera, _ = frame.camera
        for topic in ("/camera/camera_info", "/camera/depth/camera_info"):
            matrix = frame.messages[topic].k.reshape(3, 3)
            np.testing.assert_array_equal(matrix, camera.intrinsics)


def test_a_bag_has_the_points_that_were_used_where_the_camera_sees_them(
    of_bag: list[OfBag],
) -> None:
    for frame in of_bag:
        points = cloud_points(frame.messages["/camera/points_used"], "")
        used = frame.result.points
        assert used is not None
        assert len(points) == used.used
        ends = (points[:, 2].min(), points[:, 2].max())
        assert ends == pytest.approx((used.nearest, used.farthest))


def test_a_bag_has_the_cloud_of_the_refined_depth(of_bag: list[OfBag]) -> None:
    for frame in of_bag:
        x, y, z = cloud_points(frame.messages["/camera/cloud"], "").T.astype(np.float64)
        camera, _ = frame.camera
        pixel = camera.intrinsics @ [x / z, y / z, np.ones(len(z))]
        column, row = np.rint(pixel[:2]).astype(int)
        np.testing.assert_allclose(z, frame.valid_depth[row, column], rtol=1e-6)


def test_a_bag_has_the_pose_from_the_world_to_the_camera(of_bag: list[OfBag]) -> None:
    for frame in of_bag:
        (transform,) = frame.messages["/tf"].transforms
        shift = transform.transform.translation
        _, pose = frame.camera
        np.testing.assert_allclose([shift.x, shift.y, shift.z], pose[:, 3], atol=1e-9)
        assert (transform.header.frame_id, transform.child_frame_id) == ("world", "camera")


def floats_of(message: Any) -> np.ndarray:
    """The numbers (H, W) of an Image of encoding 32FC1."""
    assert message.encoding == "32FC1"
    return message.data.view("<f4").reshape(message.height, message.width)
