"""Scans in every format, and bags of ROS 1, ROS 2 and MCAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.bags import write_bag
from tests.fuzz.seeds.seed import OUT, SIZE, Seed


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
    points = lidar_points(rng)
    points.tofile(folder / "scan.bin")
    np.save(folder / "scan.npy", points)
    rows = "\n".join(" ".join(f"{v:.4f}" for v in row) for row in points)
    pcd = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
        "COUNT 1 1 1 1\nWIDTH 200\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 200\n"
    )
    (folder / "ascii.pcd").write_text(f"{pcd}DATA ascii\n{rows}\n")
    (folder / "binary.pcd").write_bytes(f"{pcd}DATA binary\n".encode() + points.tobytes())
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    ply = f"ply\nformat {{}} 1.0\nelement vertex 200\n{properties}end_header\n"
    (folder / "ascii.ply").write_text(ply.format("ascii") + rows + "\n")
    for order, kind in (("little", "<f4"), ("big", ">f4")):
        header = ply.format(f"binary_{order}_endian").encode()
        (folder / f"{order}.ply").write_bytes(header + points.astype(kind).tobytes())
    names = ("scan.bin", "scan.npy", "ascii.pcd", "binary.pcd", "ascii.ply")
    return [
        Seed(file=name, command=("project", name, "--calib", "calib.txt", *SIZE, *OUT))
        for name in (*names, "little.ply", "big.ply")
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
