"""How a scan and its image belong together: what is right is not told, what is wrong is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import Extrinsics
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.dataset.scan_fit import fit_warning
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan

STREET = Path(__file__).parents[2] / "samples" / "street"
Image = NDArray[np.float32]
Scan = NDArray[np.floating]
Frame = tuple[Image, Scan, Calibration]


def frame_of(image: Path, scan: Path, calib: Path) -> Frame:
    return read_rgb(image).values, read_scan(scan)[0], read_calibration(calib)


@pytest.fixture(scope="module")
def street() -> Frame:
    return frame_of(STREET / "rgb.png", STREET / "000000.bin", STREET / "calib.txt")


def told(rgb: Image, scan: Scan, calibration: Calibration) -> list[str]:
    return fit_warning(scan, calibration, {}, rgb)


def moved(
    calibration: Calibration, turn_deg: tuple[float, ...] = (0, 0, 0), ahead_m: float = 0
) -> Calibration:
    """The calibration whose points are turned about the camera's axes, and ahead by so much."""
    assert calibration.scanner is not None
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    pose = Extrinsics(turn, np.array([0, 0, ahead_m])) @ calibration.scanner
    return replace(calibration, scanner=pose)


@pytest.mark.parametrize("angle_deg", [-7.0, -3.5, -2.5, -1.5, 1.5, 2.0, 3.0, 5.0])
def test_small_turns_are_found(angle_deg: float, street: Frame) -> None:
    rgb, scan, right = street
    for axis, name in enumerate(("x and", "y", "its axis")):
        turn = [0.0, 0.0, 0.0]
        turn[axis] = angle_deg
        (warning,) = told(rgb, scan, moved(right, tuple(turn)))
        assert name in warning or axis < 2


@pytest.mark.parametrize("ahead_m", [-2.0, -1.5, -1.0, 1.0, 1.5, 2.0])
def test_a_scan_of_another_time_is_found(ahead_m: float, street: Frame) -> None:
    rgb, scan, right = street
    (warning,) = told(rgb, scan, moved(right, ahead_m=ahead_m))
    assert ("back" if ahead_m > 0 else "ahead") in warning


@pytest.mark.parametrize(
    ("matrix", "text"),
    [
        (np.diag([1.0, -1, 1]), "y of the scan negated"),
        (np.diag([1.0, 1, -1]), "z of the scan negated"),
    ],
)
def test_other_axes_are_found(matrix: NDArray[np.float64], text: str, street: Frame) -> None:
    rgb, scan, right = street
    (warning,) = told(rgb, scan @ matrix, right)
    assert text in warning


def test_inverted_extrinsics_are_found(street: Frame) -> None:
    rgb, scan, right = street
    assert right.scanner is not None
    turn = Rotation.from_euler("y", 10, degrees=True).as_matrix()  # of a scanner in camera axes
    pose = Extrinsics(turn, right.scanner.translation)
    of_camera_axes = pose.inverse().apply(right.scanner.apply(scan))
    assert told(rgb, of_camera_axes, replace(right, scanner=pose)) == []
    (warning,) = told(rgb, of_camera_axes, replace(right, scanner=pose.inverse()))
    assert "inverted" in warning


@pytest.mark.parametrize("turns", [1, 2, 3])
@pytest.mark.parametrize("is_mirrored", [False, True])
def test_a_square_image_that_is_turned_is_found(
    turns: int, is_mirrored: bool, street: Frame
) -> None:
    rgb, scan, right = street
    left = 430
    intrinsics = right.camera.intrinsics.copy()
    intrinsics[0, 2] -= left
    camera = replace(right.camera, intrinsics=intrinsics, size=(375, 375))
    square = rgb[:, left : left + 375]
    turned = np.rot90(square[:, ::-1] if is_mirrored else square, turns)
    (warning,) = told(np.ascontiguousarray(turned), scan, replace(right, camera=camera))
    assert "with the image" in warning


@pytest.mark.parametrize(
    ("rows", "columns", "text"),
    [(1, -1, "mirrored"), (-1, 1, "rows in reverse"), (-1, -1, "turned by 180°")],
)
def test_a_mirrored_or_turned_image_is_found(
    rows: int, columns: int, text: str, street: Frame
) -> None:
    rgb, scan, right = street
    (warning,) = told(np.ascontiguousarray(rgb[::rows, ::columns]), scan, right)
    assert text in warning


@pytest.mark.parametrize("axis", [0, 1])
def test_axes_that_put_no_point_into_the_image_are_named(
    axis: int, street: Frame, tmp_path: Path
) -> None:
    _, scan, _ = street
    other = scan * (-1, 1, 1) if axis == 0 else -scan[:, [0, 1, 2]] * (1, 1, -1)
    np.save(tmp_path / "scan.npy", other)
    options = ScanOptions(calib=STREET / "calib.txt")
    with pytest.raises(NoPointsError, match="points would be in the image"):
        read_scan_points(tmp_path / "scan.npy", options, (375, 1242))


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.4])
def test_intrinsics_of_an_image_of_another_size_are_found(factor: float, street: Frame) -> None:
    rgb, scan, right = street
    size = round(1242 * factor), round(375 * factor)
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).clip(0, 1)
    wrong = replace(right, camera=replace(right.camera, size=None))
    (warning,) = told(small, scan, wrong)
    assert "intrinsics × " in warning


def variants(rgb: Image, scan: Scan, right: Calibration) -> Iterator[tuple[str, Frame]]:
    """Inputs that are right: resized, cropped, thinned, darkened, noisy."""
    rng = np.random.default_rng(0)
    (height, width) = rgb.shape[:2]
    camera = replace(right.camera, size=(height, width))
    for factor in (0.5, 0.7, 1.3):
        size = round(width * factor), round(height * factor)
        resized = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).clip(0, 1)
        of_size = replace(right, camera=camera.resized(size[1], size[0]))
        yield f"resized {factor}", (resized, scan, of_size)
    for top, left, rows, columns in (
        (23, 13, 352, 1216),
        (120, 165, 250, 900),
        (60, 300, 300, 640),
    ):
        intrinsics = camera.intrinsics.copy()
        intrinsics[:2, 2] -= (left, top)
        part = rgb[top : top + rows, left : left + columns]
        cut = replace(camera, intrinsics=intrinsics, size=(part.shape[0], part.shape[1]))
        yield f"cut {top}", (np.ascontiguousarray(part), scan, replace(right, camera=cut))
    elevation = np.degrees(np.arctan2(scan[:, 2], np.hypot(scan[:, 0], scan[:, 1])))
    for every in (2, 4):
        yield f"lines / {every}", (rgb, scan[np.floor(elevation / 0.42) % every == 0], right)
    for share in (0.5, 0.2):
        yield f"points × {share}", (rgb, scan[rng.uniform(size=len(scan)) < share], right)
    noise = rng.normal(0, 0.03, scan.shape).astype(np.float32)
    yield "noise of 3 cm", (rgb, scan + noise, right)
    yield "within 40 m", (rgb, scan[np.linalg.norm(scan, axis=1) < 40], right)
    grain = rng.normal(0, 0.05, rgb.shape).astype(np.float32)
    for name, changed in (
        ("dark", 0.3 * rgb),
        ("contrast", rgb**2),
        ("blur", cv2.GaussianBlur(rgb, (0, 0), 2)),
        ("grain", (rgb + grain).clip(0, 1)),
        ("grey", np.repeat(rgb.mean(axis=2, keepdims=True), 3, axis=2)),
    ):
        yield name, (changed, scan, right)
    assert right.scanner is not None
    exact = Extrinsics(
        Rotation.from_euler("xyz", rng.normal(0, 0.1, 3), degrees=True).as_matrix(),
        rng.normal(0, 0.02, 3),
    )
    yield "as exact as calibrations are", (rgb, scan, replace(right, scanner=exact @ right.scanner))


def test_nothing_is_told_of_what_is_right(street: Frame) -> None:
    assert told(*street) == []
    for name, frame in variants(*street):
        assert told(*frame) == [], name


@pytest.mark.slow
def test_nothing_is_told_of_real_frames_that_are_right(shared_data: Path) -> None:
    folder = shared_data / "kitti_object"
    for calib in sorted((folder / "calib").glob("*.txt")):
        image, scan = (folder / file for file in (f"image_2/{calib.stem}.png", "velodyne"))
        real = frame_of(image, scan / f"{calib.stem}.bin", calib)
        for name, frame in (("as it is", real), *variants(*real)):
            assert told(*frame) == [], f"{calib.stem} {name}"
