"""Predictions and truths matched by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.pairing import (
    FramePair,
    frame_name,
    pair_frames,
)
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.depth import write_depth
from tests.empty_files import touch


def depth_at(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_depth(path, np.full((3, 4), 2, np.float32))
    return path


def folders(root: Path, predictions: list[str], truths: list[str]) -> tuple[Path, Path]:
    for folder, names in (("out", predictions), ("gt", truths)):
        (root / folder).mkdir()
        for name in names:
            depth_at(root / folder / name)
    return root / "out", root / "gt"


def matched(pairs: list[FramePair]) -> dict[str, str | None]:
    return {files.name: result.depth.name if result else None for files, result in pairs}


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


MATCHED = [
    (  # the files of a refinement, and ground truth without images
        [f"b_{part}.png" for part in ("depth", "preview", "sigma", "improvement")]
        + ["ä ö_depth.exr", "b.png"],
        ["b.png", "ä ö.npy"],
        {"b": "b_depth.png", "ä ö": "ä ö_depth.exr"},
        [],
    ),
    (  # frames in folders of their own
        ["one/1_depth.png", "two/1_depth.png"],
        ["one/1.png", "two/1.png", "two/2.png"],
        {"one/1": "1_depth.png", "two/1": "1_depth.png", "two/2": None},
        [],
    ),
    (
        [*(f"{name}.png" for name in "avwxyz"), ".b.png", ".hidden/c.png"],
        ["a.png", "b.png"],
        {"a": "a.png", "b": None},
        ["warning: 5 of 6 predictions have no ground truth and are not scored: v, w, x, y, z"],
    ),
]


@pytest.mark.parametrize(("predictions", "truths", "expected", "notes"), MATCHED)
def test_files_are_matched_by_name_and_what_is_left_is_reported(
    tmp_path: Path,
    predictions: list[str],
    truths: list[str],
    expected: dict[str, str | None],
    notes: list[str],
) -> None:
    pairs, own_notes = pair_frames(*folders(tmp_path, predictions, truths))
    assert (matched(pairs), own_notes) == (expected, notes)


REFUSED = [
    (["a.npy", "a.png"], ["a.png"], "out", "gt", InputError, "one frame"),
    (["a_depth.png", "a.depth.png"], ["a.png"], "out", "gt", InputError, "one frame"),
    (["a.png"], [], "out", "gt", InputError, "gt holds no depth file"),
    (["a.png"], ["a.png"], "out/b.png", "gt/a.png", InputError, "b.png"),
    (["1.png"], ["0001.png"], "out", "gt", InputError, "are 1; ground truth is 0001"),
    (["a.png"], ["a.png"], "out/a.png", "gt", UsageError, "two files"),
    (["a.png"], ["a.png"], "out", "gt/a.png", UsageError, "two files"),
    (["a.png"], ["a.png"], "out/a.png", "list.csv", UsageError, "two files"),
    (["a.png"], ["a.png"], "out", "list.csv", InputError, "'manifest'"),  # without ground truth
]


@pytest.mark.parametrize(("predictions", "truths", "first", "second", "error", "message"), REFUSED)
def test_what_cannot_be_matched_is_refused(
    tmp_path: Path,
    predictions: list[str],
    truths: list[str],
    first: str,
    second: str,
    error: type[Exception],
    message: str,
) -> None:
    folders(tmp_path, predictions, truths)
    touch(tmp_path / "a.png")
    (tmp_path / "list.csv").write_text("image,sparse,name\na.png,out/a.png,a")
    with pytest.raises(error, match=message):
        pair_frames(tmp_path / first, tmp_path / second)


def test_a_folder_of_data_sets_is_read_as_a_batch_reads_it(tmp_path: Path) -> None:
    for place in ("north", "south"):
        touch(tmp_path / f"sets/{place}/image/0.png", tmp_path / f"sets/{place}/depth/0.png")
        depth_at(tmp_path / f"out/{place}/0_depth.png")
    (tmp_path / "out/summary.json").write_text(json.dumps({"layout": "image-depth"}))
    pairs, _ = pair_frames(tmp_path / "out", tmp_path / "sets")
    assert [files.name for files, _ in pairs] == ["north/0", "south/0"]
    assert all(result is not None for _, result in pairs)


def test_two_files_are_one_frame_whatever_they_are_called(tmp_path: Path) -> None:
    ((files, _),), _ = pair_frames(depth_at(tmp_path / "p_depth.png"), depth_at(tmp_path / "g.npy"))
    assert (files.name, files.gt) == ("p", tmp_path / "g.npy")


def test_the_record_beside_a_prediction_names_its_sparse_depth(tmp_path: Path) -> None:
    out, gt = folders(tmp_path, ["a_depth.png", "b_depth.png", "c_depth.png"],
                      ["a.png", "b.png", "c.png"])  # fmt: skip
    sparse, image = depth_at(tmp_path / "s.png"), depth_at(tmp_path / "i.png")
    inputs = {"sparse": FileRecord(path=str(sparse)), "image": FileRecord(path=str(image))}
    FrameRecord(inputs=inputs).write(out / "a.json")
    scan = FileRecord(path=str(sparse), calibration="calib.txt")
    FrameRecord(inputs={"sparse": scan}).write(out / "b.json")
    (out / "c.json").write_text("not JSON at all")
    frames, _ = pair_frames(out, gt)
    inputs = [(files.sparse, files.image) for files, _ in frames]
    assert inputs == [(sparse, image), (None, None), (None, None)]
