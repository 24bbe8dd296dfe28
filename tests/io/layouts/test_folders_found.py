"""KITTI's raw drives and downloads, associations, parents of data sets, and unknown folders."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import main
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.layouts import find_layout, list_frames, read_frames
from tests.commands.frames import frame_on_disk
from tests.commands.scan_frames import HEIGHT, WIDTH, scan_on_disk
from tests.empty_files import touch, tree

DRIVE = "2011_09_26_drive_0002_sync"


def raw_drive(root: Path) -> Path:
    date = root / "2011_09_26"
    drive = date / DRIVE
    touch(date / "calib_cam_to_cam.txt", date / "calib_velo_to_cam.txt")
    for number in (5, 6):
        touch(drive / f"velodyne_points/data/{number:010}.bin")
        touch(*(drive / f"image_0{c}/data/{number:010}.png" for c in (2, 3)))
    touch(drive / "image_02/data/0000000007.png")
    return date


@pytest.mark.parametrize("start", [".", "2011_09_26", f"2011_09_26/{DRIVE}"])
def test_a_raw_drive_is_read_with_its_calibration(start: str, tmp_path: Path) -> None:
    date = raw_drive(tmp_path)
    layout, listing = list_frames(tmp_path / start)
    assert layout == "kitti-raw"
    assert [frame.name for frame in listing.frames] == [
        f"{DRIVE}_000000000{n}_image_0{c}" for c in (2, 3) for n in (5, 6)
    ]
    assert {frame.calib for frame in listing.frames} == {date}
    assert [frame.camera for frame in listing.frames] == [2, 2, 3, 3]
    assert len(listing.spare) == 1


def test_a_raw_drive_has_the_annotated_depth_beside_it_as_ground_truth(tmp_path: Path) -> None:
    raw_drive(tmp_path)
    gt = tmp_path / "data_depth_annotated" / "val" / DRIVE / "proj_depth/groundtruth/image_02"
    touch(gt / "0000000005.png")
    frames = read_frames(tmp_path / "2011_09_26")
    assert [frame.gt for frame in frames] == [gt / "0000000005.png", None, None, None]


def test_kittis_depth_as_downloaded_pairs_annotated_velodyne_and_raw(tmp_path: Path) -> None:
    inside = Path(DRIVE, "proj_depth")
    scan = tmp_path / "data_depth_velodyne/train" / inside / "velodyne_raw/image_02/0000000005.png"
    gt = tmp_path / "data_depth_annotated/train" / inside / "groundtruth/image_02/0000000005.png"
    image = tmp_path / "raw/2011_09_26" / DRIVE / "image_02/data/0000000005.png"
    touch(scan, gt, image)
    for start in (tmp_path, tmp_path / "data_depth_velodyne"):
        (frame,) = read_frames(start)
        assert (frame.sparse, frame.gt, frame.image) == (scan, gt, image)


@pytest.mark.parametrize(
    "line", ["0 depth/0.png 0 rgb/0.png", "1.5 rgb/0.png 1.51 depth/0.png  # TUM's own order"]
)
def test_associations_pair_images_and_depth(line: str, tmp_path: Path) -> None:
    (tmp_path / "associations.txt").write_text(f"# comment\n{line}\n")
    (frame,) = read_frames(tmp_path)
    assert (frame.image, frame.gt) == (tmp_path / "rgb/0.png", tmp_path / "depth/0.png")
    assert frame.gt_scale == 5000
    (tmp_path / "associations.txt").write_text("0 rgb/0.png 0\n")
    with pytest.raises(FileFormatError, match=r"line 1: .* is not a time and a path of rgb"):
        read_frames(tmp_path)


def test_associated_frames_have_the_poses_at_the_times_of_their_images(tmp_path: Path) -> None:
    (tmp_path / "associations.txt").write_text("1 depth/1.png 1.5 rgb/1.png\n")
    (tmp_path / "groundtruth.txt").write_text("1 5 0 0 0 0 0 1\n1.5 7 0 0 0 0 0 1\n")
    (frame,) = read_frames(tmp_path)
    assert frame.pose == ((1, 0, 0, 7), (0, 1, 0, 0), (0, 0, 1, 0))


def test_the_parent_of_data_sets_of_one_layout_has_their_frames(tmp_path: Path) -> None:
    for scene in ("chess", "fire"):
        for kind in ("color", "depth"):
            touch(tmp_path / scene / "seq-01" / f"frame-000000.{kind}.png")
    layout, listing = list_frames(tmp_path)
    assert layout == "7scenes"
    assert [frame.name for frame in listing.frames] == [
        "chess/seq-01_frame-000000",
        "fire/seq-01_frame-000000",
    ]
    touch(tmp_path / "mine/rgb/a.png", tmp_path / "mine/sparse/a.png")
    with pytest.raises(InputError, match=r"several layouts \(7scenes, pairs\); give"):
        list_frames(tmp_path)
    assert len(list_frames(tmp_path, "pairs")[1].frames) == 1


@pytest.mark.parametrize(
    ("files", "nearest", "lacking"),
    [
        ("image_2/0.png calib/0.txt", "'kitti-object', which needs image_2, velodyne", "velodyne"),
        (
            f"2011_09_26/{DRIVE}/image_02/data/0.png 2011_09_26/calib_cam_to_cam.txt",
            "'kitti-raw', which needs velodyne_points/data, image_0[23]/data",
            "velodyne_points/data",
        ),
    ],
)
def test_an_unknown_folder_names_the_nearest_layout_and_what_it_lacks(
    files: str, nearest: str, lacking: str, tmp_path: Path
) -> None:
    tree(tmp_path, files)
    with pytest.raises(InputError, match=rf"nearest is {re.escape(nearest)}.* lacks {lacking}$"):
        find_layout(tmp_path)
    with pytest.raises(InputError, match="does not look like 'pairs', which needs rgb, sparse"):
        find_layout(tmp_path, "pairs")


def test_a_folder_that_is_near_no_layout_lists_what_they_need(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"layouts need: .*; pairs rgb, sparse; ") as caught:
        find_layout(tmp_path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 2000


def test_points_are_sampled_from_the_scan_that_is_the_ground_truth(tmp_path: Path) -> None:
    scene = scan_on_disk(tmp_path)
    sequence = tmp_path / "sequences" / "00"
    for name in ("image_2", "velodyne"):
        (sequence / name).mkdir(parents=True)
    shutil.copy(scene.image, sequence / "image_2" / "000000.png")
    shutil.copy(scene.scan, sequence / "velodyne" / "000000.bin")
    (sequence / "calib.txt").write_text(
        "P2: 60 0 31.5 0 0 60 23.5 0 0 0 1 0\nTr: 0 -1 0 0.1 0 0 -1 -0.05 1 0 0 -0.2\n"
    )
    frame = frame_on_disk(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(
            [
                *("batch", str(tmp_path / "sequences"), "-o", str(tmp_path / "out")),
                *("--sample", "50", "--layout", "kitti-odometry", "--protocol", "whole"),
                *("--iterations", "1", "--model", str(frame.model)),
                *("--checkpoint", str(frame.checkpoint)),
            ]
        )
    assert ended.value.code == 0
    (row,) = json.loads((tmp_path / "out" / "summary.json").read_text())["frames"]
    assert row["points"]["used"] == 50
    assert row["size"] == [WIDTH, HEIGHT]
    assert 50 < row["scores"]["after"]["pixels"] <= 150
