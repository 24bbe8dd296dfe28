"""`batch --accumulate`: points of neighbouring frames, whatever the shards."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.pipeline.batch.sequence import with_neighbours
from pnpdepth_cli.pipeline.batch.sequence_options import SequenceOptions
from tests.pipeline.batches import Heard, batch
from tests.pipeline.drives import drive_on_disk, without_results


def accumulating(root: Path, **changes: Any) -> Any:
    sequence = SequenceOptions(accumulate=1, poses=root / "poses.txt")
    return batch(root, **{"sequence": sequence, "refine": {"iterations": 2}} | changes)


def record_of(root: Path, name: str) -> Any:
    return json.loads((root / "out" / f"{name}.json").read_text())


def depths(root: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((root / "out").glob("*_depth.png"))}


def test_a_frame_takes_the_points_of_its_neighbours(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, points=150)
    accumulating(root)
    first, second = record_of(root, "drive_000"), record_of(root, "drive_001")
    assert first["points"]["moved"] > 60
    assert second["points"]["moved"] > first["points"]["moved"]
    assert [Path(each["path"]).name for each in second["inputs"]["neighbours"]] == [
        "drive_000.png",
        "drive_002.png",
    ]


def test_held_out_points_are_the_frames_own_and_score_better(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, points=150)
    refine = {"iterations": 0, "propagate": "gp", "holdout": 0.2}
    accumulating(root, refine=refine)
    more = record_of(root, "drive_001")
    without_results(root)
    batch(root, refine=refine)
    alone = record_of(root, "drive_001")
    assert more["points"]["held_out"] == alone["points"]["held_out"] == 30
    errors = [each["held_out_error"]["after"]["mae"] for each in (more, alone)]
    assert errors[0] < 0.85 * errors[1]


def test_the_bytes_do_not_depend_on_the_shards(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path)
    accumulating(root)
    whole = depths(root)
    without_results(root)
    for number in (1, 2, 3):
        accumulating(root, shard=(number, 3))
    assert len(whole) == 4
    assert depths(root) == whole


def test_a_frame_is_done_again_when_a_neighbours_points_change(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path)
    accumulating(root)
    (root / "sparse/drive_000.png").write_bytes((root / "sparse/drive_003.png").read_bytes())
    heard = Heard()
    accumulating(root, heard=heard)
    assert heard.names == ["drive_000", "drive_001"]


def test_other_poses_make_frames_be_done_again(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path)
    accumulating(root)
    rows = (root / "poses.txt").read_text().splitlines()
    (root / "poses.txt").write_text("\n".join([*rows[:3], "1 0 0 0 0 1 0 0 0 0 1 0.35"]))
    heard = Heard()
    accumulating(root, heard=heard)
    assert heard.names == ["drive_002", "drive_003"]


def test_frames_of_another_sequence_or_camera_are_no_neighbours(tmp_path: Path) -> None:
    pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    kinds = [("a_1", 2), ("a_2", 2), ("b_1", 2), ("a_1", 3), ("a_2", 3)]
    frames = [
        Frame(name=name, sparse=tmp_path / f"{name}_{camera}.png", camera=camera, pose=pose)
        for name, camera in kinds
    ]
    linked = with_neighbours(frames, 2, None)
    assert [[each.sparse.stem for each in frame.neighbours] for frame in linked] == [
        ["a_2_2"], ["a_1_2"], [], ["a_2_3"], ["a_1_3"],
    ]  # fmt: skip


def test_motion_leads_from_the_neighbours_camera_to_the_frames() -> None:
    turned = ((0.0, -1.0, 0.0, 4.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0))
    still = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    frames = [
        Frame(name=f"a_{number}", sparse=Path("s.png"), pose=pose)
        for number, pose in enumerate((still, turned))
    ]
    (of_turned,) = with_neighbours(frames, 1, None)[0].neighbours
    (of_still,) = with_neighbours(frames, 1, None)[1].neighbours
    assert of_turned.motion == turned
    np.testing.assert_allclose(
        of_still.motion, [[0, 1, 0, 0], [-1, 0, 0, 4], [0, 0, 1, -1]], atol=1e-12
    )


@pytest.mark.parametrize(
    ("frame", "error", "says"),
    [
        (Frame(name="a", sparse=Path("s.png")), InputError, "a has no camera pose"),
        (Frame(name="a", pose=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0))), UsageError, "sampled"),
    ],
)
def test_what_accumulation_lacks_is_named(
    frame: Frame, error: type[PnpDepthError], says: str
) -> None:
    with pytest.raises(error, match=says):
        with_neighbours([frame, frame], 1, None)


def test_the_command_names_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = drive_on_disk(tmp_path, frames=2)
    command = ["batch", str(root), "-o", str(root / "out"), "--iterations", "1"]
    command += ["--model", str(root / "net/my_net.py")]
    assert run([*command, "--accumulate", "2"]) == 3
    assert "has no camera pose, which --accumulate needs" in capsys.readouterr().err
    (root / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    assert run([*command, "--accumulate", "2", "--poses", str(root / "poses.txt")]) == 3
    assert "has 1 poses for 2 frames" in capsys.readouterr().err
    assert run([*command, "--poses", str(root / "poses.txt")]) == 2
    assert run([*command, "--accumulate", "-1"]) == 2
    assert not (root / "out").exists()


def test_a_frame_without_calibration_fails_with_the_reason(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=2)
    (root / "calib/drive_001.txt").unlink()
    (root / "calib/drive_000.txt").unlink()
    (root / "calib").rmdir()
    heard = Heard()
    accumulating(root, heard=heard)
    assert ["needs the camera" in row["message"] for row in heard.rows] == [True, True]
