"""Data sets as they lie on disk, made small."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pnpdepth_cli.errors import FileFormatError, InputError, SizeError, UsageError
from pnpdepth_cli.io.dataset import PROTOCOLS, Hdf5Array, find_protocol
from pnpdepth_cli.io.dataset.reading import read_frame_ground_truth, read_frame_image
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.layouts import (
    LAYOUTS,
    find_layout,
    list_frames,
    read_frames,
)
from tests.colmap_models import write_text_model
from tests.empty_files import touch, tree
from tests.io.layouts.test_benchmark_layouts import MAKERS as BENCHMARKS

DEPTH = np.random.default_rng(0).uniform(1, 9, (12, 16)).astype(np.float32)


SELECTED = "2011_09_26_drive_0002_sync_{}_0000000005_image_02"
DRIVE = "2011_09_26_drive_0002_sync"
TREES = {
    "pairs": ("rgb/{a,b}.png sparse/{a,b}.png gt/a.exr calib/a.json", ["a", "b"]),
    "image-depth": ("images/x/{a,b}.jpg depth/x/{a,b}.png", ["x/a", "x/b"]),
    "kitti-object": (
        "training/image_2/00000{0,1}.png training/velodyne/00000{0,1}.bin"
        " training/calib/00000{0,1}.txt",
        ["training_000000", "training_000001"],
    ),
    "kitti-odometry": (
        "sequences/{00,03}/image_2/000000.png sequences/{00,03}/velodyne/000000.bin"
        " sequences/{00,03}/calib.txt",
        ["00_000000", "03_000000"],
    ),
    "kitti-depth": (
        f"image/{SELECTED.format('image')}.png intrinsics/{SELECTED.format('image')}.txt"
        f" velodyne_raw/{SELECTED.format('velodyne_raw')}.png"
        f" groundtruth_depth/{SELECTED.format('groundtruth_depth')}.png",
        [f"{DRIVE}_0000000005_image_02"],
    ),
    "7scenes": (
        "seq-0{1,2}/frame-000000.{color,depth}.png",
        ["seq-01_frame-000000", "seq-02_frame-000000"],
    ),
    "synthia": (
        "{RGB,Depth}/Stereo_Left/Omni_F/000000.png {RGB,Depth}/Stereo_Right/Omni_B/000000.png"
        " CameraParams/intrinsics.txt",
        ["Stereo_Left_Omni_F_000000", "Stereo_Right_Omni_B_000000"],
    ),
}
"""Empty files of a layout by its name, and the names of their frames."""
TREE_OF_KITTI = (
    f"val/{DRIVE}/proj_depth/{{velodyne_raw,groundtruth}}/image_0{{2,3}}/0000000005.png"
    f" 2011_09_26/{DRIVE}/image_0{{2,3}}/data/0000000005.png 2011_09_26/calib_cam_to_cam.txt"
)


def tum(root: Path) -> None:
    root.mkdir(exist_ok=True)
    (root / "rgb.txt").write_text(
        "# time file\n1.000 rgb/1.000.png\n1.033 rgb/1.033.png\n2 rgb/2.png\n"
    )
    (root / "depth.txt").write_text("1.015 depth/1.015.png\n1.030 depth/1.030.png\n")


def colmap(root: Path) -> None:
    write_text_model(root / "sparse" / "0", names=("left/a.png", "b.png"))
    touch(root / "images/left/a.png", root / "images/b.png")


def nyu_h5(root: Path) -> None:
    h5py = pytest.importorskip("h5py")
    (root / "official").mkdir(parents=True)
    for number in (1, 9):
        with h5py.File(root / "official" / f"{number:05}.h5", "w") as file:
            file["rgb"] = np.full((3, 480, 640), number, np.uint8)
            file["depth"] = np.full((480, 640), float(number), np.float32)


def nyu_mat(root: Path) -> None:
    h5py = pytest.importorskip("h5py")
    root.mkdir(exist_ok=True)
    with h5py.File(root / "nyu_depth_v2_labeled.mat", "w") as file:
        # MATLAB's column order: frames, channels, columns, rows
        file["images"] = np.arange(4, dtype=np.uint8)[:, None, None, None] * np.ones(
            (1, 3, 640, 480), np.uint8
        )
        file["depths"] = np.tile(np.arange(640, dtype=np.float32)[:, None] + 1, (4, 1, 480))


MAKERS = {
    "tum": (tum, ["1.000", "1.033"]),
    "colmap": (colmap, ["b", "left/a"]),
    "nyu-h5": (nyu_h5, ["official_00001", "official_00009"]),
    "nyu-mat": (nyu_mat, ["0001", "0002", "0003", "0004"]),
}


@pytest.mark.parametrize("name", [*TREES, *MAKERS, *BENCHMARKS])
def test_a_layout_is_guessed_from_its_folder_and_no_other_takes_it(
    name: str, tmp_path: Path
) -> None:
    root = tmp_path / "set"
    if name in TREES:
        files, names = TREES[name]
        tree(root, files)
    else:
        make, names = {**MAKERS, **BENCHMARKS}[name]
        make(root)
    frames = read_frames(root)
    assert [frame.name for frame in frames] == names
    assert frames == read_frames(root, name)
    assert [other for other, layout in LAYOUTS.items() if layout.matches(root)] == [name]


def test_pairs_may_lack_truth_and_calibration_but_not_sparse_depth(tmp_path: Path) -> None:
    tree(tmp_path, TREES["pairs"][0])
    a, b = read_frames(tmp_path)
    assert (a.gt, a.calib) == (tmp_path / "gt/a.exr", tmp_path / "calib/a.json")
    assert (b.gt, b.calib) == (None, None)
    touch(tmp_path / "calib.txt")
    assert read_frames(tmp_path)[1].calib == tmp_path / "calib.txt"
    (tmp_path / "sparse/b.png").unlink()
    with pytest.raises(InputError, match=r"rgb/b\.png has no partner b\.\*"):
        read_frames(tmp_path)
    touch(tmp_path / "sparse/b.png", tmp_path / "sparse/b.exr")
    with pytest.raises(InputError, match="are one frame"):
        read_frames(tmp_path)


def test_kittis_selection_pairs_its_long_names(tmp_path: Path) -> None:
    tree(tmp_path, TREES["kitti-depth"][0])
    (frame,) = read_frames(tmp_path)
    assert frame.sparse == tmp_path / "velodyne_raw" / f"{SELECTED.format('velodyne_raw')}.png"
    assert (
        frame.gt == tmp_path / "groundtruth_depth" / f"{SELECTED.format('groundtruth_depth')}.png"
    )
    assert frame.calib == tmp_path / "intrinsics" / f"{SELECTED.format('image')}.txt"
    assert (frame.sparse_scale, frame.gt_scale) == (256, 256)


def test_kittis_tree_finds_its_images_in_the_raw_data(tmp_path: Path) -> None:
    tree(tmp_path, TREE_OF_KITTI)
    left, right = read_frames(tmp_path, "kitti-depth")
    assert left.name == "2011_09_26_drive_0002_sync_0000000005_image_02"
    assert (left.camera, right.camera) == (2, 3)
    assert right.image == (
        tmp_path / "2011_09_26/2011_09_26_drive_0002_sync/image_03/data/0000000005.png"
    )
    assert right.calib == tmp_path / "2011_09_26"
    shutil.rmtree(tmp_path / "2011_09_26")
    with pytest.raises(InputError, match=f"has no .*/{DRIVE}/image_02/data; add it"):
        read_frames(tmp_path)


def test_tum_pairs_each_image_with_the_nearest_depth_once(tmp_path: Path) -> None:
    tum(tmp_path)
    first, second = read_frames(tmp_path)
    assert first.gt == tmp_path / "depth/1.015.png"
    assert second.gt == tmp_path / "depth/1.030.png"
    assert first.gt_scale == 5000
    (tmp_path / "depth.txt").write_text("soon depth/1.png\n")
    with pytest.raises(FileFormatError, match=r"depth\.txt, line 1"):
        read_frames(tmp_path)


def test_tum_poses_are_those_at_the_times_of_the_images(tmp_path: Path) -> None:
    tum(tmp_path)
    assert [frame.pose for frame in read_frames(tmp_path)] == [None, None]
    (tmp_path / "groundtruth.txt").write_text("1 5 0 0 0 0 0 1\n1.02 7 0 0 0 0 0 1\n")
    first, second = read_frames(tmp_path)
    assert first.pose == ((1, 0, 0, 5), (0, 1, 0, 0), (0, 0, 1, 0))
    assert second.pose is None  # 1.033 s is after the last pose


def test_synthias_sequences_pair_each_camera_with_its_depth(tmp_path: Path) -> None:
    sequence = tmp_path / "SYNTHIA-SEQS-01-DAWN"
    for folder in (sequence, tmp_path / "SYNTHIA-SEQS-02-FALL"):
        tree(folder, TREES["synthia"][0])
    frames = read_frames(tmp_path)
    assert len(frames) == 4
    frame = frames[1]
    assert frame.name == "SYNTHIA-SEQS-01-DAWN_Stereo_Right_Omni_B_000000"
    assert frame.image == sequence / "RGB/Stereo_Right/Omni_B/000000.png"
    assert frame.gt == sequence / "Depth/Stereo_Right/Omni_B/000000.png"
    assert (frame.sparse, frame.calib, frame.gt_scale) == (None, None, 100)
    frame.gt.unlink()
    with pytest.raises(InputError, match=r"000000\.png has no partner 000000\.\*"):
        read_frames(tmp_path)


@pytest.mark.parametrize("folder", ["Depth", "Depth/Depth"])
@pytest.mark.parametrize("channels", [1, 3])
def test_synthias_random_set_has_centimetres_in_either_folder(
    tmp_path: Path, folder: str, channels: int
) -> None:
    touch(tmp_path / "RGB/0000000.png")
    (tmp_path / folder).mkdir(parents=True)
    codes = np.rint(100 * DEPTH).astype(np.uint16)
    codes[0, 0] = 65535  # sky
    cv2.imwrite(str(tmp_path / folder / "0000000.png"), np.stack([codes] * channels, axis=2))
    assert find_layout(tmp_path) == "synthia"
    (frame,) = read_frames(tmp_path)
    assert (frame.name, frame.gt) == ("0000000", tmp_path / folder / "0000000.png")
    truth = read_frame_ground_truth(frame)
    assert truth[0, 0] == 0
    np.testing.assert_allclose(truth[1:], DEPTH[1:], atol=6e-3)


def test_rgb_and_depth_with_other_names_in_them_are_not_synthia(tmp_path: Path) -> None:
    touch(tmp_path / "RGB/kitchen.png", tmp_path / "Depth/kitchen.png")
    assert not LAYOUTS["synthia"].matches(tmp_path)


def test_the_odometrys_training_sequences_have_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree(tmp_path, TREES["kitti-odometry"][0])
    part = tmp_path / "sequences/00"
    touch(part / "image_2/000001.png", part / "velodyne/000001.bin")
    (tmp_path / "poses").mkdir()
    rows = ["1 0 0 0.5 0 1 0 0 0 0 1 0", "1e+00 0 0 -1.5e-01 0 0 -1 2 0 1 0 7"]
    (tmp_path / "poses/00.txt").write_text("\n".join(rows) + "\n")
    first, second, other = read_frames(tmp_path)
    assert first.pose == ((1, 0, 0, 0.5), (0, 1, 0, 0), (0, 0, 1, 0))
    assert second.pose == ((1, 0, 0, -0.15), (0, 0, -1, 2), (0, 1, 0, 7))
    assert other.pose is None
    monkeypatch.chdir(part)
    assert [f.pose for f in read_frames(Path())] == [first.pose, second.pose]


def test_a_part_of_an_odometry_sequence_keeps_its_own_poses(tmp_path: Path) -> None:
    tree(tmp_path, TREES["kitti-odometry"][0])
    part = tmp_path / "sequences/00"
    for folder, suffix in (("image_2", ".png"), ("velodyne", ".bin")):
        (part / folder / f"000000{suffix}").rename(part / folder / f"000002{suffix}")
    (tmp_path / "poses").mkdir()
    rows = [f"1 0 0 {x} 0 1 0 0 0 0 1 0" for x in range(4)]
    (tmp_path / "poses/00.txt").write_text("\n".join(rows))
    assert read_frames(tmp_path)[0].pose == ((1, 0, 0, 2), (0, 1, 0, 0), (0, 0, 1, 0))


_ROW = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\n", "holds 0 poses"),
        (_ROW[2:], "00.txt, line 1"),
        (_ROW.replace("\n", " 0"), "00.txt, line 1"),
        (_ROW + "\n" + _ROW.replace("1", "nan"), "00.txt, line 3"),
        (_ROW.replace("1", "one"), "00.txt, line 1"),
    ],
)
def test_poses_that_are_not_twelve_numbers_a_frame_are_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    tree(tmp_path, TREES["kitti-odometry"][0])
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses/00.txt").write_text(text)
    with pytest.raises(InputError) as error:
        read_frames(tmp_path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_nyu_frames_come_halved_and_cropped_to_228_by_304(tmp_path: Path) -> None:
    nyu_h5(tmp_path / "h5")
    frame = read_frames(tmp_path / "h5")[1]
    assert read_frame_image(frame).shape == (228, 304, 3)
    assert read_frame_ground_truth(frame).tolist() == np.full((228, 304), 9.0).tolist()
    nyu_mat(tmp_path / "mat")
    frame = read_frames(tmp_path / "mat")[2]
    np.testing.assert_array_equal(read_frame_image(frame), np.float32(2) / np.float32(255))
    # columns 8 … 311 of every second pixel, 1 3 5 …: column c holds 2 c + 2 metres
    want = 2 * np.arange(8, 312) + 2
    assert (read_frame_ground_truth(frame) == want).all()


def test_kitti_in_files_of_the_same_kind_is_cut_as_kitti_is(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    depth = np.arange(376, dtype=np.float32)[:, None] + np.ones(1241, np.float32)
    with h5py.File(tmp_path / "00001.h5", "w") as file:
        file["rgb"], file["depth"] = np.zeros((3, 376, 1241), np.uint8), depth
    (frame,) = read_frames(tmp_path)
    assert frame.protocol.name == "kitti-odometry"
    assert read_frame_image(frame).shape == (228, 912, 3)
    np.testing.assert_array_equal(read_frame_ground_truth(frame), depth[148:, 164:1076])


@pytest.mark.parametrize("kind", ["txt", "mat"])
def test_the_official_file_is_split_by_the_file_beside_it(tmp_path: Path, kind: str) -> None:
    nyu_mat(tmp_path)
    if kind == "txt":
        (tmp_path / "test.txt").write_text("2\n4\n")
    else:
        from scipy.io import savemat

        savemat(tmp_path / "splits.mat", {"testNdxs": np.array([[2], [4]], np.uint16)})
    frames = read_frames(tmp_path)
    assert [frame.name for frame in frames] == ["0002", "0004"]
    assert [frame.image.index for frame in frames] == [1, 3]  # type: ignore[union-attr]
    (tmp_path / "test.txt").write_text("2\n5\n")
    with pytest.raises(FileFormatError, match="from 1 to 4"):
        read_frames(tmp_path)


def test_a_small_file_that_claims_a_billion_frames_is_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "nyu_depth_v2_labeled.mat"
    with h5py.File(path, "w") as file:
        file.create_dataset("depths", shape=(10**9, 640, 480), dtype="<f4", chunks=(1, 64, 48))
    assert path.stat().st_size < 10_000
    with pytest.raises(FileFormatError, match="claims 1,000,000,000 frames"):
        list_frames(tmp_path)


def test_an_hdf5_file_that_is_damaged_or_of_another_kind_is_named(tmp_path: Path) -> None:
    nyu_h5(tmp_path)
    path = tmp_path / "official" / "00001.h5"
    frame = read_frames(tmp_path)[0]
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(FileFormatError, match="cannot be read as HDF5"):
        read_frame_ground_truth(frame)
    other = read_frames(tmp_path)[1]
    assert isinstance(other.image, Hdf5Array)
    wrong = Hdf5Array(path=other.image.path, name="infra", axes=(0, 1))
    from pnpdepth_cli.io.dataset.reading import depth_of

    with pytest.raises(FileFormatError, match="has no array infra"):
        depth_of(wrong)


def test_a_manifest_has_all_that_a_frame_can_have(tmp_path: Path) -> None:
    touch(tmp_path / "i.png", tmp_path / "s.bin", tmp_path / "c.txt", tmp_path / "deep/g.png")
    row = {
        "image": "i.png", "sparse": "s.bin", "gt": "deep/g.png", "calib": "c.txt", "camera": 3,
        "sparse_scale": "", "gt_scale": 1000, "name": "first", "protocol": "kitti-odometry",
    }  # fmt: skip
    (tmp_path / "m.jsonl").write_text(json.dumps(row) + "\n\n")
    header = ",".join(row)
    (tmp_path / "m.csv").write_text(f"{header}\n{','.join(str(v) for v in row.values())}\n")
    from_json, from_csv = (read_frames(tmp_path / name) for name in ("m.jsonl", "m.csv"))
    assert from_json == from_csv
    (frame,) = from_csv
    assert (frame.name, frame.camera, frame.gt_scale, frame.sparse_scale) == (
        "first",
        3,
        1000,
        None,
    )
    assert frame.gt == tmp_path / "deep/g.png"
    assert frame.protocol == PROTOCOLS["kitti-odometry"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image,sparse\nlost.png,s.png\n", "lost.png does not exist; correct line 2 of "),
        ("image,depth\ni.png,s.png\n", "'depth' is not one of"),
        ("image,camera\ni.png,left\n", "line 2"),
        ("image\ni.png\ni.png\n", "line 3: a second frame 'i'"),
        ("image,gt\n,i.png\n", "neither image nor sparse"),
        ("image\ni.png,more\n", "more than the header has"),
    ],
)
def test_a_line_of_a_manifest_that_means_nothing_is_named(
    tmp_path: Path, text: str, message: str
) -> None:
    touch(tmp_path / "i.png")
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputError) as error:
        read_frames(tmp_path / "m.csv")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_no_data_set_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not look like any layout"):
        read_frames(tmp_path)
    with pytest.raises(InputError, match="does not look like 'tum'"):
        read_frames(tmp_path, "tum")
    with pytest.raises(InputError, match="no such folder"):
        read_frames(tmp_path / "lost")
    with pytest.raises(UsageError, match="unknown layout 'nyu'; did you mean"):
        read_frames(tmp_path, "nyu")
    (tmp_path / "rgb").mkdir()
    (tmp_path / "sparse").mkdir()
    with pytest.raises(InputError, match="has no frame"):
        read_frames(tmp_path)


def test_protocols_cut_what_the_paper_says() -> None:
    rows, columns = np.indices((376, 1241))
    part = PROTOCOLS["kitti-odometry"].apply(np.stack([rows, columns], axis=2))
    assert part.shape == (228, 912, 2)
    assert part[0, 0].tolist() == [148, 164]
    assert part[-1, -1].tolist() == [375, 1075]
    rows, columns = np.indices((480, 640))
    part = PROTOCOLS["nyu"].apply(np.stack([rows, columns], axis=2))
    assert part.shape == (228, 304, 2)
    assert part[0, 0].tolist() == [13, 17]  # row 6 and column 8 of every second pixel from 1 on
    with pytest.raises(SizeError, match="912×228"):
        PROTOCOLS["kitti-odometry"].apply(np.zeros((200, 1000)))
    with pytest.raises(UsageError, match="there are whole, nyu"):
        find_protocol("eigen")


@pytest.mark.parametrize("name", PROTOCOLS)
def test_pixel_coordinates_move_as_the_image_is_cut(name: str) -> None:
    protocol = PROTOCOLS[name]
    rows, columns = np.indices((480, 1240))
    part = protocol.apply(np.stack([columns, rows], axis=2))
    row, column = 100, 200
    there = protocol.in_crop(part[row, column][None].astype(np.float32), (480, 1240))
    # the kept pixel is one quarter of a new one away from its centre where pixels are halved
    np.testing.assert_allclose(there[0], [column, row], atol=0.26)


def test_the_shared_frames_are_recognised(shared_data: Path) -> None:
    objects = read_frames(shared_data / "kitti_object")
    assert [f.name for f in objects] == [f"00000{i}" for i in range(4)]
    completion = read_frames(shared_data / "kitti_dc")
    assert len(completion) == 6
    assert completion[0].calib == shared_data / "kitti_dc"
    truth = read_frame_ground_truth(completion[0])
    assert truth.shape == (375, 1242)
    assert 0.15 < np.mean(truth > 0) < 0.25
    scenes = read_frames(shared_data / "7scenes")
    assert len(scenes) == 50
    assert read_frame_image(scenes[0]).shape == (480, 640, 3)
    assert 0.5 < np.median(read_frame_ground_truth(scenes[0])) < 4


def test_a_depth_file_is_read_with_the_scale_of_its_frame(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "frame-000000.color.png"), np.zeros((12, 16, 3), np.uint8))
    codes = np.rint(1000 * DEPTH).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "frame-000000.depth.png"), codes)
    (frame,) = read_frames(tmp_path)
    np.testing.assert_allclose(read_frame_ground_truth(frame), DEPTH, atol=6e-4)
    write_depth(tmp_path / "g.exr", DEPTH)
    (tmp_path / "m.csv").write_text("image,gt\nframe-000000.color.png,g.exr\n")
    assert np.array_equal(read_frame_ground_truth(read_frames(tmp_path / "m.csv")[0]), DEPTH)


def test_a_listing_has_the_files_of_no_frame(tmp_path: Path) -> None:
    tree(tmp_path, TREES["pairs"][0])
    touch(tmp_path / "rgb/c.png", tmp_path / "sparse/d.png", tmp_path / "gt/e.exr")
    touch(tmp_path / "calib/f.txt", tmp_path / "rgb/.hidden.png", tmp_path / "rgb/notes.txt")
    layout, listing = list_frames(tmp_path)
    assert layout == "pairs"
    assert [frame.name for frame in listing.frames] == ["a", "b"]
    assert [each.path.name for each in listing.broken] == ["c.png"]
    assert [each.path.name for each in listing.spare] == ["d.png", "e.exr", "f.txt"]
    assert str(listing.broken[0]).startswith(f"{tmp_path}/rgb/c.png has no partner c.* in ")


def test_folders_in_pairs_go_with_folders_of_the_same_name(tmp_path: Path) -> None:
    for part in ("rgb", "sparse"):
        touch(*(tmp_path / part / file for file in ("x.png", "one/x.png", "two/deep/x.png")))
    touch(tmp_path / "gt/one/x.exr")
    frames = {frame.name: frame for frame in read_frames(tmp_path)}
    assert list(frames) == ["one/x", "two/deep/x", "x"]
    assert frames["two/deep/x"].sparse == tmp_path / "sparse/two/deep/x.png"
    assert [name for name, frame in frames.items() if frame.gt] == ["one/x"]


def test_two_files_of_one_frame_are_both_left_out_and_reported(tmp_path: Path) -> None:
    tree(tmp_path, TREES["pairs"][0])
    touch(tmp_path / "rgb/a.jpg")
    _, listing = list_frames(tmp_path)
    assert [frame.name for frame in listing.frames] == ["b"]
    assert "a.png and a.jpg are one frame; keep one" in str(listing.broken[0])


def test_links_are_followed_but_not_in_circles(tmp_path: Path) -> None:
    tree(tmp_path / "real", TREES["pairs"][0])
    root = tmp_path / "linked"
    root.mkdir()
    for part in ("rgb", "sparse"):
        (root / part).symlink_to(tmp_path / "real" / part)
    (tmp_path / "real/rgb/again").symlink_to(tmp_path / "real/rgb")
    assert [frame.name for frame in read_frames(root)] == ["a", "b"]


def test_a_manifest_names_frames_of_one_stem_by_their_folders(tmp_path: Path) -> None:
    touch(*(tmp_path / "data" / name for name in ("one/x.png", "two/x.png", "y.png")))
    (tmp_path / "m.csv").write_text(
        "image,name\ndata/one/x.png,\ndata/two/x.png,\ndata/y.png,mine\n"
    )
    assert [f.name for f in read_frames(tmp_path / "m.csv")] == ["one/x", "two/x", "mine"]


def test_a_manifest_may_name_files_with_new_lines(tmp_path: Path) -> None:
    touch(tmp_path / "a\nb.png", tmp_path / "c\u2028d.png")
    (tmp_path / "m.csv").write_text('image\n"a\nb.png"\nc\u2028d.png\n', encoding="utf-8")
    (tmp_path / "m.jsonl").write_text(
        '{"image": "a\\nb.png"}\n{"image": "c\u2028d.png"}\n', encoding="utf-8"
    )
    for name in ("m.csv", "m.jsonl"):
        assert [f.name for f in read_frames(tmp_path / name)] == ["a\nb", "c\u2028d"]


def test_a_folder_that_may_not_be_read_is_an_input_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree(tmp_path, TREES["7scenes"][0])

    def locked(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "is_dir", locked)
    with pytest.raises(InputError, match=r"cannot be read \(permission denied\)"):
        list_frames(tmp_path)


def test_tum_pairs_long_lists_without_a_matrix_of_all_times(tmp_path: Path) -> None:
    count = 40_000  # every image with every depth would be 13 GB
    for name, offset in (("rgb", 0.0), ("depth", 0.005)):
        lines = (f"{n / 30 + offset:.6f} {name}/{n}.png\n" for n in range(count))
        (tmp_path / f"{name}.txt").write_text("".join(lines))
    frames = read_frames(tmp_path)
    assert len(frames) == count
    assert all(frame.image.stem == frame.gt.stem for frame in frames)  # type: ignore[union-attr]


def test_a_time_of_tum_that_is_no_number_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").write_text("nan rgb/a.png\n")
    (tmp_path / "depth.txt").write_text("1 depth/a.png\n")
    with pytest.raises(FileFormatError, match=r"rgb\.txt, line 1"):
        read_frames(tmp_path)
