"""`pairs`: rgb/ and sparse/, and optionally gt/ and calib/, with files of the same stems.

Folders in them are searched too: rgb/drive_1/000.png belongs to sparse/drive_1/000.png. calib/ has
one file per frame; a calib.txt beside the folders applies to all.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.find_files import find_files
from pnpdepth_cli.io.dataset.frame import (
    IMAGE_SUFFIXES,
    SCAN_ONLY_SUFFIXES,
    Frame,
    Listing,
    without_partner,
)
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES
from pnpdepth_cli.io.layouts import Layout

_SPARSE_SUFFIXES = (*DEPTH_SUFFIXES, *SCAN_ONLY_SUFFIXES, ".csv")
_CALIBRATIONS = (".txt", ".json", ".yaml", ".yml")


def matches(root: Path) -> bool:
    """Returns whether the folder has rgb/ and sparse/."""
    return (root / "rgb").is_dir() and (root / "sparse").is_dir()


def listing(root: Path) -> Listing:
    """Returns one frame for each image with sparse depth."""
    images, lost_images = find_files(root / "rgb", IMAGE_SUFFIXES)
    sparse, lost_sparse = find_files(root / "sparse", _SPARSE_SUFFIXES)
    gt, lost_gt = find_files(root / "gt", DEPTH_SUFFIXES)
    calib, lost_calib = find_files(root / "calib", _CALIBRATIONS)
    shared = root / "calib.txt"
    frames = [
        Frame(
            name=name,
            image=image,
            sparse=sparse[name],
            gt=gt.get(name),
            calib=calib.get(name, shared if shared.is_file() else None),
        )
        for name, image in images.items()
        if name in sparse
    ]
    return Listing(
        frames=frames,
        broken=(
            *lost_images,
            *lost_sparse,
            *lost_gt,
            *lost_calib,
            *without_partner(images, sparse, root / "sparse"),
        ),
        spare=tuple(
            each
            for others in (sparse, gt, calib)
            for each in without_partner(others, images, root / "rgb")
        ),
    )


LAYOUT = Layout(matches=matches, listing=listing, needs=("rgb", "sparse"))
