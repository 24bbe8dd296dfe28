"""nuScenes and DDAD: the scan is moved to the image's time by the poses of the car."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.commands.batch.frames import find_frames, task_of
from pnpdepth_cli.commands.batch.records import settings_of
from pnpdepth_cli.commands.batch.request import BatchRequest, SequenceOptions
from pnpdepth_cli.commands.refinement.inputs import read_inputs
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.layouts import find_layout, list_frames
from tests.data_sets import PINHOLE, ddad_scene, nuscenes, read_frames


def request_of(root: Path, **more: Any) -> BatchRequest:
    return BatchRequest(source=root, output=root / "out", refine=RefineRequest(), **more)


def test_a_scan_is_moved_to_the_time_of_the_image(tmp_path: Path) -> None:
    nuscenes(tmp_path)
    (frame,) = read_frames(tmp_path)
    assert (frame.name, frame.group) == ("scene-0001/a", "scene-0001/CAM_FRONT")
    points = read_inputs(task_of(request_of(tmp_path), frame).request).points
    # 10.5 m ahead of the LiDAR is 10 m ahead of the camera, and 9.5 m once the car has moved
    np.testing.assert_allclose(points.depth, 9.5, rtol=1e-6)
    expected = [[31.5, 23.5], [31.5 - 60 * 2 / 9.5, 23.5]]
    np.testing.assert_allclose(points.xy, expected, atol=1e-4)


def test_the_scan_of_ddad_is_seen_from_the_camera_at_the_images_time(tmp_path: Path) -> None:
    ddad_scene(tmp_path / "000000")
    points = read_inputs(task_of(request_of(tmp_path), read_frames(tmp_path)[0]).request).points
    # 10 m ahead on the axis, and 2 m to the left of it
    np.testing.assert_allclose(points.depth, [10, 10], atol=1e-5)
    np.testing.assert_allclose(points.xy, [[31.5, 23.5], [19.5, 23.5]], atol=1e-4)


def test_a_changed_pose_of_the_car_is_another_setting(tmp_path: Path) -> None:
    digests = set()
    for moved in (0.5, 0.6, 0.5):
        nuscenes(tmp_path, moved=moved)
        (frame,) = read_frames(tmp_path)
        digests.add(repr(settings_of(task_of(request_of(tmp_path), frame).request, {})))
    assert len(digests) == 2


def test_each_camera_of_each_sample_is_a_frame_of_one_sequence(tmp_path: Path) -> None:
    ddad_scene(tmp_path / "000001", samples=1)
    ddad_scene(tmp_path / "000000")
    assert [(frame.name, frame.group) for frame in read_frames(tmp_path, "ddad")] == [
        ("000000/CAMERA_01_0", "000000/CAMERA_01"),
        ("000000/CAMERA_01_1", "000000/CAMERA_01"),
        ("000001/CAMERA_01_0", "000001/CAMERA_01"),
    ]
    assert find_layout(tmp_path / "000000") == "ddad"


def test_the_poses_of_the_cameras_serve_accumulation(tmp_path: Path) -> None:
    ddad_scene(tmp_path / "000000")
    sequence = SequenceOptions(accumulate=1)
    first = find_frames(request_of(tmp_path, sequence=sequence)).frames[0]
    (neighbour,) = first.neighbours
    assert neighbour.poses == "the layout's"
    np.testing.assert_allclose(np.array(neighbour.motion)[:, 3], [0, 0, 0.5], atol=1e-9)


def test_a_sample_without_its_scan_is_left_out(tmp_path: Path) -> None:
    ddad_scene(tmp_path / "ddad/000000")
    (tmp_path / "ddad/000000/point_cloud/LIDAR/1.npz").unlink()
    _, listing = list_frames(tmp_path / "ddad")
    assert [frame.name for frame in listing.frames] == ["000000/CAMERA_01_0"]
    assert listing.broken[0].path == tmp_path / "ddad/000000/rgb/CAMERA_01/1.png"
    nuscenes(tmp_path / "nuscenes")
    (tmp_path / "nuscenes/samples/LIDAR_TOP/a.pcd.bin").unlink()
    _, listing = list_frames(tmp_path / "nuscenes")
    assert "or its LiDAR scan does not exist" in str(listing.broken[0])


@pytest.mark.parametrize("intrinsics", [PINHOLE | {"k1": 0.1}, {"fx": 60.0}, PINHOLE | {"fx": 0}])
def test_a_camera_that_is_no_pinhole_is_refused(
    intrinsics: dict[str, float], tmp_path: Path
) -> None:
    ddad_scene(tmp_path / "000000", intrinsics=intrinsics)
    with pytest.raises(FileFormatError, match="is incomplete or of another kind"):
        list_frames(tmp_path)


@pytest.mark.parametrize("text", ["[]", "{}", "{", '{"data": [1], "samples": []}'])
def test_a_damaged_scene_is_refused_in_one_line(text: str, tmp_path: Path) -> None:
    ddad_scene(tmp_path / "000000")
    (tmp_path / "000000/scene_0a.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"scene_0a\.json"):
        list_frames(tmp_path)


@pytest.mark.parametrize(
    ("table", "change"),
    [
        ("scene", {"name": None}),
        ("sample_data", {"filename": None}),
        ("sample_data", {"height": "x"}),
        ("sample_data", {"height": 10**400}),
        ("ego_pose", {"rotation": [10**400, 0, 0, 0]}),
        ("ego_pose", {"token": "other"}),
        ("scene", None),
    ],
)
def test_odd_values_in_the_tables_of_nuscenes_are_one_line(
    table: str, change: dict[str, Any] | None, tmp_path: Path
) -> None:
    nuscenes(tmp_path)
    path = tmp_path / f"v1.0-mini/{table}.json"
    rows = [None, 3] if change is None else [row | change for row in json.loads(path.read_text())]
    path.write_text(json.dumps(rows))
    with pytest.raises(FileFormatError, match=r"\A.*\Z"):
        list_frames(tmp_path)
