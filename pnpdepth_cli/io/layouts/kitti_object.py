"""`kitti-object`: KITTI's object set, image_2/ velodyne/ calib/ in training/ or testing/."""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.frame import (
    IMAGE_SUFFIXES,
    Frame,
    Listing,
    Unmatched,
    by_stem,
    without_partner,
)
from pnpdepth_cli.io.layouts import Layout


def matches(root: Path) -> bool:
    """Returns whether image_2/, velodyne/ and calib/ are in the folder or in its training/."""
    return bool(_parts(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each image of the left colour camera with scan and calibration."""
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    spare: list[Unmatched] = []
    for part in _parts(root):
        images = by_stem(part / "image_2", IMAGE_SUFFIXES)
        scans = by_stem(part / "velodyne", (".bin",))
        calibrations = by_stem(part / "calib", (".txt",))
        prefix = "" if part == root else f"{part.name}_"
        frames += [
            Frame(
                name=f"{prefix}{stem}",
                image=image,
                sparse=scans[stem],
                calib=calibrations[stem],
                camera=2,
            )
            for stem, image in images.items()
            if stem in scans and stem in calibrations
        ]
        broken += without_partner(images, scans, part / "velodyne")
        broken += without_partner(images, calibrations, part / "calib")
        spare += without_partner(scans, images, part / "image_2")
    return Listing(frames=frames, broken=tuple(broken), spare=tuple(spare))


def _parts(root: Path) -> list[Path]:
    candidates = (root, root / "training", root / "testing")
    needed = ("image_2", "velodyne", "calib")
    return [p for p in candidates if all((p / name).is_dir() for name in needed)]


LAYOUT = Layout(matches=matches, listing=listing, needs=("image_2", "velodyne", "calib"))
