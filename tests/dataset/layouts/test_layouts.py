"""Which layout a folder is of, and its frames; data sets as they lie on disk, made small."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import request_of
from pnpdepth_cli.commands.refinement.refine_image import read_requested
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest, parse_sample
from pnpdepth_cli.dataset.arrays import apply_masks, move_depth
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import FileFormatError, InputError, SizeError, UsageError
from pnpdepth_cli.frames.frame import Frame
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
    arkitscenes,
    codes,
    eth3d,
    image,
    mask,
    read_frames,
    record3d,
    stray_scanner,
    touch,
    tree,
    tum,
    video,
    void,
)

AT_START = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0))


def at_x(x: float) -> tuple[tuple[float, ...], ...]:
    return ((1, 0, 0, x), *AT_START[1:])


@pytest.mark.parametrize("name", MAKERS)
def test_a_layout_is_guessed_and_no_other_takes_it(name: str, tmp_path: Path) -> None:
    root = tmp_path / "set"
    make, names = MAKERS[name]
    make(root)
    frames = read_frames(root)
    assert [frame.name for frame in frames] == names
    assert repr(frames) == repr(read_frames(root, name))
    assert [other for other, layout in LAYOUTS.items() if layout.matches(root)] == [name]


def test_pairs_may_lack_parts_and_files_of_no_frame_are_listed(tmp_path: Path) -> None:
    tree(tmp_path, TREES["pairs"][0])
    a, b = read_frames(tmp_path)
    assert (a.gt, a.calib) == (tmp_path / "gt/a.exr", tmp_path / "calib/a.json")
    assert (b.gt, b.calib) == (None, None)
    touch(tmp_path / "calib.txt", tmp_path / "rgb/c.png", tmp_path / "sparse/d.png")
    touch(tmp_path / "calib/f.txt", tmp_path / "rgb/.hidden.png", tmp_path / "rgb/notes.txt")
    touch(tmp_path / "rgb/a.jpg")
    layout, (b,), unmatched = list_frames(tmp_path)
    assert (layout, b.name, b.calib) == ("pairs", "b", tmp_path / "calib.txt")
    alone = ("sparse/a.png", "sparse/d.png", "gt/a.exr", "calib/a.json", "calib/f.txt")
    lost = [str(each).replace(f"{tmp_path}/", "").split(" has ")[0] for each in unmatched]
    assert lost == ["rgb/a.png and a.jpg are one frame; keep one", "rgb/c.png", *alone]


def test_links_are_followed_but_not_in_circles(tmp_path: Path) -> None:
    tree(tmp_path / "real", TREES["pairs"][0])
    root = tmp_path / "linked"
    root.mkdir()
    for part in ("rgb", "sparse"):
        (root / part).symlink_to(tmp_path / "real" / part)
    (tmp_path / "real/rgb/again").symlink_to(tmp_path / "real/rgb")
    assert [frame.name for frame in read_frames(root)] == ["a", "b"]


def test_kittis_selection_pairs_its_long_names(tmp_path: Path) -> None:
    tree(tmp_path, TREES["kitti-depth"][0])
    (frame,) = read_frames(tmp_path)
    for path, kind in ((frame.sparse, "velodyne_raw"), (frame.gt, "groundtruth_depth")):
        assert path == tmp_path / kind / f"{SELECTED.format(kind)}.png"
    assert frame.calib == tmp_path / "intrinsics" / f"{SELECTED.format('image')}.txt"
    assert (frame.sparse_scale, frame.gt_scale) == (256, 256)


def test_kittis_tree_finds_its_images_in_the_raw_data(tmp_path: Path) -> None:
    tree(
        tmp_path,
        f"val/{DRIVE}/proj_depth/{{velodyne_raw,groundtruth}}/image_0{{2,3}}/0000000005.png"
        f" 2011_09_26/{DRIVE}/image_0{{2,3}}/data/0000000005.png 2011_09_26/calib_cam_to_cam.txt",
    )
    left, right = read_frames(tmp_path, "kitti-depth")
    assert (left.name, left.camera, right.camera) == (f"{DRIVE}_0000000005_image_02", 2, 3)
    assert right.image == tmp_path / "2011_09_26" / DRIVE / "image_03/data/0000000005.png"
    assert right.calib == tmp_path / "2011_09_26"
    shutil.rmtree(tmp_path / "2011_09_26")
    with pytest.raises(InputError, match=f"{DRIVE}/image_02/data"):
        read_frames(tmp_path)


def test_kittis_depth_as_downloaded_pairs_annotated_velodyne_and_raw(tmp_path: Path) -> None:
    inside = f"{DRIVE}/proj_depth/{{}}/image_02/0000000005.png"
    scan = tmp_path / "data_depth_velodyne/train" / inside.format("velodyne_raw")
    gt = tmp_path / "data_depth_annotated/train" / inside.format("groundtruth")
    photo = tmp_path / "raw/2011_09_26" / DRIVE / "image_02/data/0000000005.png"
    touch(scan, gt, photo)
    for start in (tmp_path, tmp_path / "data_depth_velodyne"):
        (frame,) = read_frames(start)
        assert (frame.sparse, frame.gt, frame.image) == (scan, gt, photo)


@pytest.mark.parametrize("start", [".", "2011_09_26", f"2011_09_26/{DRIVE}"])
def test_a_raw_drive_has_calibration_and_annotated_depth(start: str, tmp_path: Path) -> None:
    tree(tmp_path, TREES["kitti-raw"][0])
    gt = tmp_path / "data_depth_annotated" / "val" / DRIVE / "proj_depth/groundtruth/image_02"
    touch(gt / "0000000005.png")
    layout, frames, unmatched = list_frames(tmp_path / start)
    assert layout == "kitti-raw"
    assert {frame.calib for frame in frames} == {tmp_path / "2011_09_26"}
    assert [frame.camera for frame in frames] == [2, 2, 3, 3]
    assert [frame.gt for frame in frames] == [gt / "0000000005.png", None, None, None]
    assert [lost.path.name for lost in unmatched] == ["0000000007.png"]


def poses_of_odometry(root: Path, *rows: str) -> None:
    tree(root, "sequences/00/image_2/00000{0,2}.png sequences/00/velodyne/00000{0,2}.bin")
    touch(root / "sequences/00/calib.txt", root / "poses/00.txt")
    (root / "poses/00.txt").write_text("\n".join(rows) + "\n")


def test_odometry_has_poses_by_frame_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses_of_odometry(tmp_path, *(f"1 0 0 {x} 0 1 0 0 0 0 1 0" for x in ("0.5", "1", "-1.5e-01")))
    tree(tmp_path, TREES["kitti-odometry"][0])
    assert [frame.pose for frame in read_frames(tmp_path)] == [at_x(0.5), at_x(-0.15), None]
    monkeypatch.chdir(tmp_path / "sequences/00")
    assert [f.pose for f in read_frames(Path())] == [at_x(0.5), at_x(-0.15)]


_ROW = "1 0 0 0 0 1 0 0 0 0 1 0"


@pytest.mark.parametrize(
    ("rows", "named"),
    [("", "00.txt"), (_ROW, "000002.png"), (_ROW[2:], "00.txt"), ("nan" + _ROW[1:], "00.txt")],
)
def test_poses_are_twelve_numbers_a_frame(tmp_path: Path, rows: str, named: str) -> None:
    poses_of_odometry(tmp_path, rows)
    with pytest.raises(InputError, match=named):
        read_frames(tmp_path)


def test_tum_pairs_images_and_depth_that_are_nearest_in_time(tmp_path: Path) -> None:
    tum(tmp_path)
    with (tmp_path / "rgb.txt").open("a") as file:
        file.write("1.04 rgb/1.04.png\n5 rgb/5.png\n6 rgb/6.png\n")  # 1.033 s is nearer to 1.030 s
    with (tmp_path / "depth.txt").open("a") as file:
        file.write("5.02 depth/5.png\n5.979 depth/6.png\n")
    (tmp_path / "groundtruth.txt").write_text("1 5 0 0 0 0 0 1\n1.02 7 0 0 0 0 0 1\n")
    _, frames, unmatched = list_frames(tmp_path)
    depths = [frame.gt.name for frame in frames if frame.gt is not None]
    assert depths == ["1.015.png", "1.030.png", "5.png"]
    # 1.033 s is after the last pose
    assert [(f.gt_scale, f.pose) for f in frames] == [(5000, at_x(5)), (5000, None), (5000, None)]
    lost = ["rgb/1.04.png", "rgb/2.png", "rgb/6.png", "depth/6.png"]
    assert [each.path.relative_to(tmp_path).as_posix() for each in unmatched] == lost


@pytest.mark.parametrize(
    "line", ["0 depth/0.png 1.5 rgb/0.png", "1.5 rgb/0.png 1.51 depth/0.png #"]
)
def test_associations_pair_images_and_depth(line: str, tmp_path: Path) -> None:
    (tmp_path / "associations.txt").write_text(f"# comment\n{line}\n")
    (tmp_path / "groundtruth.txt").write_text("1 5 0 0 0 0 0 1\n1.5 7 0 0 0 0 0 1\n")
    (frame,) = read_frames(tmp_path)
    assert (frame.image, frame.gt) == (tmp_path / "rgb/0.png", tmp_path / "depth/0.png")
    assert frame.pose == at_x(7)


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("rgb.txt", "nan rgb/a.png"),
        ("depth.txt", "soon depth/1.png"),
        ("rgb.txt", "1.0"),
        ("rgb.txt", "1.0 rgb/a\0.png"),
        ("associations.txt", "0 rgb/0.png 0"),
        ("associations.txt", "0 rgb/0.png nan depth/0.png"),
        ("associations.txt", "0 rgb/0.png 0 rgb/1.png"),
    ],
)
def test_a_line_of_tum_that_means_nothing_is_named(tmp_path: Path, file: str, line: str) -> None:
    tum(tmp_path)
    (tmp_path / file).write_text(f"{line}\n")
    with pytest.raises(FileFormatError, match=r"line 1|rgb/a\\x00\.png"):
        read_frames(tmp_path)


def inputs_of(frame: FrameFiles, root: Path) -> Frame:
    """The frame as a batch reads it; points are sampled where it has none."""
    pattern = None if frame.sparse is not None else parse_sample("20")
    refine = RefineRequest().with_fields(sample=pattern)
    request = BatchRequest(source=root, output=root / "out", refine=refine)
    return read_requested(request_of(request, frame))


@pytest.mark.parametrize("name", BENCHMARKS)
def test_depth_is_read_in_metres_where_it_is_valid(name: str, tmp_path: Path) -> None:
    BENCHMARKS[name][0](tmp_path)
    inputs = inputs_of(read_frames(tmp_path)[0], tmp_path)
    assert inputs.gt is not None
    known = inputs.gt > 0
    np.testing.assert_allclose(inputs.gt[known], 2, rtol=1e-3)
    np.testing.assert_allclose(inputs.points.depth, 2, rtol=1e-3)
    assert inputs.image is not None
    assert inputs.image.shape[:2] == inputs.gt.shape == inputs.points.size
    half = name in ("diode", "ibims", "eth3d")
    assert int(known.sum()) == HEIGHT * WIDTH // (2 if half else 1)
    assert not (half and known[:, WIDTH // 2 :].any())


def test_the_low_resolution_depth_of_arkitscenes_keeps_its_points(tmp_path: Path) -> None:
    arkitscenes(tmp_path)
    points = inputs_of(read_frames(tmp_path)[0], tmp_path).points
    assert (len(points), points.xy[0].tolist()) == (HEIGHT * WIDTH // 16, [1.5, 1.5])


def test_eth3ds_model_is_sparse_depth_of_its_undistorted_images(tmp_path: Path) -> None:
    photo = tmp_path / "images/dslr_images_undistorted/DSC_0219.JPG"
    image(photo)
    model = tmp_path / "dslr_calibration_undistorted"
    write_text_model(model, names=("dslr_images_undistorted/DSC_0219.JPG",))
    (frame,) = read_frames(tmp_path)
    assert (frame.image, frame.sparse) == (photo, model)
    assert len(inputs_of(frame, tmp_path).points) > 0


def test_raw_depth_of_eth3d_that_does_not_fit_its_image_is_refused(tmp_path: Path) -> None:
    eth3d(tmp_path)
    (frame,) = read_frames(tmp_path)
    assert frame.gt is not None
    frame.gt.write_bytes(b"0" * 12)
    with pytest.raises(InputError, match=r"DSC_0219\.JPG"):
        inputs_of(frame, tmp_path)


def test_all_of_void_is_taken_without_a_list_of_the_test_split(tmp_path: Path) -> None:
    void(tmp_path)
    (tmp_path / "test_image.txt").unlink()
    assert [frame.calib for frame in read_frames(tmp_path)] == [tmp_path / "data/desktop/K.txt"] * 2


def test_ground_truth_is_moved_and_never_interpolated(tmp_path: Path) -> None:
    depth = np.array([[1, 2], [3, 0]], np.float32)
    larger = [[0, 0, 0, 0], [0, 1, 0, 2], [0, 0, 0, 0], [0, 3, 0, 0]]
    assert move_depth(tmp_path, depth, (4, 4)).tolist() == larger
    assert move_depth(tmp_path, depth, (1, 1)).tolist() == [[1]]
    with pytest.raises(SizeError, match="do not show the same view"):
        move_depth(tmp_path, depth, (4, 9))
    with pytest.raises(SizeError, match="90°"):
        move_depth(tmp_path, depth[:1], (4, 2))


def test_a_manifest_names_masks_and_ground_truth_of_another_size(tmp_path: Path) -> None:
    image(tmp_path / "a.png", 2 * HEIGHT, 2 * WIDTH)
    codes(tmp_path / "gt.png", 512)
    mask(tmp_path / "mask.png")
    (tmp_path / "list.csv").write_text("image,gt,mask,gt_size_ok\na.png,gt.png,mask.png,true\n")
    inputs = inputs_of(read_frames(tmp_path / "list.csv")[0], tmp_path)
    assert inputs.gt is not None
    assert int((inputs.gt > 0).sum()) == HEIGHT * WIDTH // 2
    np.save(tmp_path / "mask.npy", np.arange(25).reshape(5, 5, 1) % 2)
    kept = apply_masks(np.ones((5, 5), np.float32), (tmp_path / "mask.npy",))
    assert kept.ravel().tolist() == [n % 2 for n in range(25)]
    with pytest.raises(SizeError, match=r"mask\.png is 32×24 but the ground truth is 5×5"):
        apply_masks(np.ones((5, 5), np.float32), (tmp_path / "mask.png",))


def test_the_parent_of_data_sets_of_one_layout_has_their_frames(tmp_path: Path) -> None:
    for scene in ("chess", "fire"):
        tree(tmp_path / scene, "seq-01/frame-000000.{color,depth}.png")
    layout, frames, _ = list_frames(tmp_path)
    assert layout == "7scenes"
    names = [f"{scene}/seq-01_frame-000000" for scene in ("chess", "fire")]
    assert [frame.name for frame in frames] == names
    tree(tmp_path / "mine", "{rgb,sparse}/a.png")
    with pytest.raises(InputError, match=r"several layouts \(7scenes, pairs\); give"):
        list_frames(tmp_path)
    assert [frame.name for frame in read_frames(tmp_path, "pairs")] == ["mine/a"]


def test_an_unknown_folder_or_layout_is_named(tmp_path: Path) -> None:
    tree(tmp_path, "image_2/0.png calib/0.txt")
    with pytest.raises(InputError, match="kitti-object"):
        list_frames(tmp_path)
    with pytest.raises(InputError, match="kitti-object"):
        list_frames(tmp_path, "kitti-object")
    with pytest.raises(UsageError, match="kitti-object"):
        list_frames(tmp_path, "kitti-objects")


def test_a_frame_that_is_smaller_than_its_part_is_refused() -> None:
    with pytest.raises(SizeError, match=r"\b912×228"):
        ODOMETRY_PART.apply(np.zeros((200, 1000)))


@pytest.mark.parametrize(("make", "confident"), [(stray_scanner, 0.75), (record3d, 1.0)])
def test_a_phones_recording_is_a_frame(
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
