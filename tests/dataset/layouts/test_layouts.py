"""Which layout a folder is of, and its frames; data sets as they lie on disk, made small."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnpdepth_cli.dataset.arrays import apply_masks, move_depth
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.io.poses import read_oxts
from pnpdepth_cli.protocols import ODOMETRY_PART
from tests.colmap_models import write_text_model
from tests.data_sets import (
    BENCHMARKS,
    DRIVE,
    HEIGHT,
    MAKERS,
    SELECTED,
    TREES,
    WIDTH,
    codes,
    image,
    mask,
    read_frames,
    stray_scanner,
    touch,
    tree,
)


def at_x(x: float) -> tuple[tuple[float, ...], ...]:
    return ((1, 0, 0, x), (0, 1, 0, 0), (0, 0, 1, 0))


STATED = {  # codes per metre of sparse depth and ground truth, of one view, of other sizes
    "kitti-depth": (256, 256, True, False),
    "kitti-raw": (None, 256, False, False),
    "7scenes": (None, 1000, False, False),
    "void": (256, 256, True, False),
    "ibims": (None, 1310.7, False, False),
    "scannet": (None, 1000, False, True),
    "arkitscenes": (1000, 1000, True, True),
    "stray-scanner": (1000, None, True, False),
    "record3d": (None, None, True, False),
    "tum": (None, 5000, True, False),
}
"""What the descriptions of the data sets say; of the others nothing."""


@pytest.mark.parametrize("name", MAKERS)
def test_a_layout_is_guessed_and_no_other_takes_it(name: str, tmp_path: Path) -> None:
    root = tmp_path / "set"
    make, names = MAKERS[name]
    make(root)
    frames = read_frames(root)
    assert [frame.name for frame in frames] == names
    own = frames[0]
    stated = (own.sparse_scale, own.gt_scale, own.one_view, own.gt_other_size)
    assert stated == STATED.get(name, (None, None, False, False))
    assert repr(frames) == repr(read_frames(root, name))
    assert [layout_name for layout_name, layout in LAYOUTS.items() if layout.matches(root)] == [
        name
    ]


def test_pairs_may_lack_parts_and_files_of_no_frame_are_listed(tmp_path: Path) -> None:
    tree(tmp_path, TREES["pairs"][0])
    (tmp_path / "sparse").rename(tmp_path / "linked")  # links are followed, but not in circles
    (tmp_path / "sparse").symlink_to(tmp_path / "linked")
    (tmp_path / "rgb/again").symlink_to(tmp_path / "rgb")
    a, b = read_frames(tmp_path)
    assert (a.gt, a.calib) == (tmp_path / "gt/a.exr", tmp_path / "calib/a.json")
    assert (b.gt, b.calib) == (None, None)
    touch(tmp_path / "calib.txt", tmp_path / "rgb/c.png", tmp_path / "sparse/d.png")
    touch(tmp_path / "calib/f.txt", tmp_path / "rgb/.hidden.png", tmp_path / "rgb/notes.txt")
    touch(tmp_path / "rgb/a.jpg")
    layout, (b,), unmatched = list_frames(tmp_path)
    assert (layout, b.name, b.calib) == ("pairs", "b", tmp_path / "calib.txt")
    alone = ("sparse/a.png", "sparse/d.png", "gt/a.exr", "calib/a.json", "calib/f.txt")
    said = (f"{path.relative_to(tmp_path)} {why}" for path, why in unmatched)
    lost = [note.split(" has ")[0] for note in said]
    assert lost == ["rgb/a.png and a.jpg are one frame; keep one", "rgb/c.png", *alone]


IN_DRIVE = f"{DRIVE}/proj_depth/{{}}/image_02/0000000005.png"
ANNOTATED = f"data_depth_annotated/val/{IN_DRIVE.format('groundtruth')}"
VELODYNE = f"data_depth_velodyne/train/{IN_DRIVE.format('velodyne_raw')}"
PHOTO = f"2011_09_26/{DRIVE}/image_0{{}}/data/0000000005.png"


@pytest.mark.parametrize(
    ("files", "starts", "parts"),
    [
        (
            TREES["kitti-depth"][0],
            ["."],
            {
                "sparse": [f"velodyne_raw/{SELECTED.format('velodyne_raw')}.png"],
                "gt": [f"groundtruth_depth/{SELECTED.format('groundtruth_depth')}.png"],
                "calib": [f"intrinsics/{SELECTED.format('image')}.txt"],
            },
        ),
        (
            f"val/{DRIVE}/proj_depth/{{velodyne_raw,groundtruth}}/image_0{{2,3}}/0000000005.png"
            f" {PHOTO.format('{2,3}')} 2011_09_26/calib_cam_to_cam.txt",
            ["."],
            {"image": [PHOTO.format(2), PHOTO.format(3)], "camera": [2, 3]},
        ),
        (
            f"{VELODYNE} {ANNOTATED} raw/{PHOTO.format(2)}",
            [".", "data_depth_velodyne"],
            {"sparse": [VELODYNE], "gt": [ANNOTATED], "image": [f"raw/{PHOTO.format(2)}"]},
        ),
        (
            f"{TREES['kitti-raw'][0]} {ANNOTATED}",
            [".", "2011_09_26", f"2011_09_26/{DRIVE}"],
            {
                "calib": ["2011_09_26"] * 4,
                "camera": [2, 2, 3, 3],
                "gt": [ANNOTATED, None, None, None],
            },
        ),
        (
            "data/room/{image,sparse_depth,ground_truth}/1.png data/room/K.txt",
            ["."],
            {"calib": ["data/room/K.txt"]},
        ),
    ],
)
def test_the_files_of_a_frame_are_found_from_wherever_the_data_set_starts(
    files: str, starts: list[str], parts: dict[str, list[object]], tmp_path: Path
) -> None:
    tree(tmp_path, files)
    for frames in (read_frames(tmp_path / start) for start in starts):
        for name, values in parts.items():
            expected = [tmp_path / value if isinstance(value, str) else value for value in values]
            assert [getattr(frame, name) for frame in frames] == expected


def test_kittis_depth_without_the_raw_images_says_where_it_looked(tmp_path: Path) -> None:
    tree(tmp_path, f"{VELODYNE} {ANNOTATED}")
    with pytest.raises(InputError, match=f"{DRIVE}/image_02/data"):
        read_frames(tmp_path)


def test_odometry_has_poses_by_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree(tmp_path, f"{TREES['kitti-odometry'][0]} poses/00.txt")
    rows = [f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for x in ("0.5", "1", "-1.5e-01")]
    (tmp_path / "poses/00.txt").write_text("".join(rows))
    assert [frame.pose for frame in read_frames(tmp_path)] == [at_x(0.5), at_x(-0.15), None, None]
    monkeypatch.chdir(tmp_path / "sequences/00")
    assert [f.pose for f in read_frames(Path())] == [at_x(0.5), at_x(-0.15)]


def test_tum_pairs_images_and_depth_that_are_nearest_in_time(tmp_path: Path) -> None:
    times = {
        "rgb": (1.0, 1.033, 2, 1.04, 5, 6),  # 1.033 s is nearer to 1.030 s
        "depth": (1.015, 1.03, 5.02, 5.979),
    }
    for kind, stamps in times.items():
        (tmp_path / f"{kind}.txt").write_text("".join(f"{t} {kind}/{t}.png\n" for t in stamps))
    (tmp_path / "groundtruth.txt").write_text("1 5 0 0 0 0 0 1\n1.02 7 0 0 0 0 0 1\n")
    _, frames, unmatched = list_frames(tmp_path)
    depth, poses = ("1.015", "1.03", "5.02"), (at_x(5), None, None)  # 1.033 s is after the last
    expected = [(5000, tmp_path / f"depth/{d}.png", p) for d, p in zip(depth, poses, strict=True)]
    assert [(frame.gt_scale, frame.gt, frame.pose) for frame in frames] == expected
    lost = ["rgb/1.04.png", "rgb/2.png", "rgb/6.png", "depth/5.979.png"]
    assert [path.relative_to(tmp_path).as_posix() for path, _ in unmatched] == lost


@pytest.mark.parametrize(
    "line", ["0 depth/0.png 1.5 rgb/0.png", "1.5 rgb/0.png 1.51 depth/0.png #"]
)
def test_associations_pair_images_and_depth(line: str, tmp_path: Path) -> None:
    (tmp_path / "associations.txt").write_text(f"# comment\n{line}\n")
    (tmp_path / "groundtruth.txt").write_text("1 5 0 0 0 0 0 1\n1.5 7 0 0 0 0 0 1\n")
    (frame,) = read_frames(tmp_path)
    assert (frame.image, frame.gt) == (tmp_path / "rgb/0.png", tmp_path / "depth/0.png")
    assert frame.pose == at_x(7)


def inputs_of(files: FrameFiles) -> Frame:
    """The frame of these files; points are sampled where it has none."""
    return read_frame(files, ReadOptions(sample=SamplePattern(count=20)))


@pytest.mark.parametrize(
    ("name", "file", "text", "named"),
    [
        ("kitti-odometry", "poses/00.txt", "", r"00\.txt"),
        ("kitti-odometry", "poses/00.txt", "1 0 0 0 0 1 0 0 0 0 1 0", r"000002\.png"),
        ("tum", "rgb.txt", "nan rgb/a.png", "line 1"),
        ("tum", "depth.txt", "soon depth/1.png", "line 1"),
        ("tum", "rgb.txt", "1.0", "line 1"),
        ("tum", "rgb.txt", "1.0 rgb/a\0.png", r"rgb/a\\x00\.png"),
        ("tum", "associations.txt", "0 rgb/0.png 0", "line 1"),
        ("tum", "associations.txt", "0 rgb/0.png 0 rgb/1.png", "line 1"),
        ("eth3d", "office/ground_truth_depth/dslr_images/DSC_0219.JPG", "0" * 12, r"DSC_0219\.JPG"),
        ("stray-scanner", "odometry.csv", "header\n0, 0, x, 0, 0, 0, 0, 0, 1", r"odometry\.csv"),
        ("stray-scanner", "rgb.mp4", "#EXTM3U\nhttp://localhost/video.ts\n", r"rgb\.mp4"),
    ],
)
def test_a_file_of_a_data_set_that_means_nothing_is_named(
    name: str, file: str, text: str, named: str, tmp_path: Path
) -> None:
    MAKERS[name][0](tmp_path)
    touch(tmp_path / file)
    (tmp_path / file).write_text(f"{text}\n")
    with pytest.raises(InputError, match=named):
        inputs_of(read_frames(tmp_path)[0])


@pytest.mark.parametrize("name", BENCHMARKS)
def test_depth_is_read_in_metres_where_it_is_valid(name: str, tmp_path: Path) -> None:
    BENCHMARKS[name][0](tmp_path)
    inputs = inputs_of(read_frames(tmp_path)[0])
    known = inputs.gt > 0
    np.testing.assert_allclose(inputs.gt[known], 2, rtol=1e-3)
    np.testing.assert_allclose(inputs.points.depth, 2, rtol=1e-3)
    assert inputs.image.shape[:2] == inputs.gt.shape == inputs.points.size
    if name == "arkitscenes":  # whose low resolution keeps its points
        points = inputs.points
        assert (len(points), points.xy[0].tolist()) == (HEIGHT * WIDTH // 16, [1.5, 1.5])
    half = name in ("diode", "ibims", "eth3d")
    assert int(known.sum()) == HEIGHT * WIDTH // (2 if half else 1)
    assert not (half and known[:, WIDTH // 2 :].any())


@pytest.mark.parametrize(
    ("model", "photo"),
    [
        ("dslr_calibration_undistorted", "images/dslr_images_undistorted/DSC_0219.JPG"),
        ("colmap/sparse/0", "images/frame_00001.png"),  # as nerfstudio has it
    ],
)
def test_a_model_elsewhere_is_depth_of_its_images(model: str, photo: str, tmp_path: Path) -> None:
    for folder in ("images", "images_2"):
        image(tmp_path / photo.replace("images", folder, 1))
    write_text_model(tmp_path / model, names=(photo.removeprefix("images/"),))
    (frame,) = read_frames(tmp_path)
    assert (frame.image, frame.sparse) == (tmp_path / photo, tmp_path / model)
    assert len(inputs_of(frame).points) > 0


def test_ground_truth_is_moved_and_never_interpolated(tmp_path: Path) -> None:
    depth = np.array([[1, 2], [3, 0]], np.float32)
    larger = [[0, 0, 0, 0], [0, 1, 0, 2], [0, 0, 0, 0], [0, 3, 0, 0]]
    assert move_depth(tmp_path, depth, (4, 4)).tolist() == larger
    assert move_depth(tmp_path, depth, (1, 1)).tolist() == [[1]]
    with pytest.raises(InputError, match="do not show the same view"):
        move_depth(tmp_path, depth, (4, 9))
    with pytest.raises(InputError, match="90°"):
        move_depth(tmp_path, depth[:1], (4, 2))
    with pytest.raises(InputError, match=r"\b912×228"):  # a part of the frame
        ODOMETRY_PART.apply(np.zeros((200, 1000)))


def test_a_manifest_names_masks_and_ground_truth_of_another_size(tmp_path: Path) -> None:
    image(tmp_path / "a.png", 2 * HEIGHT, 2 * WIDTH)
    codes(tmp_path / "gt.png", 512)
    mask(tmp_path / "mask.png")
    (tmp_path / "list.csv").write_text("image,gt,mask,gt_size_ok\na.png,gt.png,mask.png,true\n")
    inputs = inputs_of(read_frames(tmp_path / "list.csv")[0])
    assert int((inputs.gt > 0).sum()) == HEIGHT * WIDTH // 2
    np.save(tmp_path / "mask.npy", np.arange(25).reshape(5, 5, 1) % 2)
    kept = apply_masks(np.ones((5, 5), np.float32), (tmp_path / "mask.npy",))
    assert kept.ravel().tolist() == [n % 2 for n in range(25)]
    with pytest.raises(InputError, match=r"mask\.png is 32×24 but the ground truth is 5×5"):
        apply_masks(np.ones((5, 5), np.float32), (tmp_path / "mask.png",))


def test_the_parent_of_data_sets_of_one_layout_has_their_frames(tmp_path: Path) -> None:
    for scene in ("chess", "fire"):
        tree(tmp_path / scene, "seq-01/frame-000000.{color,depth}.png")
    layout, frames, _ = list_frames(tmp_path)
    assert layout == "7scenes"
    assert [frame.name.split("/")[0] for frame in frames] == ["chess", "fire"]
    tree(tmp_path / "mine", "{rgb,sparse}/a.png")
    with pytest.raises(InputError, match=r"several layouts \(7scenes, pairs\); give"):
        list_frames(tmp_path)
    assert [frame.name for frame in read_frames(tmp_path, "pairs")] == ["mine/a"]


@pytest.mark.parametrize(
    ("root", "name", "error", "said"),
    [
        (".", None, InputError, "kitti-object"),
        (".", "kitti-object", InputError, "kitti-object"),
        (".", "kitti-objects", UsageError, "kitti-object"),
        ("image_2/0.png", None, InputError, "is one file"),
        ("phone.r3d", None, InputError, r"LZFSE.*'EXR \+ RGB'"),
    ],
)
def test_an_unknown_folder_or_layout_is_named(
    root: str, name: str | None, error: type[Exception], said: str, tmp_path: Path
) -> None:
    tree(tmp_path, "image_2/0.png calib/0.txt phone.r3d")
    with pytest.raises(error, match=said):
        list_frames(tmp_path / root, name)


@pytest.mark.parametrize(
    ("name", "place", "lacks"),
    [
        ("stray-scanner", "", "odometry.csv"),
        ("stray-scanner", "", "rgb.mp4"),
        ("arkitscenes", "Validation/41069021", "lowres_depth"),
        ("diode", "indoors/scene_00019/scan_00183", "*_depth_mask.npy"),
        ("kitti-raw", f"2011_09_26/{DRIVE}", "velodyne_points/data"),
        ("tum", "", "depth.txt"),
        ("colmap", "", "images"),
    ],
)
def test_what_a_layout_lacks_is_named(name: str, place: str, lacks: str, tmp_path: Path) -> None:
    MAKERS[name][0](tmp_path)
    (found,) = (tmp_path / place).glob(lacks)
    found.rename(found.with_name("elsewhere"))
    with pytest.raises(InputError) as error:
        list_frames(tmp_path, name)
    assert str(error.value).startswith(f"{tmp_path / place} has no ")
    assert lacks in str(error.value)


@pytest.mark.parametrize(("name", "confident"), [("stray-scanner", 0.75), ("record3d", 1.0)])
def test_a_phones_recording_is_a_frame(name: str, confident: float, tmp_path: Path) -> None:
    MAKERS[name][0](tmp_path)
    frame = inputs_of(read_frames(tmp_path)[2])
    assert len(frame.points) == confident * HEIGHT * WIDTH / 4
    np.testing.assert_allclose(frame.points.depth, 2)
    assert frame.image.shape[:2] == frame.points.size == (HEIGHT, WIDTH)
    assert frame.camera.intrinsics.tolist() == [[30, 0, WIDTH / 2], [0, 30, 12], [0, 0, 1]]
    np.testing.assert_allclose(frame.pose, [[1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0]])


def test_each_frame_of_a_video_belongs_to_the_depth_of_its_number(tmp_path: Path) -> None:
    stray_scanner(tmp_path, 12)
    frames = read_frames(tmp_path)
    for number in (11, 2, 3, 0):
        level = inputs_of(frames[number]).image.mean()
        np.testing.assert_allclose(level, (20 + 15 * number) / 255, atol=0.02)
    # as pairs, whose depth maps are smaller than the images, and so in millimetres
    (tmp_path / "depth").rename(tmp_path / "sparse")
    (tmp_path / "rgb.mp4").rename(tmp_path / "rgb.mov")
    frame = inputs_of(read_frames(tmp_path, "pairs")[1])
    np.testing.assert_allclose(frame.points.depth, 2)
    assert frame.sources["sparse"].assumed


SPEED = 8  # column of an oxts packet: forward velocity, m/s


def raw_drive(root: Path, packets: Sequence[str]) -> Path:
    """A drive of KITTI's raw data with these oxts packets, and the calibration of a real one."""
    date = root / "2011_09_26"
    folder = date / DRIVE
    turn = "0 -1 0 0 0 -1 1 0 0"  # the camera looks along the scanner's x
    write(date / "calib_cam_to_cam.txt", f"R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: {PROJECTION}\n")
    write(date / "calib_velo_to_cam.txt", f"R: {turn}\nT: 0 -0.08 -0.27\n")
    write(date / "calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    for number, packet in enumerate(packets):
        touch(
            folder / f"image_02/data/{number:010}.png",
            folder / f"velodyne_points/data/{number:010}.bin",
        )
        write(folder / f"oxts/data/{number:010}.txt", packet)
    return date


PROJECTION = "700 0 300 0 0 700 100 0 0 0 1 0"


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, -150.0])
def test_poses_of_a_raw_drive_are_those_of_the_inertial_system(
    heading_deg: float, tmp_path: Path
) -> None:
    # 10 m ahead, then a turn by 3 degrees to the left on the spot, at a latitude of 49 degrees.
    heading = np.radians(heading_deg)
    metre_deg = 1 / 111_319.49
    north = 10 * np.sin(heading) * metre_deg
    east = 10 * np.cos(heading) * metre_deg
    places = [(0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (1.0, 1.0, 3.0)]
    scale = np.cos(np.radians(49))
    packets = [
        " ".join(map(str, [49 + n * north, 8.4 + e * east / scale, 110, 0, 0,
                           heading + np.radians(turn), *[0] * 24]))
        for n, e, turn in places
    ]  # fmt: skip
    date = raw_drive(tmp_path, packets)
    poses = np.array([frame.pose for frame in list_frames(tmp_path, None)[1]])
    np.testing.assert_allclose(poses[0], np.eye(3, 4), atol=1e-9)
    np.testing.assert_allclose(poses[1, :, 3], [0, 0, 10], atol=0.02)
    turned = Rotation.from_matrix(poses[2, :, :3]).as_rotvec(degrees=True)
    np.testing.assert_allclose(turned, [0, -3, 0], atol=1e-6)
    # Without a packet of every frame, or the pose of the system, none is known.
    (date / DRIVE / "oxts/data/0000000001.txt").write_text("49 8 110")
    with pytest.raises(InputError, match="0000000001"):
        list_frames(tmp_path, None)
    (date / DRIVE / "oxts/data/0000000001.txt").unlink()
    assert all(frame.pose is None for frame in list_frames(tmp_path, None)[1])


def test_the_poses_of_a_real_drive_have_its_speed(shared_data: Path) -> None:
    drive = next((shared_data / "kitti_raw/2011_09_26").glob("*_sync"))
    packets = sorted((drive / "oxts/data").glob("*.txt"))
    poses = read_oxts(packets)
    lines = (drive / "oxts/timestamps.txt").read_text().splitlines()[: len(packets)]
    seconds = [float(line.rpartition(":")[2]) for line in lines]
    stated = np.mean([float(path.read_text().split()[SPEED]) for path in packets])
    assert stated == pytest.approx(8.8, abs=0.1)
    way_m = np.linalg.norm(poses[-1, :, 3] - poses[0, :, 3])
    # satellite positions move by decimetres against velocities
    assert way_m / (seconds[-1] - seconds[0]) == pytest.approx(stated, rel=0.05)
    ahead = poses[0, :, :3].T @ (poses[-1, :, 3] - poses[0, :, 3])
    assert ahead[0] / way_m > 0.99
