"""Predictions and truths matched by name."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.pairing import Pairs, frame_name, pair_frames
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.depth import write_depth

DEPTH = np.full((3, 4), 2, np.float32)


def depth_at(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_depth(path, DEPTH)
    return path


def folders(root: Path, predictions: list[str], truths: list[str]) -> tuple[Path, Path]:
    for name in predictions:
        depth_at(root / "out" / name)
    for name in truths:
        depth_at(root / "gt" / name)
    return root / "out", root / "gt"


def matched(pairs: Pairs) -> dict[str, str | None]:
    return {f.name: f.prediction.name if f.prediction else None for f in pairs.frames}


NAMES = [
    ("a", "a"),
    ("a_depth", "a"),
    ("frame-000000.depth", "frame-000000"),
    ("_depth", "_depth"),
    ("2011_09_26_drive_0002_sync_groundtruth_depth_0000000005_image_02",
     "2011_09_26_drive_0002_sync_0000000005_image_02"),
    ("2011_09_26_drive_0002_sync_image_0000000005_image_02_depth",
     "2011_09_26_drive_0002_sync_0000000005_image_02"),
]  # fmt: skip


@pytest.mark.parametrize(("stem", "name"), NAMES)
def test_a_stem_names_its_frame(stem: str, name: str) -> None:
    assert frame_name(stem) == name


def test_the_files_of_a_refinement_are_paired_with_ground_truth_without_images(
    tmp_path: Path,
) -> None:
    out, gt = folders(
        tmp_path,
        ["b_depth.png", "b_preview.png", "b_improvement.png", "ä ö_depth.exr", "b.png"],
        ["b.png", "ä ö.npy"],
    )
    pairs = pair_frames(out, gt)
    assert matched(pairs) == {"b": "b_depth.png", "ä ö": "ä ö_depth.exr"}
    assert not pairs.single
    assert pairs.notes == (f"{out}: ignored, as there is a _depth of each: b.png",)


def test_frames_in_folders_of_their_own_are_matched_with_the_folder(tmp_path: Path) -> None:
    out, gt = folders(
        tmp_path, ["one/1_depth.png", "two/1_depth.png"], ["one/1.png", "two/1.png", "two/2.png"]
    )
    pairs = pair_frames(out, gt)
    assert matched(pairs) == {"one/1": "1_depth.png", "two/1": "1_depth.png", "two/2": None}


def test_missing_predictions_are_listed_and_extra_predictions_reported(
    tmp_path: Path,
) -> None:
    out, gt = folders(tmp_path, ["a.png", "x.png", "y.png"], ["a.png", "b.png"])
    pairs = pair_frames(out, gt)
    assert matched(pairs) == {"a": "a.png", "b": None}
    assert pairs.notes == (
        "warning: 2 of 3 predictions have no ground truth and are not scored: x, y",
    )


def test_hidden_files_links_in_circles_and_unreadable_folders_do_no_harm(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["a.png", ".b.png", ".hidden/c.png"], ["a.png"])
    (out / "circle").symlink_to(out, target_is_directory=True)
    (out / "self.png").symlink_to(out / "self.png")
    assert matched(pair_frames(out, gt)) == {"a": "a.png"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root can read every folder")
def test_an_unreadable_folder_is_reported(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["a.png", "closed/b.png"], ["a.png"])
    (out / "closed").chmod(0)
    try:
        (note,) = pair_frames(out, gt).notes
    finally:
        (out / "closed").chmod(0o700)
    assert "closed cannot be read" in note


def test_two_files_of_one_frame_are_refused(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["a.npy", "a.png"], ["a.png"])
    with pytest.raises(InputError, match=r"a\.png and a\.npy are one frame"):
        pair_frames(out, gt)


def test_an_empty_folder_and_one_without_depth_are_refused(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["a.png"], ["a.png"])
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "a.jpg").write_bytes(b"x")
    with pytest.raises(InputError, match="holds no depth file"):
        pair_frames(tmp_path / "empty", gt)
    with pytest.raises(InputError, match="holds no depth file"):
        pair_frames(out, tmp_path / "empty")


def test_folders_without_a_common_name_are_refused_with_both_kinds_of_names(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["1.png"], ["0001.png"])
    with pytest.raises(InputError) as error:
        pair_frames(out, gt)
    assert str(error.value) == (
        "no prediction has the name of a ground truth file: predictions are 1; ground truth is 0001"
    )


def test_two_files_are_one_frame_whatever_they_are_called(tmp_path: Path) -> None:
    pairs = pair_frames(depth_at(tmp_path / "p_depth.png"), depth_at(tmp_path / "g.npy"))
    assert pairs.single
    assert matched(pairs) == {"p": "p_depth.png"}
    assert pairs.frames[0].frame.gt == tmp_path / "g.npy"


def test_a_file_and_a_folder_or_nothing_at_all_are_refused(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["a.png"], ["a.png"])
    with pytest.raises(UsageError, match="two files or two folders"):
        pair_frames(out / "a.png", gt)
    with pytest.raises(UsageError, match="two files or two folders"):
        pair_frames(out, gt / "a.png")
    with pytest.raises(InputError, match="no such file or folder"):
        pair_frames(out, tmp_path / "nothing")


def test_sparse_depth_and_masks_are_one_for_all_or_one_for_each(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["a.png", "b.png"], ["a.png", "b.png"])
    one = depth_at(tmp_path / "one.png")
    depth_at(tmp_path / "each" / "b.png")
    pairs = pair_frames(out, gt, sparse=one, mask=tmp_path / "each")
    assert [f.sparse for f in pairs.frames] == [one, one]
    assert [f.mask for f in pairs.frames] == [None, tmp_path / "each" / "b.png"]
    assert all(f.sparse_named for f in pairs.frames)


def test_the_record_beside_a_prediction_names_its_sparse_depth(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["a_depth.png", "b_depth.png", "c_depth.png"],
                      ["a.png", "b.png", "c.png"])  # fmt: skip
    sparse, image = depth_at(tmp_path / "s.png"), depth_at(tmp_path / "i.png")
    inputs = {"sparse": {"path": str(sparse)}, "image": {"path": str(image)}}
    (out / "a.json").write_text(json.dumps({"inputs": inputs}))
    scan = {"sparse": {"path": str(sparse), "calibration": "calib.txt"}}
    (out / "b.json").write_text(json.dumps({"inputs": scan}))
    (out / "c.json").write_text("not JSON at all")
    frames = pair_frames(out, gt).frames
    assert [(f.sparse, f.image) for f in frames] == [(sparse, image), (None, None), (None, None)]
    assert not frames[0].sparse_named


def test_the_ground_truth_can_be_a_data_set_of_a_known_layout(tmp_path: Path) -> None:
    out, _ = folders(tmp_path, ["a_depth.png", "b_depth.png"], [])
    data = tmp_path / "data"
    for name in ("rgb/a.png", "rgb/b.png", "sparse/a.png", "sparse/b.png", "gt/a.png"):
        depth_at(data / name)
    pairs = pair_frames(out, data)
    assert matched(pairs) == {"a": "a_depth.png"}
    assert pairs.notes[0] == "gt: layout pairs; frames with ground truth: 1"
    assert pairs.frames[0].sparse == data / "sparse" / "a.png"
