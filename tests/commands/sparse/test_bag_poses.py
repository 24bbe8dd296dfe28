"""Poses of a bag: of odometry, poses and transforms, at the times of the images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import find_frames, unpack
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.commands.sparse import bag_frames
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.bags import open_bag
from pnpdepth_cli.io.bags.messages import camera_trajectory
from pnpdepth_cli.io.poses import read_poses
from pnpdepth_cli.io.text_files import read_json
from tests.bags import write_bag
from tests.commands.sparse.test_bags import KINDS, written

FORWARD = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
"""The camera in base: z is base's x."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("poses", "topic"), [("odometry", "/odom"), ("tf", "/tf")])
def test_the_camera_moves_as_the_body_that_it_is_fixed_to(
    kind: str, poses: str, topic: str, tmp_path: Path
) -> None:
    messages = written(write_bag(tmp_path / kind, poses=poses), tmp_path / "frames")
    assert messages[-1] == f"poses: of {topic}"
    rows = read_poses(tmp_path / "frames/poses.txt")
    assert rows.shape == (3, 3, 4)
    np.testing.assert_allclose(rows[:, :, :3], [FORWARD] * 3, atol=1e-9)
    np.testing.assert_allclose(rows[:, :, 3], [[1, 0, 0], [1.3, 0, 0], [1.6, 0, 0]], atol=1e-5)
    assert read_json(tmp_path / "frames/frames.json")["poses"] == topic


def test_a_pose_message_is_the_cameras_own(tmp_path: Path) -> None:
    written(write_bag(tmp_path / "drive.mcap", poses="pose"), tmp_path / "frames")
    rows = read_poses(tmp_path / "frames/poses.txt")
    np.testing.assert_allclose(rows[:, :, :3], [np.eye(3)] * 3, atol=1e-9)
    np.testing.assert_allclose(rows[:, 0, 3], [0, 0.3, 0.6], atol=1e-5)


@pytest.mark.parametrize(
    ("poses", "said"),
    [
        ("odometry", "warning: no transforms tie the camera's frame camera to the poses of /odom"),
        ("", "calibration"),
    ],
)
def test_without_poses_of_the_camera_none_are_written(
    poses: str, said: str, tmp_path: Path
) -> None:
    bag = write_bag(tmp_path / "drive.mcap", poses=poses, static=not poses)
    messages = written(bag, tmp_path / "frames")
    assert messages[-1].startswith(said)
    assert not (tmp_path / "frames/poses.txt").exists()
    assert read_json(tmp_path / "frames/frames.json")["poses"] is None


def test_poses_that_are_missing_for_some_images_are_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_frames, "_LONGEST_GAP_S", 0.02)  # they are 0.03 s apart
    messages = written(write_bag(tmp_path / "drive.mcap", poses="odometry"), tmp_path / "frames")
    assert "warning: 3 of 3 images have no pose in /odom within 0.02 s" in messages[-1]
    assert not (tmp_path / "frames/poses.txt").exists()


def test_a_topic_without_poses_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive.mcap", poses="odometry")
    with pytest.raises(UsageError, match=r"no topic /gps of .*/odom"):
        written(bag, tmp_path / "frames", topics=("/gps",))


def test_a_fixed_transform_that_is_repeated_is_no_motion(tmp_path: Path) -> None:
    with open_bag(write_bag(tmp_path / "drive.mcap", poses="tf")) as bag:
        trajectory = camera_trajectory(bag, "/tf", "camera")
        assert trajectory is not None
        assert len(trajectory.times_s) == 4
        assert camera_trajectory(bag, "/tf_static", "camera") is None


def test_a_batch_of_a_bag_accumulates_with_its_poses(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive.mcap", poses="odometry")
    request = BatchRequest(
        source=bag,
        output=tmp_path / "out",
        refine=RefineRequest(),
        accumulate=1,
    )
    (neighbour,) = find_frames(unpack(request, lambda text: None)).frames[0].neighbours
    assert neighbour.poses.startswith(str(tmp_path / "out_frames/poses.txt"))
