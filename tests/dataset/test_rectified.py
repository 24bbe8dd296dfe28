"""Bags of rectified images: projected by P without distortion, by the topic or by the edges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

pytest.importorskip("rosbags")

from pnpdepth_cli.commands.sparse.make import SparseTarget, project_scan
from pnpdepth_cli.dataset.read_options import ScanOptions
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.scans import read_scan
from tests.bags import View, write_bag
from tests.commands.sparse.test_bags import written

SIZE = (240, 320)
K = np.array([[290.0, 0, 170], [0, 290, 112], [0, 0, 1]])
D = np.array([-0.3, 0.09, 0.0, 0.0, 0.0])
RECTIFIED = np.array([[240.0, 0, 160], [0, 240, 120], [0, 0, 1]])
ABOVE = np.array([0, -0.2, 0])  # of the LiDAR, in the camera's frame


def depth_along(rays: NDArray[np.float64], start: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth z at which rays (N, 3), z = 1, meet boards 6 m ahead or the wall at 15 m."""
    at = start + rays * 6
    on_board = (np.floor(at[:, 0] / 0.8) % 2 == 0) & (np.floor(at[:, 1] / 1.1) % 2 == 0)
    return np.where(on_board, 6.0, 15.0)


def photo(rays: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Boards and wall of different brightness, with a little noise, seen along rays (H·W, 3)."""
    grey = np.where(depth_along(rays, np.zeros(3)) < 10, 190.0, 70.0).reshape(SIZE)
    noisy = grey + np.random.default_rng(0).normal(0, 4, SIZE)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def view(*, rectified: bool, topic: str, turn: NDArray[np.float64] | None = None) -> View:
    """A camera whose rectified image is rotated by `turn`; the scan is of 40 lines."""
    turn = np.eye(3) if turn is None else turn
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    xy = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    if rectified:
        rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(RECTIFIED).T @ turn
        rays /= rays[:, 2:]
    else:
        plane = cv2.undistortPoints(xy[:, None], K, D)[:, 0]
        rays = np.column_stack([plane, np.ones(len(plane))])
    elevation, azimuth = np.meshgrid(np.linspace(-24, 24, 40), np.arange(-40, 40, 0.25))
    scan = np.tan(np.radians([azimuth.ravel(), elevation.ravel()])).T
    beams = np.column_stack([scan, np.ones(len(scan))])
    seen = beams * depth_along(beams, ABOVE)[:, None]
    return View(
        pixels=photo(rays),
        points=seen[:, [2, 0, 1]] * [1, -1, -1],
        k=K,
        d=D,
        r=turn,
        p=np.column_stack([RECTIFIED, np.zeros(3)]),
        topic=topic,
    )


def pixel_error(folder: Path, intrinsics: NDArray[np.float64]) -> float:
    """Mean distance in pixels of the projected points from where a pinhole camera has them."""
    scan = next((folder / "sparse").iterdir())
    options = ScanOptions(calib=folder / "calib.txt", keep_occluded=True)
    points = read_scan_points(scan, options, SIZE).points
    xyz = read_scan(scan).points @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    at = (xyz + ABOVE) @ intrinsics.T
    expected = cKDTree(at[:, :2] / at[:, 2:])
    assert len(points.depth) > 1000
    return float(expected.query(points.xy)[0].mean())


@pytest.mark.parametrize(
    ("rectified", "topic", "said"),
    [
        (True, "/front/image_rect_color", "rectified images, by P (the topic /front/image_rect_"),
        (True, "/front/image_raw", "rectified images, by P (image edges at jumps of depth: K and"),
        (False, "/front/image_raw", "raw images, by K and distortion (image edges at jumps of"),
    ],
)
def test_images_of_a_bag_are_rectified_by_their_topic_or_else_by_their_edges(
    rectified: bool, topic: str, said: str, tmp_path: Path
) -> None:
    bag = write_bag(tmp_path / "a.mcap", view=view(rectified=rectified, topic=topic))
    (camera,) = (m for m in written(bag, tmp_path / "frames") if m.startswith("camera:"))
    assert said in camera
    calibration = read_calibration(tmp_path / "frames" / "calib.txt")
    np.testing.assert_array_equal(calibration.camera.intrinsics, RECTIFIED if rectified else K)
    assert calibration.camera.distortion == (() if rectified else tuple(D))
    if rectified:
        assert pixel_error(tmp_path / "frames", RECTIFIED) < 1e-3


@pytest.mark.parametrize("to_rectified", [True, False])
def test_the_edges_say_whether_the_transforms_lead_to_the_rectified_camera(
    to_rectified: bool, tmp_path: Path
) -> None:
    turn = Rotation.from_euler("xyz", [3, 4, 0], degrees=True).as_matrix()
    seen = view(rectified=True, topic="/front/image_rect", turn=None if to_rectified else turn)
    written(write_bag(tmp_path / "a.mcap", view=replace(seen, r=turn)), tmp_path / "frames")
    calibration = read_calibration(tmp_path / "frames" / "calib.txt")
    to_camera = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    expected = to_camera if to_rectified else turn @ to_camera
    np.testing.assert_allclose(calibration.scanner.rotation, expected, atol=1e-9)


@pytest.mark.parametrize("rectified", [True, False])
def test_a_camera_info_file_is_used_for_the_image_that_is_projected_onto(
    rectified: bool, tmp_path: Path
) -> None:
    seen = view(rectified=rectified, topic="/front/image_raw")
    written(write_bag(tmp_path / "a.mcap", view=seen), tmp_path / "frames")
    (scan, *_), (image, *_) = (
        sorted((tmp_path / "frames" / n).iterdir()) for n in ("sparse", "rgb")
    )
    pose = np.column_stack([[[0, -1, 0], [0, 0, -1], [1, 0, 0]], ABOVE])
    info = {"distortion_model": "plumb_bob", "d": D.tolist(), "k": K.ravel().tolist()}
    info |= {"p": seen.p.ravel().tolist(), "r": [0.0] * 9, "T_camera_lidar": pose.ravel().tolist()}
    calib = tmp_path / "camera_info.yaml"
    calib.write_text("".join(f"{name}: {value}\n" for name, value in info.items()))
    options, target = ScanOptions(calib=calib), SparseTarget(output=tmp_path / "s.csv")
    record = project_scan(scan, options, target, image)
    (note,) = (note for note in record["notes"] if note.startswith("camera:"))
    assert note.startswith(
        f"camera: {'rectified images, by P' if rectified else 'raw images, by K'}"
    )
    camera = read_scan_points(scan, options, SIZE, image).camera
    np.testing.assert_array_equal(camera.intrinsics, RECTIFIED if rectified else K)
    assert camera.has_lens is not rectified
    blind = read_scan_points(scan, options, SIZE)  # without the image, raw is said to be assumed
    np.testing.assert_array_equal(blind.camera.intrinsics, K)
    assert any(note.startswith("camera: raw images, by K") for note in blind.notes)


def test_points_ahead_that_fall_outside_the_image_give_a_warning(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "a.mcap", view=view(rectified=True, topic="/front/image_rect"))
    written(bag, tmp_path / "frames")
    scan, calib = next((tmp_path / "frames/sparse").iterdir()), tmp_path / "frames" / "calib.txt"
    options = ScanOptions(calib=calib)
    assert not any("warning" in note for note in read_scan_points(scan, options, SIZE).notes)
    calib.write_text(calib.read_text().replace("240.0", "900.0"))
    notes = read_scan_points(scan, options, SIZE).notes
    assert any("within 15° of the camera's axis fall outside the image" in note for note in notes)
