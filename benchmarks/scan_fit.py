"""What is told of scans and images: `python -m benchmarks.scan_fit --data PATH`.

Frames with scans are made wrong in known ways: turned, rolled, of another time, beside an image of
another size, mirrored. `noticed` is the fraction that a warning is given for, `named` the fraction
whose warning is of the right kind. Then come inputs that are right: resized and cropped with their
calibration, fewer lines and points, noise, blur, darkness, JPEG, calibrations as inexact as real
ones. None of them should be told anything. `seconds` is processor time a frame; run it with
OMP_NUM_THREADS=1.

Constants were chosen on the frames of `--part choose`, which are of KITTI object and depth
completion. Those of `--part report` are for reporting: KITTI raw drive 0023 and the samples.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import Extrinsics
from pnpdepth_cli.dataset.scan_fit import fit_warning
from pnpdepth_cli.io.calibration import Calibration, read_calibration
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.sensors.lens import unproject

SAMPLES = Path(__file__).parents[1] / "samples"


class ScanFrame(NamedTuple):
    """An image with a scan."""

    rgb: NDArray[np.float32]  # (H, W, 3)
    scan: NDArray[np.floating]  # (N, 3) of the scanner
    calibration: Calibration


class Variant(NamedTuple):
    """One way to change a frame."""

    kind: str
    word: str  # in a warning that is right
    change: Callable[[ScanFrame], ScanFrame]


def frames_of(data: Path, part: str) -> Iterator[ScanFrame]:
    """Yields the frames to choose constants on, or those to report on."""
    kitti = data / "kitti_object"
    calibs = sorted((kitti / "calib").glob("*.txt"))
    # KITTI's projected scans are put back where the scanner is.
    pose = read_calibration(calibs[1]).scanner
    assert pose is not None
    if part == "choose":
        for calib in calibs:
            rgb = read_rgb(kitti / "image_2" / f"{calib.stem}.png").values
            scan, _ = read_scan(kitti / "velodyne" / f"{calib.stem}.bin")
            yield ScanFrame(rgb, scan, read_calibration(calib))
        camera = read_calibration(data / "kitti_dc" / "calib_cam_to_cam.txt", 2)
        for path in sorted((data / "kitti_dc" / "image").glob("*.jpg")):
            depth = read_depth(data / "kitti_dc" / "velodyne_raw" / f"{path.stem}.png", scale=256)
            yield _frame_of_map(path, depth.values, replace(camera, scanner=pose))
        return
    day = data / "kitti_raw" / "2011_09_26"
    drive = day / "2011_09_26_drive_0023_sync"
    camera = read_calibration(day / "calib_cam_to_cam.txt", 2)
    maps = drive / "proj_depth" / "velodyne" / "image_02"
    for path in sorted((drive / "image_02" / "data").glob("*.png")):
        depth_map = np.load(maps / f"{path.stem}.npz")["velodyne_depth"]
        yield _frame_of_map(path, depth_map, replace(camera, scanner=pose))
    street = SAMPLES / "street"
    scan, _ = read_scan(street / "000000.bin")
    calibration = read_calibration(street / "calib.txt")
    yield ScanFrame(read_rgb(street / "rgb.png").values, scan, calibration)
    for path in sorted((SAMPLES / "drive" / "rgb").glob("*.jpg")):
        of_drive = read_calibration(SAMPLES / "drive" / "calib" / f"{path.stem}.txt")
        depth = read_depth(SAMPLES / "drive" / "sparse" / f"{path.stem}.png", scale=256)
        of_drive = replace(of_drive, scanner=calibration.scanner)
        yield _frame_of_map(path, depth.values, of_drive)


def _frame_of_map(image: Path, depth: NDArray[np.float32], calibration: Calibration) -> ScanFrame:
    """Returns a frame whose scan was stored as a depth map (H, W) of its camera, in metres."""
    assert calibration.scanner is not None
    rows, columns = np.nonzero(depth)
    xy = np.column_stack([columns, rows]).astype(np.float64)
    seen = unproject(calibration.camera, xy, depth[rows, columns])
    scan = calibration.scanner.inverse().apply(seen)
    return ScanFrame(read_rgb(image).values, scan.astype(np.float32), calibration)


def _moved(frame: ScanFrame, turn_deg: tuple[float, ...], shift: tuple[float, ...]) -> ScanFrame:
    """Returns the frame, its scanner turned about the camera's x, y, z and moved by metres."""
    assert frame.calibration.scanner is not None
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    pose = Extrinsics(turn, np.array(shift)) @ frame.calibration.scanner
    return frame._replace(calibration=replace(frame.calibration, scanner=pose))


def _resized(frame: ScanFrame, factor: float, *, is_calibrated: bool) -> ScanFrame:
    """Returns the frame, its image resized by a factor.

    The calibration is that of the new image, or if not `is_calibrated`, wrongly of the old one.
    """
    height, width = frame.rgb.shape[:2]
    size = round(width * factor), round(height * factor)
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    rgb = cv2.resize(frame.rgb, size, interpolation=way).clip(0, 1)
    camera = replace(frame.calibration.camera, size=None)
    if is_calibrated:
        camera = replace(camera, size=(height, width)).resized(size[1], size[0])
    return ScanFrame(rgb, frame.scan, replace(frame.calibration, camera=camera))


def _cropped(frame: ScanFrame, top: float, left: float, rows: float, columns: float) -> ScanFrame:
    """Returns the frame cut to a window, with the window's calibration.

    All four numbers are fractions of the image's height or width.
    """
    height, width = frame.rgb.shape[:2]
    first_row = round(top * height)
    first_column = round(left * width)
    rgb = frame.rgb[first_row:, first_column:][: round(rows * height), : round(columns * width)]
    camera = frame.calibration.camera
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= (first_column, first_row)
    camera = replace(camera, intrinsics=intrinsics, size=(rgb.shape[0], rgb.shape[1]))
    calibration = replace(frame.calibration, camera=camera)
    return ScanFrame(np.ascontiguousarray(rgb), frame.scan, calibration)


def wrong_variants() -> Iterator[Variant]:
    """Yields ways in which scan and image do not belong together."""
    # The calibration is turned.
    for angle in (1.5, 2.5, 3.5, 5.0, 7.0, 8.0):
        for turn in (
            (0.0, angle, 0.0),
            (-angle, 0.0, 0.0),
            (0.6 * angle, -0.8 * angle, 0.0),
            (-0.5 * angle, -0.7 * angle, 0.5 * angle),
        ):
            yield Variant("turn", "turned", lambda frame, turn=turn: _moved(frame, turn, (0, 0, 0)))
        for roll in (-angle, angle):
            yield Variant(
                "roll", "turned", lambda frame, roll=roll: _moved(frame, (0, 0, roll), (0, 0, 0))
            )
    # The scan is of another time, the image of another size, one of them mirrored.
    for ahead_m in (-3.0, -2.0, -1.5, -1.0, -0.7, 0.7, 1.0, 1.5, 2.0, 3.0):
        yield Variant(
            "late", "another time", lambda frame, m=ahead_m: _moved(frame, (0, 0, 0), (0, 0, m))
        )
    for factor in (0.5, 0.75, 1.5):
        yield Variant(
            "resized image",
            "resized",
            lambda frame, f=factor: _resized(frame, f, is_calibrated=False),
        )
    for rows, columns in ((1, -1), (-1, 1), (-1, -1)):
        yield Variant(
            "mirrored image",
            "the image",
            lambda frame, r=rows, c=columns: frame._replace(
                rgb=np.ascontiguousarray(frame.rgb[::r, ::c])
            ),
        )
    for axis in (1, 2):  # x negated puts no point into the image, which is an error
        signs = np.ones(3, np.float32)
        signs[axis] = -1
        yield Variant(
            "mirrored scan",
            "of the scan",
            lambda frame, signs=signs: frame._replace(scan=frame.scan * signs),
        )


def right_variants() -> Iterator[Variant]:
    """Yields ways to change a frame that stays right."""
    rng = np.random.default_rng(0)
    # Other images with their calibration.
    yield Variant("as it is", "", lambda frame: frame)
    for factor in (0.5, 0.75, 1.3):
        yield Variant("resized", "", lambda frame, f=factor: _resized(frame, f, is_calibrated=True))
    for part in (
        (0.06, 0.01, 0.94, 0.98),
        (0.32, 0.13, 0.67, 0.72),
        (0.16, 0.24, 0.8, 0.51),
        (0.27, 0.0, 0.68, 0.48),
        (0.27, 0.51, 0.68, 0.47),
    ):
        yield Variant("cropped", "", lambda frame, part=part: _cropped(frame, *part))
    # Other scans.
    for every in (2, 4):
        yield Variant(f"lines / {every}", "", lambda frame, every=every: _of_lines(frame, every))
    for share in (0.5, 0.2):
        yield Variant(
            f"points × {share}",
            "",
            lambda frame, share=share: frame._replace(
                scan=frame.scan[rng.uniform(size=len(frame.scan)) < share]
            ),
        )
    yield Variant("within 40 m", "", _within_40_m)
    yield Variant(
        "noise of 3 cm",
        "",
        lambda frame: frame._replace(scan=frame.scan + rng.normal(0, 0.03, frame.scan.shape)),
    )
    # Other light.
    for name, change in (
        ("dark", lambda rgb: 0.3 * rgb),
        ("contrast", lambda rgb: rgb**2),
        ("blur", lambda rgb: cv2.GaussianBlur(rgb, (0, 0), 2)),
        ("grain", lambda rgb: (rgb + rng.normal(0, 0.05, rgb.shape)).clip(0, 1)),
        ("grey", lambda rgb: np.repeat(rgb.mean(axis=2, keepdims=True), 3, axis=2)),
        ("JPEG", _jpeg),
    ):
        yield Variant(
            name,
            "",
            lambda frame, change=change: frame._replace(rgb=change(frame.rgb).astype(np.float32)),
        )
    # Calibrations are not exact.
    for turn_deg, shift_m in ((0.1, 0.02), (0.1, 0.02), (0.2, 0.05)):
        yield Variant(
            f"calibration ± {turn_deg}°",
            "",
            lambda frame, t=turn_deg, s=shift_m: _moved(
                frame, tuple(rng.normal(0, t, 3)), tuple(rng.normal(0, s, 3))
            ),
        )


def _of_lines(frame: ScanFrame, every: int) -> ScanFrame:
    """The frame with every so many scan lines."""
    x, y, z = frame.scan.T
    line = np.floor(np.degrees(np.arctan2(z, np.hypot(x, y))) / 0.42)
    return frame._replace(scan=frame.scan[line % every == 0])


def _within_40_m(frame: ScanFrame) -> ScanFrame:
    return frame._replace(scan=frame.scan[np.linalg.norm(frame.scan, axis=1) < 40])


def _jpeg(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns an image (H, W, 3) in 0…1 after JPEG of quality 25."""
    codes = np.rint(rgb * 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, 25])
    return cv2.imdecode(data, cv2.IMREAD_COLOR).astype(np.float32) / 255


def main() -> None:
    """Asks for the warning of every variant of every frame, and prints what was noticed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with the sets")
    parser.add_argument("--part", choices=["choose", "report"], default="report")
    parser.add_argument(
        "--inputs", choices=["wrong", "right"], nargs="+", default=["wrong", "right"]
    )
    parser.add_argument("--every", type=int, default=1, help="of the frames, one in so many")
    arguments = parser.parse_args()
    # Each variant of each frame, and then a row for each kind.
    frames = list(frames_of(arguments.data, arguments.part))[:: arguments.every]
    seconds = list[float]()
    for title in arguments.inputs:
        variants = wrong_variants() if title == "wrong" else right_variants()
        rows = dict[str, list[tuple[bool, bool]]]()
        for variant in variants:
            for index, frame in enumerate(frames):
                rgb, scan, calibration = variant.change(frame)
                start = time.process_time()
                told = fit_warning(scan, calibration, {}, rgb)
                seconds.append(time.process_time() - start)
                is_named = bool(told) and variant.word in told[0]
                rows.setdefault(variant.kind, []).append((bool(told), is_named))
                if told and title == "right":
                    print(f"frame {index}, {variant.kind}: {told[0]}", flush=True)
        print(f"\n{title:16s} inputs  noticed  named")
        for kind, results in rows.items():
            noticed, named = np.mean(results, axis=0)
            print(f"{kind:16s} {len(results):6d} {noticed:8.3f} {named:6.3f}")
        total = [result for results in rows.values() for result in results]
        print(f"{'all':16s} {len(total):6d} {np.mean(total, axis=0)[0]:8.3f}")
        print(f"seconds: median {np.median(seconds):.2f}, largest {max(seconds):.2f}", flush=True)
        seconds.clear()


if __name__ == "__main__":
    main()
