"""`kitti-odometry`: sequences/NN/ with image_2/, velodyne/ and calib.txt, or one such sequence.

The truth of its experiments is the scan itself.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.layouts.frame import PICTURES, Frame, by_stem, partner
from pnpdepth_cli.io.layouts.protocols import PROTOCOLS


def matches(root: Path) -> bool:
    """True if the folder holds sequences with scans, or is one."""
    return bool(_sequences(root))


def frames(root: Path) -> list[Frame]:
    """One frame for each image of the left colour camera, in the order of the sequences."""
    found = []
    for sequence in _sequences(root):
        scans = by_stem(sequence / "velodyne", (".bin",))
        found += [
            Frame(
                name=f"{sequence.name}_{stem}",
                image=image,
                sparse=partner(scans, stem, image, sequence / "velodyne"),
                calib=sequence / "calib.txt",
                camera=2,
                protocol=PROTOCOLS["kitti-odometry"],
            )
            for stem, image in by_stem(sequence / "image_2", PICTURES).items()
        ]
    return found


def _sequences(root: Path) -> list[Path]:
    inside = (root / "sequences", root / "dataset" / "sequences")
    candidates = [root, *(p for folder in inside if folder.is_dir() for p in folder.iterdir())]
    return sorted(
        p
        for p in candidates
        if (p / "calib.txt").is_file() and (p / "image_2").is_dir() and (p / "velodyne").is_dir()
    )
