"""Small sparse models of COLMAP, for tests of every camera model."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from pnpdepth_cli.io.colmap_model import MODELS

WIDTH, HEIGHT = 64, 48
_COEFFICIENTS = {
    "SIMPLE_RADIAL": "-0.1",
    "RADIAL": "-0.1 0.02",
    "OPENCV": "-0.1 0.02 0.001 -0.002",
    "OPENCV_FISHEYE": "-0.02 0.01 -0.003 0.001",
    "RADIAL_FISHEYE": "-0.03 0.01",
    "FULL_OPENCV": "-0.1 0.02 0.001 -0.002 0.01 0.02 -0.01 0.003",
    "SIMPLE_RADIAL_FISHEYE": "-0.03",
}
CAMERAS = {
    name: f"{'50' if focals == 1 else '50 52'} 32.5 23 {_COEFFICIENTS.get(name, '')}".strip()
    for name, (_, focals, *_) in MODELS.items()
}
"""Parameters by the name of the camera model."""


def write_text_model(
    folder: Path,
    *,
    camera: str = "PINHOLE",
    names: tuple[str, ...] = ("a.png", "b.png", "c.png"),
    points: int = 40,
) -> None:
    """A wall 4 units away that cameras side by side see; each observes all points."""
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-1.2, 1.2, (points, 2)), rng.uniform(3.5, 4.5, points)])
    keypoints = " ".join(f"0 0 {number + 1}" for number in range(points))
    tracks = [" ".join(f"{i + 1} {p}" for i in range(len(names))) for p in range(points)]
    lines = {
        "cameras": [f"1 {camera} {WIDTH} {HEIGHT} {CAMERAS[camera]}"],
        "images": [
            f"{number + 1} 1 0 0 0 {0.1 * number} 0 0 1 {name}\n{keypoints} 5 5 -1"
            for number, name in enumerate(names)
        ],
        "points3D": [
            f"{n + 1} {x} {y} {z} 9 9 9 0.5 {tracks[n]}" for n, (x, y, z) in enumerate(xyz)
        ],
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(["# comment", *rows, ""]))


def write_binary_model(folder: Path) -> None:
    """Two images of one point each, and one point that both observe."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = struct.pack("<IiQQ4d", 1, 2, 64, 48, 50.0, 32.0, 24.0, 0.1)
    seen = struct.pack("<Q", 2) + struct.pack("<ddq", 10, 11, 7) + struct.pack("<ddq", 12, 13, -1)
    images = b"".join(
        struct.pack("<I7dI", n, 1, 0, 0, 0, 0.1 * n, 0, 0, 1) + f"dir/{n}.png\0".encode() + seen
        for n in (1, 2)
    )
    point = struct.pack("<Q3d3BdQ", 7, 0.5, -0.25, 4.0, 1, 2, 3, 0.75, 2)
    track = struct.pack("<4I", 1, 0, 2, 0)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + images)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 1) + point + track)
