"""nuScenes' tables, synthetic: the scan is moved to the image's time by the poses of the car."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.commands.batch.frames import task_of
from pnpdepth_cli.commands.batch.records import settings_of
from pnpdepth_cli.commands.batch.request import BatchRequest
from pnpdepth_cli.commands.refinement.inputs import read_inputs
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.layouts import find_layout, list_frames

FORWARD_TO_CAMERA = [0.5, -0.5, 0.5, -0.5]
"""w x y z of a camera that looks along the car's x axis."""


def pose(token: str, translation: list[float], rotation: list[float], **more: Any) -> Any:
    return {"token": token, "translation": translation, "rotation": rotation, **more}


def write(root: Path, *, moved: float = 0.5) -> None:
    """One sample: the car drives `moved` metres from the scan to the image."""
    ahead = [1.0, 0, 0, 0]
    intrinsic = [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]
    shared = {"sample_token": "s", "is_key_frame": True, "height": 48, "width": 64}
    image, scan = "samples/CAM_FRONT/a.jpg", "samples/LIDAR_TOP/a.pcd.bin"
    tables = {
        "scene": [{"token": "scene", "name": "scene-0001"}],
        "sample": [{"token": "s", "scene_token": "scene"}],
        "sensor": [
            {"token": "cam", "channel": "CAM_FRONT"},
            {"token": "lid", "channel": "LIDAR_TOP"},
        ],
        "calibrated_sensor": [
            pose("c", [1.5, 0, 1.5], FORWARD_TO_CAMERA, sensor_token="cam",
                 camera_intrinsic=intrinsic),
            pose("l", [1.0, 0, 1.8], ahead, sensor_token="lid", camera_intrinsic=[]),
        ],
        "ego_pose": [
            pose("at image", [1000 + moved, 2000, 0], ahead),
            pose("at scan", [1000, 2000, 0], ahead),
        ],
        "sample_data": [
            {"token": "1", "filename": image, "calibrated_sensor_token": "c",
             "ego_pose_token": "at image", **shared},
            {"token": "2", "filename": scan, "calibrated_sensor_token": "l",
             "ego_pose_token": "at scan", **shared},
            {"token": "3", "filename": "sweeps/x.jpg", "calibrated_sensor_token": "c",
             "ego_pose_token": "at image", **shared, "is_key_frame": False},
        ],
    }  # fmt: skip
    (root / "v1.0-mini").mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    for path in (image, scan):
        (root / path).parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(root / image), np.zeros((48, 64, 3), np.uint8))
    points = [[10.5, 0.0, -0.3, 7, 1], [10.5, 2.0, -0.3, 7, 2]]
    np.array(points, "<f4").tofile(root / scan)


def request_of(root: Path) -> BatchRequest:
    return BatchRequest(source=root, output=root / "out", refine=RefineRequest())


def test_a_scan_is_moved_to_the_time_of_the_image(tmp_path: Path) -> None:
    write(tmp_path)
    assert find_layout(tmp_path) == "nuscenes"
    (frame,) = list_frames(tmp_path)[1].frames
    assert (frame.name, frame.group) == ("scene-0001/a", "scene-0001/CAM_FRONT")
    inputs = read_inputs(task_of(request_of(tmp_path), frame).request)
    # 10.5 m ahead of the LiDAR is 10 m ahead of the camera, and 9.5 m once the car has moved
    np.testing.assert_allclose(inputs.points.depth, 9.5, rtol=1e-6)
    expected = [[31.5, 23.5], [31.5 - 60 * 2 / 9.5, 23.5]]
    np.testing.assert_allclose(inputs.points.xy, expected, atol=1e-4)


def test_a_changed_pose_of_the_car_is_another_setting(tmp_path: Path) -> None:
    digests = set()
    for moved in (0.5, 0.6, 0.5):
        write(tmp_path, moved=moved)
        (frame,) = list_frames(tmp_path)[1].frames
        digests.add(repr(settings_of(task_of(request_of(tmp_path), frame).request, {})))
    assert len(digests) == 2


def test_a_missing_scan_and_incomplete_tables_are_reported(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "samples/LIDAR_TOP/a.pcd.bin").unlink()
    listing = list_frames(tmp_path)[1]
    assert "or its LiDAR scan does not exist" in str(listing.broken[0])
    (tmp_path / "v1.0-mini/ego_pose.json").write_text("[]")
    write(tmp_path)
    (tmp_path / "v1.0-mini/ego_pose.json").write_text("[]")
    with pytest.raises(FileFormatError, match=r"incomplete or of another kind \(KeyError"):
        list_frames(tmp_path)
