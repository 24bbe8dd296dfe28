"""`batch --warm-start`: windows of frames, each beginning where the one before ended."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.commands.batch.request import SequenceOptions
from tests.commands.batches import RecordingListener, batch, depths, done
from tests.commands.drives import drive_on_disk, without_results

REFINE = {"iterations": 3, "update": "sign", "lr": "0.02"}


def warm(root: Path, length: int = 3, **changes: Any) -> list[str]:
    """The names of the frames that are done."""
    sequence = SequenceOptions(warm_start=length)
    return done(root, **{"sequence": sequence, "refine": REFINE} | changes)


def records(root: Path) -> list[Any]:
    return [json.loads(path.read_text()) for path in sorted((root / "out").glob("drive_*.json"))]


def test_a_frame_begins_where_the_one_before_ended_and_a_window_anew(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=5)
    warm(root)
    of_windows = records(root)
    without_results(root)
    batch(root, refine=REFINE)
    alone = records(root)
    assert [each["warm_start"] for each in of_windows] == [False, True, True, False, True]
    for index in (0, 3):
        assert of_windows[index]["loss"] == alone[index]["loss"]
    for index in (1, 2, 4):
        assert of_windows[index]["loss"][0] < alone[index]["loss"][0]
        assert of_windows[index]["loss"][-1] < alone[index]["loss"][-1]
        assert of_windows[index]["sparse_error"]["before"] == alone[index]["sparse_error"]["before"]


def test_a_shard_has_whole_windows_so_the_bytes_do_not_depend_on_it(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=5)
    warm(root, length=2)
    whole = depths(root)
    without_results(root)
    parts = [warm(root, length=2, shard=(number, 2)) for number in (2, 1)]
    assert parts == [["drive_002", "drive_003"], ["drive_000", "drive_001", "drive_004"]]
    assert depths(root) == whole


def test_a_missing_result_is_made_again_from_the_start_of_its_window(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=5)
    warm(root)
    whole = depths(root)
    (root / "out/drive_002_depth.png").unlink()
    assert warm(root) == ["drive_002"]
    assert depths(root) == whole
    image = cv2.imread(str(root / "rgb/drive_001.png"))
    cv2.imwrite(str(root / "rgb/drive_001.png"), 255 - image)
    assert warm(root) == ["drive_001", "drive_002"]


def test_no_start_is_taken_across_a_cut(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=3)
    far = root / "sparse/drive_001.png"
    codes = cv2.imread(str(far), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(far), np.where(codes > 0, 500, 0).astype(np.uint16))  # all at half a metre
    warm(root, refine={**REFINE, "depth_scale": 1000.0})
    assert [each["warm_start"] for each in records(root)][1] is False


def test_a_frame_that_fails_does_not_end_its_window(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=3)
    (root / "rgb/drive_001.png").write_bytes(b"no image")
    listener = RecordingListener()
    warm(root, listener=listener)
    assert [row["status"] for row in listener.rows] == ["done", "failed", "done"]
    assert records(root)[-1]["warm_start"] is True


@pytest.mark.slow
def test_weights_are_carried_over_in_a_window(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=4)
    refine = {"model": "sparse2dense-tiny", "checkpoint": None, "target": "masked"}
    refine |= {"iterations": 4, "propagate": "none"}
    warm(root, length=4, refine=refine)
    taken = [each["warm_start"] for each in records(root)]
    assert taken[0] is False
    assert any(taken[1:])
    whole = depths(root)
    without_results(root)
    warm(root, length=4, refine=refine)
    assert depths(root) == whole
