"""Data set layouts: which one a folder is, and its frames; `TABLE` has them by name.

    frames = read_frames(Path("KITTI/object"))            # layout guessed
    frames = read_frames(Path("frames"), "pairs")         # layout named

A new layout is one entry of `TABLE`, a row of `folders` or a `Layout`, with its name in
`choices.LAYOUTS`; or an entry point of the group `pnpdepth.layouts`.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.choices import LAYOUTS
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.dataset.frame import Frame, Hdf5Array, Listing, Source, Unmatched
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS, Protocol, find_protocol
from pnpdepth_cli.io.dataset.reading import read_frame_ground_truth, read_frame_image
from pnpdepth_cli.io.layouts.layout import Layout, merged  # isort: split

# after Layout, which the manifest's module imports from here
from pnpdepth_cli.io.layouts import (
    colmap,
    driving,
    folders,
    hdf5_files,
    kitti,
    manifest,
    pairs,
    synthia,
    tum,
)

__all__ = [
    "LAYOUTS",
    "PROTOCOLS",
    "Frame",
    "Hdf5Array",
    "Layout",
    "Listing",
    "Protocol",
    "Source",
    "Unmatched",
    "find_layout",
    "find_protocol",
    "list_frames",
    "read_frame_ground_truth",
    "read_frame_image",
    "read_frames",
]


TABLE: dict[str, Layout] = {
    **folders.ROWS,
    "manifest": manifest.LAYOUT,
    "nyu-mat": hdf5_files.NYU_MAT,
    "kitti-odometry": kitti.ODOMETRY,
    "kitti-depth": kitti.DEPTH,
    "kitti-raw": kitti.RAW,
    "tum": tum.TUM,
    "synthia": synthia.SYNTHIA,
    "colmap": colmap.COLMAP,
    "hypersim": hdf5_files.HYPERSIM,
    "nuscenes": driving.NUSCENES,
    "ddad": driving.DDAD,
    "pairs": pairs.PAIRS,
    "nyu-h5": hdf5_files.NYU_H5,
}
"""The layouts of this package, which `choices.LAYOUTS` lists in the order of guessing."""


def find_layout(root: Path, name: str | None = None) -> str:
    """Returns the name of the layout that a folder or file is of.

    Args:
        root: The data set.
        name: The only layout to consider; None for all, in the order of `choices.LAYOUTS`.

    Raises:
        UsageError: There is no layout of this name.
        InputError: The folder does not exist, or matches no layout.
    """
    if name is not None and name not in LAYOUTS:
        raise UsageError(f"no layout {name!r}; there are {', '.join(LAYOUTS)}")
    if not root.exists():
        raise InputError(f"{root}: no such folder; check the path")
    for each in LAYOUTS if name is None else (name,):
        if LAYOUTS[each].matches(root):
            return each
    if name is not None:
        needed = ", ".join(LAYOUTS[name].needs)
        raise InputError(
            f"{root} does not look like {name!r}" + (f", which needs {needed}" if needed else "")
        )
    raise InputError(f"{root} does not look like any layout; {_nearest(root)}")


def _nearest(root: Path) -> str:
    """What the nearest layout lacks, and what the others need."""
    needs = {each: LAYOUTS[each].needs for each in LAYOUTS if LAYOUTS[each].needs}
    present = {
        each: [pattern for pattern in patterns if next(root.glob(pattern), None)]
        for each, patterns in needs.items()
    }
    best = max(needs, key=lambda each: len(present[each]) / len(needs[each]))
    text = "layouts need: "
    if present[best]:
        lacking = [pattern for pattern in needs[best] if pattern not in present[best]]
        fact = f" and lacks {', '.join(lacking)}" if lacking else ""
        text = f"nearest is {best!r}, which needs {', '.join(needs[best])}{fact}; others need: "
    others = (each for each in needs if each != best or not present[best])
    without = [each for each in LAYOUTS if each not in needs]
    more = f"; without a fixed folder: {', '.join(without)}" if without else ""
    return text + "; ".join(f"{each} {', '.join(needs[each])}" for each in others) + more


def list_frames(root: Path, name: str | None = None) -> tuple[str, Listing]:
    """Returns the name of a data set's layout, its frames, and all that is in no frame.

    Args:
        root: The data set.
        name: Its layout; None to guess.

    Raises:
        InputError: The folder matches no layout, or cannot be read.
    """
    try:
        parts = _data_sets(root, name)
        layout = parts[0][1]
        if parts[0][0] == root:
            return layout, LAYOUTS[layout].listing(root)
        listings = [_prefixed(LAYOUTS[layout].listing(folder), folder) for folder, _ in parts]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{error.filename or root} cannot be read ({reason}); check it") from error
    return layout, merged(listings)


def _prefixed(listing: Listing, folder: Path) -> Listing:
    frames = [replace(frame, name=f"{folder.name}/{frame.name}") for frame in listing.frames]
    return replace(listing, frames=frames)


def _data_sets(root: Path, name: str | None) -> list[tuple[Path, str]]:
    """The folder, or those in it that are of one layout, with that layout.

    Raises:
        InputError: Neither is, or the folders in it are of several layouts.
    """
    try:
        return [(root, find_layout(root, name))]
    except InputError as error:
        data_sets = []
        for folder in sorted(root.iterdir()) if root.is_dir() else []:
            if folder.is_dir() and not folder.name.startswith("."):
                with suppress(InputError):
                    data_sets.append((folder, find_layout(folder, name)))
        layouts = sorted({layout for _, layout in data_sets})
        if len(layouts) > 1:
            raise InputError(
                f"{root} holds folders of several layouts ({', '.join(layouts)}); give one of"
                " them, or name the layout"
            ) from error
        if not data_sets:
            raise
        return data_sets


def read_frames(root: Path, name: str | None = None) -> list[Frame]:
    """Returns the frames of a data set, in a fixed order.

    Args:
        root: The data set.
        name: Its layout; None to guess.

    Raises:
        InputError: There is no frame, or one is incomplete.
    """
    layout, listing = list_frames(root, name)
    if listing.broken:
        raise InputError(str(listing.broken[0]))
    if not listing.frames:
        raise InputError(f"{root} looks like {layout!r} but has no frame in it")
    return list(listing.frames)
