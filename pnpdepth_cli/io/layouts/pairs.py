"""`pairs`: rgb/ and sparse/, and perhaps gt/ and calib/, with the same stems.

calib/ has one file a frame; a calib.txt beside the folders holds for all.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.layouts.frame import DEPTHS, PICTURES, SCANS, Frame, by_stem, partner

_CALIBRATIONS = (".txt", ".json", ".yaml", ".yml")


def matches(root: Path) -> bool:
    """True if the folder has rgb/ and sparse/."""
    return (root / "rgb").is_dir() and (root / "sparse").is_dir()


def frames(root: Path) -> list[Frame]:
    """One frame for each image; InputError for one without sparse depth."""
    sparse = by_stem(root / "sparse", (*DEPTHS, *SCANS, ".csv"))
    gt, calib = by_stem(root / "gt", DEPTHS), by_stem(root / "calib", _CALIBRATIONS)
    shared = root / "calib.txt"
    return [
        Frame(
            name=stem,
            image=image,
            sparse=partner(sparse, stem, image, root / "sparse"),
            gt=gt.get(stem),
            calib=calib.get(stem, shared if shared.is_file() else None),
        )
        for stem, image in by_stem(root / "rgb", PICTURES).items()
    ]
