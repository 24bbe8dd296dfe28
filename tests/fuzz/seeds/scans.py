"""Scans in every format, and bags of ROS 1, ROS 2 and MCAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.bags import write_bag
from tests.fuzz.seeds.seed import IMAGE, OUT, Seed
from tests.io.test_scans import FILES


def write_seeds(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    """Returns scans, and bags if rosbags is installed."""
    return [*_scans(folder, rng), *_bags(folder)]


def lidar_points(rng: np.random.Generator) -> np.ndarray:
    """Returns (200, 4) float32 x, y, z and intensity in front of the scanner.

    Args:
        rng: Of the coordinates.
    """
    xyz = rng.uniform((5, -3, -2), (30, 3, 2), (200, 3))
    return np.column_stack([xyz, rng.uniform(0, 1, 200)]).astype(np.float32)


def _scans(folder: Path, rng: np.random.Generator) -> list[Seed]:
    points = lidar_points(rng)[:, :3]
    for name, content in FILES.items():
        (folder / name).write_bytes(content(points))
    return [
        Seed(file=name, command=("project", name, "--calib", "calib.txt", *IMAGE, *OUT))
        for name in FILES
    ]


def _bags(folder: Path) -> list[Seed]:
    try:
        write_bag(folder / "drive.bag", frames=2)
        write_bag(folder / "drive.mcap", frames=2)
        write_bag(folder / "photos.bag", frames=2, compressed=True)
        sqlite = write_bag(folder / "ros2", frames=2)
    except ImportError:  # the extra is not installed
        return []
    (database,) = sqlite.glob("*.db3")
    files = {
        **dict.fromkeys(("drive.bag", "drive.mcap", "photos.bag")),
        **dict.fromkeys((f"ros2/{database.name}", "ros2/metadata.yaml"), "ros2"),
    }
    return [
        Seed(file=file, command=("frames", bag or file, "-o", "frames"))
        for file, bag in files.items()
    ]
