"""`kitti-object`: KITTI's object set, image_2/ velodyne/ calib/ in training/ or testing/."""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.layouts.frame import PICTURES, Frame, by_stem, partner


def matches(root: Path) -> bool:
    """True if image_2/, velodyne/ and calib/ are in the folder or in its training/."""
    return bool(_parts(root))


def frames(root: Path) -> list[Frame]:
    """One frame for each image of the left colour camera; InputError for one without scan."""
    found = []
    for part in _parts(root):
        scans = by_stem(part / "velodyne", (".bin",))
        calibrations = by_stem(part / "calib", (".txt",))
        prefix = "" if part == root else f"{part.name}_"
        found += [
            Frame(
                name=f"{prefix}{stem}",
                image=image,
                sparse=partner(scans, stem, image, part / "velodyne"),
                calib=partner(calibrations, stem, image, part / "calib"),
                camera=2,
            )
            for stem, image in by_stem(part / "image_2", PICTURES).items()
        ]
    return found


def _parts(root: Path) -> list[Path]:
    candidates = (root, root / "training", root / "testing")
    needed = ("image_2", "velodyne", "calib")
    return [p for p in candidates if all((p / name).is_dir() for name in needed)]
