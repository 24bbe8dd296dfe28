"""The camera and the pose of a scan: of files, of bags of rectified images, and wrong ones."""

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

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.dataset.read_options import ScanOptions
from pnpdepth_cli.dataset.scan_points import check_direction, read_scan_points
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.scans import read_scan
from tests.bags import View, write_bag
from tests.commands.scan_frames import CALIBRATION, HEIGHT, WIDTH, scan_on_disk
from tests.commands.test_bag_frames import written

SIZE = (240, 320)
K = np.array([[290.0, 0, 170], [0, 290, 112], [0, 0, 1]])
D = np.array([-0.3, 0.09, 0.0, 0.0, 0.0])
RECTIFIED = np.array([[240.0, 0, 160], [0, 240, 120], [0, 0, 1]])
ABOVE = np.array([0, -0.2, 0])  # of the LiDAR, in the camera's frame
TURN = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # from the LiDAR's axes to the camera's


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
    xyz = read_scan(scan)[0] @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
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
    scanner = read_calibration(tmp_path / "frames" / "calib.txt").scanner
    expected = TURN if to_rectified else turn @ TURN
    np.testing.assert_allclose(scanner.rotation, expected, atol=1e-9)


@pytest.mark.parametrize("rectified", [True, False])
def test_a_camera_info_file_is_used_for_the_image_that_is_projected_onto(
    rectified: bool, tmp_path: Path
) -> None:
    seen = view(rectified=rectified, topic="/front/image_raw")
    written(write_bag(tmp_path / "a.mcap", view=seen), tmp_path / "frames")
    scan, image = (min((tmp_path / "frames" / n).iterdir()) for n in ("sparse", "rgb"))
    pose = np.column_stack([TURN, ABOVE])
    info = {"distortion_model": "plumb_bob", "d": D.tolist(), "k": K.ravel().tolist()}
    info |= {"p": seen.p.ravel().tolist(), "r": [0.0] * 9, "T_camera_lidar": pose.ravel().tolist()}
    calib = tmp_path / "camera_info.yaml"
    calib.write_text("".join(f"{name}: {value}\n" for name, value in info.items()))
    options = ScanOptions(calib=calib)
    camera = read_scan_points(scan, options, SIZE, image).camera
    assert camera is not None
    np.testing.assert_array_equal(camera.intrinsics, RECTIFIED if rectified else K)
    assert camera.has_lens is not rectified
    blind = read_scan_points(scan, options, SIZE)  # without the image, raw is said to be assumed
    assert any(note.startswith("camera: raw images, by K") for note in blind.notes)
    if rectified:  # points ahead that fall outside the image
        of_bag = tmp_path / "frames" / "calib.txt"
        of_bag.write_text(of_bag.read_text().replace("240.0", "900.0"))
        notes = read_scan_points(scan, ScanOptions(calib=of_bag), SIZE).notes
        assert any("within 15°" in note for note in notes)


QUARTER = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # the camera looks along the scan's x
CYCLE = np.roll(np.eye(3), 1, axis=1)  # so, too; the inverse looks along y, x is down


@pytest.mark.parametrize(
    ("turn", "inside", "inverted", "notes"),
    [
        (QUARTER, 100, 299, 0),
        (QUARTER, 100, 300, 1),  # three times as many
        (QUARTER, 15, 300, 1),
        (QUARTER, 14, 300, None),  # less than a twentieth
        (QUARTER, 0, 2, 0),
        (CYCLE, 100, 201, 1),  # the scan is thin along x, which is the inverse's y
        (CYCLE, 100, 199, 0),
    ],
)
def test_the_direction_is_judged_by_the_points_in_the_image_and_what_is_upright(
    turn: NDArray[np.float64], inside: int, inverted: int, notes: int | None
) -> None:
    ahead, ahead_inverted = turn[2], turn.T[2]
    beside = np.repeat(
        [[0, 0, 1], [0, 0, -1]] if turn is CYCLE else [[0, 1, 0], [0, -1, 0]], 500, 0
    )
    along = np.repeat([ahead, ahead_inverted], [inside, inverted], axis=0)
    scan = 5 * np.concatenate([along, beside])
    camera, pose = Camera(intrinsics=K), Extrinsics(turn, np.zeros(3))
    if notes is None:
        with pytest.raises(UsageError):
            check_direction(scan, camera, pose, SIZE)
    else:
        assert len(check_direction(scan, camera, pose, SIZE)) == notes


def test_extrinsics_complete_a_calibration_and_their_wrong_direction_is_recognised(
    tmp_path: Path,
) -> None:
    scene, shift = scan_on_disk(tmp_path), np.array([0.1, -0.05, -0.2])
    scene.calib.write_text(CALIBRATION.splitlines()[0])
    np.savetxt(tmp_path / "pose.txt", np.column_stack([TURN, shift]))
    np.savetxt(tmp_path / "inverse.txt", np.column_stack([TURN.T, -TURN.T @ shift]))
    alone = ScanOptions(calib=scene.calib)
    with pytest.raises(UsageError, match="--extrinsics"):
        read_scan_points(scene.scan, alone, (HEIGHT, WIDTH))
    wrong, right = (replace(alone, extrinsics=tmp_path / f"{n}.txt") for n in ("inverse", "pose"))
    with pytest.raises(UsageError, match="put 0 of 150 scan"):
        read_scan_points(scene.scan, wrong, (HEIGHT, WIDTH))
    read = read_scan_points(scene.scan, right, (HEIGHT, WIDTH))
    assert cKDTree(scene.xy).query(read.points.xy)[0].max() < 2e-3
    assert not [note for note in read.notes if "extrinsics" in note]


def test_the_wrong_direction_of_a_real_scan_is_recognised(shared_data: Path) -> None:
    folder = shared_data / "kitti_object"
    for path in sorted((folder / "calib").glob("*.txt")):
        scan = read_scan(folder / "velodyne" / f"{path.stem}.bin")[0]
        calibration = read_calibration(path)
        camera, right = calibration.camera, calibration.scanner
        assert right is not None
        portrait = Camera(intrinsics=np.array([[700.0, 0, 180], [0, 700, 600], [0, 0, 1]]))
        assert check_direction(scan, camera, right, (375, 1242)) == []
        assert check_direction(scan, portrait, right, (1242, 375)) == []
        (warning,) = check_direction(scan, camera, right.inverse(), (375, 1242))
        assert "if they map the camera to the scanner, give their inverse" in warning
