"""Synthetic scenes of DDAD, laid out as the TRI Dataset Governance Policy says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.commands.batch.frames import find_frames, task_of
from pnpdepth_cli.commands.batch.request import BatchRequest, SequenceOptions
from pnpdepth_cli.commands.refinement.inputs import read_inputs
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.layouts import find_layout, list_frames

FORWARD = {"qw": 0.5, "qx": -0.5, "qy": 0.5, "qz": -0.5}
"""Of a camera that looks along the world's x axis."""
PINHOLE = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "skew": 0.0}


def pose(x: float, z: float, rotation: dict[str, float]) -> Any:
    return {"translation": {"x": x, "y": 0.0, "z": z}, "rotation": rotation}


def write_scene(folder: Path, *, samples: int = 2, intrinsics: dict[str, float] = PINHOLE) -> None:
    """The car drives 0.5 m from sample to sample, and 0.1 m from the scan to the image."""
    data, rows = [], []
    for name in ("rgb/CAMERA_01", "point_cloud/LIDAR", "calibration"):
        (folder / name).mkdir(parents=True)
    for number in range(samples):
        scan, image = f"point_cloud/LIDAR/{number}.npz", f"rgb/CAMERA_01/{number}.png"
        x = 0.5 * number
        lidar = {"filename": scan, "pose": pose(x, 0.0, {"qw": 1.0})}
        camera = {"filename": image, "pose": pose(x + 0.1, 1.0, FORWARD), "height": 48, "width": 64}
        data += [
            {"key": f"l{number}", "id": {"name": "LIDAR"}, "datum": {"point_cloud": lidar}},
            {"key": f"c{number}", "id": {"name": "CAMERA_01"}, "datum": {"image": camera}},
        ]
        rows.append({"calibration_key": "k", "datum_keys": [f"l{number}", f"c{number}"]})
        cv2.imwrite(str(folder / image), np.zeros((48, 64, 3), np.uint8))
        points = np.array([[10.1 - x, 0, 1, 7], [10.1 - x, 2, 1, 7]], np.float32)
        np.savez_compressed(folder / scan, data=points)
    calibration = {"names": ["LIDAR", "CAMERA_01"], "intrinsics": [{"fx": 0.0}, intrinsics]}
    (folder / "calibration/k.json").write_text(json.dumps(calibration))
    (folder / "scene_0a.json").write_text(json.dumps({"data": data, "samples": rows}))


def request_of(root: Path, **more: Any) -> BatchRequest:
    return BatchRequest(source=root, output=root / "out", refine=RefineRequest(), **more)


def test_each_camera_of_each_sample_is_a_frame_of_one_sequence(tmp_path: Path) -> None:
    write_scene(tmp_path / "000001", samples=1)
    write_scene(tmp_path / "000000")
    layout, listing = list_frames(tmp_path)
    assert layout == "ddad"
    assert [(frame.name, frame.group) for frame in listing.frames] == [
        ("000000/CAMERA_01_0", "000000/CAMERA_01"),
        ("000000/CAMERA_01_1", "000000/CAMERA_01"),
        ("000001/CAMERA_01_0", "000001/CAMERA_01"),
    ]
    assert find_layout(tmp_path / "000000") == "ddad"


def test_the_scan_is_seen_from_the_camera_at_the_images_time(tmp_path: Path) -> None:
    write_scene(tmp_path / "000000")
    frame = list_frames(tmp_path)[1].frames[0]
    points = read_inputs(task_of(request_of(tmp_path), frame).request).points
    # 10 m ahead on the axis, and 2 m to the left of it
    np.testing.assert_allclose(points.depth, [10, 10], atol=1e-5)
    np.testing.assert_allclose(points.xy, [[31.5, 23.5], [19.5, 23.5]], atol=1e-4)


def test_the_poses_of_the_cameras_serve_accumulation(tmp_path: Path) -> None:
    write_scene(tmp_path / "000000")
    sequence = SequenceOptions(accumulate=1)
    first = find_frames(request_of(tmp_path, sequence=sequence)).frames[0]
    (neighbour,) = first.neighbours
    assert neighbour.poses == "the layout's"
    np.testing.assert_allclose(np.array(neighbour.motion)[:, 3], [0, 0, 0.5], atol=1e-9)


def test_a_sample_without_its_scan_is_left_out(tmp_path: Path) -> None:
    write_scene(tmp_path / "000000")
    (tmp_path / "000000/point_cloud/LIDAR/1.npz").unlink()
    _, listing = list_frames(tmp_path)
    assert len(listing.frames) == 1
    assert listing.broken[0].path == tmp_path / "000000/rgb/CAMERA_01/1.png"


@pytest.mark.parametrize("intrinsics", [PINHOLE | {"k1": 0.1}, {"fx": 60.0}, PINHOLE | {"fx": 0}])
def test_a_camera_that_is_no_pinhole_is_refused(
    intrinsics: dict[str, float], tmp_path: Path
) -> None:
    write_scene(tmp_path / "000000", intrinsics=intrinsics)
    with pytest.raises(FileFormatError, match="is incomplete or of another kind"):
        list_frames(tmp_path)


@pytest.mark.parametrize("text", ["[]", "{}", "{", '{"data": [1], "samples": []}'])
def test_a_damaged_scene_is_refused_in_one_line(text: str, tmp_path: Path) -> None:
    write_scene(tmp_path / "000000")
    (tmp_path / "000000/scene_0a.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"scene_0a\.json"):
        list_frames(tmp_path)
