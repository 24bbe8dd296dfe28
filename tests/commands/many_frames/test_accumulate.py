"""`batch --accumulate`: points of neighbouring frames, whatever the shards."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnpdepth_cli.commands.cloud import write_depth_cloud
from pnpdepth_cli.commands.many_frames.find_frames import find_frames
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.cloud_request import CloudRequest
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.io.scans import read_scan
from tests.commands.batches import STEP_M, Recorder, batch, done, drive_on_disk, results
from tests.commands.frames import frame_on_disk

DRIVE = Path(__file__).parents[3] / "samples/drive"


def accumulating(root: Path, **changes: Any) -> list[str]:
    """The names of the frames that are done."""
    poses = root / "poses.txt"
    return done(root, **{"accumulate": 1, "poses": poses, "refine": {"iterations": 2}} | changes)


def record_of(root: Path, name: str) -> Any:
    return json.loads((root / "out" / f"{name}.json").read_text())


def test_points_of_neighbours_lower_the_error_at_held_out_points(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, points=150)
    refine = {"iterations": 0, "propagate": "gp", "holdout": 0.2}
    accumulating(root, refine=refine)
    first, second = record_of(root, "drive_000"), record_of(root, "drive_001")
    assert 40 < first["result"]["points"]["moved"] < second["result"]["points"]["moved"]
    neighbours = [Path(file["path"]).stem for file in second["result"]["neighbours"]]
    assert neighbours == ["drive_000", "drive_002"]
    shutil.rmtree(root / "out")
    batch(root, refine=refine)
    alone = record_of(root, "drive_001")
    assert second["result"]["points"]["held_out"] == alone["result"]["points"]["held_out"] == 30
    errors = [record["errors"]["held_out"]["after"]["mae"] for record in (second, alone)]
    assert errors[0] < 0.85 * errors[1]


def test_points_of_neighbours_are_sampled_from_their_ground_truth(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=2)
    parts = "rgb/{0}.png,sparse/{0}.png,calib/{0}.txt,1000"
    rows = ["image,gt,calib,gt_scale", *map(parts.format, ("drive_000", "drive_001"))]
    (root / "list.csv").write_text("\n".join(rows))
    sample = {"iterations": 0, "sample": SamplePattern(count=50)}
    accumulating(root, source=root / "list.csv", refine=sample)
    points = record_of(root, "drive_000")["result"]["points"]
    assert 20 < points["moved"] <= 50
    assert points["used"] == 50 + points["moved"]


def test_shards_give_the_same_and_a_changed_neighbour_another_run(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path)
    accumulating(root)
    whole = results(root / "out")
    shutil.rmtree(root / "out")
    for number in (1, 2, 3):
        accumulating(root, shard=(number, 3))
    assert results(root / "out") == whole
    (root / "sparse/drive_000.png").write_bytes((root / "sparse/drive_003.png").read_bytes())
    assert accumulating(root) == ["drive_000", "drive_001"]
    rows = (root / "poses.txt").read_text().splitlines()
    (root / "poses.txt").write_text("\n".join([*rows[:3], "1 0 0 0 0 1 0 0 0 0 1 0.35"]))
    assert accumulating(root) == ["drive_002", "drive_003"]


def linked(root: Path, rows: list[str], poses: str = "") -> list[FrameFiles]:
    """The frames of a list with neighbours, and these poses."""
    (root / "list.csv").write_text("\n".join(["name,sparse,camera,calib", *rows]))
    (root / "p.txt").write_text(poses)
    for name in ("s.png", "calib.txt"):
        (root / name).touch()
    files = {"source": root / "list.csv", "poses": root / "p.txt" if poses else None}
    request = BatchRequest(**files, output=root / "out", refine=RefineRequest(), accumulate=2)
    return [*find_frames(request).frames]


def test_neighbours_are_of_one_camera_and_move_to_that_of_the_frame(tmp_path: Path) -> None:
    kinds = [("a_1", 2), ("a_2", 2), ("b_1", 2), ("a_3", 3), ("a_4", 3)]
    rows = [f"{name},s.png,{camera},calib.txt" for name, camera in kinds]
    still, turned = "1 0 0 0 0 1 0 0 0 0 1 0\n", "0 -1 0 4 1 0 0 0 0 0 1 1\n"
    frames = linked(tmp_path, rows, still + turned + 3 * still)
    names = [[neighbour.files.name for neighbour in frame.neighbours] for frame in frames]
    assert names == [["a_2"], ["a_1"], [], ["a_4"], ["a_3"]]
    (of_turned,), (of_still,) = (frame.neighbours for frame in frames[:2])
    assert of_turned.motion == ((0, -1, 0, 4), (1, 0, 0, 0), (0, 0, 1, 1))
    assert of_still.motion is not None
    back = [[0, 1, 0, 0], [-1, 0, 0, 4], [0, 0, 1, -1]]
    np.testing.assert_allclose(of_still.motion, back, atol=1e-12)


def test_neighbours_with_neither_images_nor_poses_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a_2: --accumulate"):
        linked(tmp_path, ["a_1,s.png,,", "a_2,s.png,,"])


def real_drive(root: Path) -> None:
    """The sample's three frames without their poses, and net/ with a network."""
    for folder in ("rgb", "sparse", "calib"):
        shutil.copytree(DRIVE / folder, root / folder)
    (root / "net").mkdir()
    frame_on_disk(root / "net")


def test_poses_that_are_not_given_are_estimated_from_the_images(tmp_path: Path) -> None:
    real_drive(tmp_path)
    listener = Recorder()
    accumulating(tmp_path, listener=listener, limit=1, poses=None)
    record = record_of(tmp_path, "drive_000")
    (neighbour,) = record["result"]["neighbours"]
    assert abs(neighbour["motion"][2][3] - 0.6) < 0.03
    assert "images" in neighbour["poses"]
    assert record["result"]["points"]["moved"] > 500
    assert any(message.startswith("poses: ") for message in listener.messages)
    assert not neighbour.get("contradicts_images", False)


@pytest.mark.parametrize(("turned", "step_m"), [(0.0, 0.6), (0.02, 0.3)])
def test_poses_that_are_given_are_checked_by_the_images(
    turned: float, step_m: float, tmp_path: Path
) -> None:
    real_drive(tmp_path)
    poses = tmp_path / "steps.txt"
    turn = Rotation.from_rotvec([0, turned, 0]).as_matrix()
    step = np.column_stack([turn, [0, 0, step_m]])
    np.savetxt(poses, np.reshape([np.eye(3, 4), step, step], (3, 12)))
    listener = Recorder()
    accumulating(tmp_path, listener=listener, limit=1, poses=poses)
    (neighbour,) = record_of(tmp_path, "drive_000")["result"]["neighbours"]
    assert neighbour.get("contradicts_images", False) == bool(turned)
    assert ("contradict" in " ".join(listener.messages)) == bool(turned)


def test_a_frame_without_motion_or_calibration_fails_with_the_reason(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=2)
    listener = Recorder()
    poses = (root / "poses.txt").rename(root / "kept.txt")
    accumulating(root, listener=listener, poses=None)
    shutil.rmtree(root / "calib")
    accumulating(root, listener=listener, poses=poses)
    ways_out = ["--poses"] * 2 + ["camera"] * 2
    messages = [record.message or "" for record in listener.records]
    assert all(way in message for message, way in zip(messages, ways_out, strict=True))


def test_a_neighbour_that_sees_nothing_of_the_view_adds_no_points(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=3)
    listener = Recorder()
    away = np.column_stack([Rotation.from_rotvec([0, np.radians(150), 0]).as_matrix(), [0, 0, 0]])
    ahead = np.column_stack([np.eye(3), [0, 0, 300.0]])
    np.savetxt(root / "away.txt", np.reshape([away, np.eye(3, 4), ahead], (3, 12)))
    sparse = root / "sparse/drive_002.png"
    assert "drive_001" in accumulating(root, poses=root / "away.txt", listener=listener)
    assert record_of(root, "drive_001")["result"]["points"]["moved"] == 0
    # Nor does one without any point.
    cv2.imwrite(str(sparse), np.zeros_like(cv2.imread(str(sparse), cv2.IMREAD_UNCHANGED)))
    assert "drive_001" in accumulating(root, limit=2, listener=listener)
    assert record_of(root, "drive_001")["result"]["points"]["moved"] > 0
    assert any(sparse.name in note for note in record_of(root, "drive_001")["notes"])


def test_an_estimated_motion_is_said_and_places_the_cloud(tmp_path: Path) -> None:
    real_drive(tmp_path)
    for last in tmp_path.glob("*/drive_002.*"):
        last.unlink()
    accumulating(tmp_path, poses=None, refine={"iterations": 0})
    notes = record_of(tmp_path, "drive_001")["notes"]
    (said,) = (note for note in notes if "estimated from the images" in note)
    assert "drive_000" in said
    # Each frame's farthest point moves by the known 0.6 m a frame.
    output = tmp_path / "all.ply"
    _, of_cloud = write_depth_cloud(CloudRequest(depth=tmp_path / "out", output=output))
    assert any("estimated" in note for note in of_cloud)
    ends = []
    for number in range(2):
        single = tmp_path / f"{number}.ply"
        depth = tmp_path / f"out/drive_{number:03}_depth.png"
        write_depth_cloud(CloudRequest(depth=depth, output=single))
        xyz = read_scan(single)[0]
        ends.append((len(xyz), xyz))
    whole = read_scan(output)[0]
    start = 0
    for number, (count, xyz) in enumerate(ends):
        shift = np.median(whole[start : start + count] - xyz, axis=0)
        np.testing.assert_allclose(shift, [0, 0, 0.6 * number], atol=0.06)
        start += count


def test_poses_go_into_the_records_and_from_there_into_the_cloud(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path / "drive", frames=2)
    other = tmp_path / "other.txt"
    other.write_text((root / "poses.txt").read_text().replace(f"1 {STEP_M}\n", "1 100\n"))
    # Poses of the folder; then of a file, with which the frames that moved are done again.
    farthest, both = [], ["drive_000", "drive_001"]
    for poses, redone, z in ((None, both, STEP_M), (other, both[1:], 100)):
        assert done(root, poses=poses, refine={"iterations": 0}) == redone
        assert record_of(root, "drive_001")["result"]["camera"]["pose"][2][3] == z
        output = tmp_path / f"{z}.ply"
        write_depth_cloud(CloudRequest(depth=root / "out", output=output))
        farthest.append(read_scan(output)[0][:, 2].max())
    assert farthest[1] > farthest[0] + 50
