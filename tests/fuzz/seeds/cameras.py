"""Calibrations and extrinsics."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tests.fuzz.seeds.seed import HEIGHT, IMAGE, OUT, WIDTH, Seed
from tests.io.test_calibration import POSES

_ROS = f"""image_width: {WIDTH}
image_height: {HEIGHT}
camera_matrix: {{rows: 3, cols: 3, data: [30, 0, 16, 0, 30, 12, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [-0.1, 0.02, 0.001, -0.002, 0.0]}}
"""
_KALIBR = f"""cam0:
  T_cam_lidar: [[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.01, -0.003, 0.001]
  distortion_model: equidistant
  intrinsics: [30, 30, 16, 12]
  resolution: [{WIDTH}, {HEIGHT}]
"""
_FISHEYE = "distortion: [-0.02, 0.01, -0.003, 0.001]\nlens: fisheye\n"


def write_seeds(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    """Returns calibrations of every tool, and poses of a scanner in every form."""
    return [*_calibrations(folder), *_extrinsics(folder)]


def _project(*options: str) -> tuple[str, ...]:
    return ("project", "good.bin", *options, *IMAGE, *OUT)


def _calibrations(folder: Path) -> list[Seed]:
    p2 = f"30 0 {WIDTH / 2} 0 0 30 {HEIGHT / 2} 0 0 0 1 0"
    (folder / "kitti.txt").write_text(
        "".join(f"P{n}: {p2}\n" for n in range(4))
        + "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    )
    own = (folder / "calib.txt").read_text()
    (folder / "own.txt").write_text(own)
    (folder / "fisheye.txt").write_text(own + _FISHEYE)
    (folder / "ros.yaml").write_text(_ROS)
    (folder / "kalibr.yaml").write_text(_KALIBR)
    _write_opencv(folder / "opencv.yml")
    (folder / "pose.txt").write_text(POSES["quaternion"])
    return [
        *(
            Seed(file=name, command=_project("--calib", name))
            for name in ("kitti.txt", "own.txt", "fisheye.txt", "kalibr.yaml")
        ),
        *(
            Seed(file=name, command=_project("--calib", name, "--extrinsics", "pose.txt"))
            for name in ("ros.yaml", "opencv.yml")
        ),
    ]


def _write_opencv(path: Path) -> None:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", WIDTH)
    file.write("image_height", HEIGHT)
    file.write("camera_matrix", np.array([[30, 0, 16], [0, 30, 12], [0, 0, 1.0]]))
    file.write("distortion_coefficients", np.array([[-0.1], [0.02], [0.001], [-0.002], [0.0]]))
    file.release()


def _extrinsics(folder: Path) -> list[Seed]:
    seeds = []
    for number, text in enumerate(POSES.values()):
        name = f"pose{number}.yaml"
        (folder / name).write_text(text)
        options = _project("--calib", "ros.yaml", "--extrinsics", name)
        seeds.append(Seed(file=name, command=options))
    return seeds
