"""`pairs`: rgb/ and sparse/, and optionally gt/ and calib/, with files of the same stems.

Folders in them are searched too: rgb/drive_1/000.png belongs to sparse/drive_1/000.png. calib/ has
one file per frame; a calib.txt beside the folders applies to all.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.io.dataset.find_files import find_files
from pnpdepth_cli.io.dataset.frame import (
    IMAGE_SUFFIXES,
    SCAN_ONLY_SUFFIXES,
    Frame,
    Listing,
)
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES
from pnpdepth_cli.io.layouts.layout import Layout, joined

_FOLDERS = {
    "image": ("rgb", IMAGE_SUFFIXES),
    "sparse": ("sparse", (*DEPTH_SUFFIXES, *SCAN_ONLY_SUFFIXES, ".csv")),
    "gt": ("gt", DEPTH_SUFFIXES),
    "calib": ("calib", (".txt", ".json", ".yaml", ".yml")),
}


def _listing(root: Path) -> Listing:
    """One frame for each image with sparse depth."""
    folders = {part: root / folder for part, (folder, _) in _FOLDERS.items()}
    found = {part: find_files(folders[part], kinds) for part, (_, kinds) in _FOLDERS.items()}
    shared = {"calib": root / "calib.txt"} if (root / "calib.txt").is_file() else {}
    listing = joined(
        folders,
        {part: files for part, (files, _) in found.items()},
        lambda stem, files: Frame(name=stem, **{**shared, **files}),
        optional=("gt", "calib"),
        spare=("sparse", "gt", "calib"),
    )
    lost = tuple(each for _, unreadable in found.values() for each in unreadable)
    return replace(listing, broken=lost + listing.broken)


PAIRS = Layout(
    matches=lambda root: (root / "rgb").is_dir() and (root / "sparse").is_dir(),
    listing=_listing,
    needs=("rgb", "sparse"),
)
