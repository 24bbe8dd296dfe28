"""Data sets as they lie on disk: which one a folder is, and its frames.

frames = read_frames(Path("KITTI/object"))            # guessed
frames = read_frames(Path("frames"), "pairs")         # named
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.layouts import (
    kitti_depth,
    kitti_object,
    kitti_odometry,
    manifest,
    nyu,
    pairs,
    seven_scenes,
    synthia,
    tum,
)
from pnpdepth_cli.io.layouts.frame import Frame, Hdf5Array, Listing, Source, Unmatched
from pnpdepth_cli.io.layouts.protocols import PROTOCOLS, Protocol, find_protocol
from pnpdepth_cli.io.layouts.reading import read_frame_image, read_frame_truth

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
    "read_frame_image",
    "read_frame_truth",
    "read_frames",
]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """matches(root): whether a folder or file is of this layout. listing(root): what is in it."""

    name: str
    matches: Callable[[Path], bool]
    listing: Callable[[Path], Listing]


LAYOUTS = {
    layout.name: layout
    for layout in (
        Layout(name="manifest", matches=manifest.matches, listing=manifest.listing),
        Layout(name="nyu-mat", matches=nyu.mat_matches, listing=nyu.mat_listing),
        Layout(
            name="kitti-odometry", matches=kitti_odometry.matches, listing=kitti_odometry.listing
        ),
        Layout(name="kitti-object", matches=kitti_object.matches, listing=kitti_object.listing),
        Layout(name="kitti-depth", matches=kitti_depth.matches, listing=kitti_depth.listing),
        Layout(name="tum", matches=tum.matches, listing=tum.listing),
        Layout(name="7scenes", matches=seven_scenes.matches, listing=seven_scenes.listing),
        Layout(name="synthia", matches=synthia.matches, listing=synthia.listing),
        Layout(name="pairs", matches=pairs.matches, listing=pairs.listing),
        Layout(name="nyu-h5", matches=nyu.h5_matches, listing=nyu.h5_listing),
    )
}
"""The layouts that can be named, in the order in which they are guessed."""


def find_layout(root: Path, name: str | None = None) -> Layout:
    """The layout of this name, or the first that the folder looks like.

    UsageError for a name nobody knows, InputError for a folder that looks like none.
    """
    if name is not None and name not in LAYOUTS:
        raise UsageError(f"no layout {name!r}; there are {', '.join(LAYOUTS)}")
    if not root.exists():
        raise InputError(f"{root}: no such folder; check the path")
    for layout in LAYOUTS.values() if name is None else (LAYOUTS[name],):
        if layout.matches(root):
            return layout
    looks = f"like {name!r}" if name else f"like any layout ({', '.join(LAYOUTS)})"
    raise InputError(f"{root} does not look {looks}; check the folder, or name its layout")


def list_frames(root: Path, name: str | None = None) -> tuple[Layout, Listing]:
    """The layout of a data set, and what is in it, with all that is in no frame.

    InputError if the folder looks like no layout, or cannot be read.
    """
    try:
        layout = find_layout(root, name)
        return layout, layout.listing(root)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{error.filename or root} cannot be read ({reason}); check it") from error


def read_frames(root: Path, name: str | None = None) -> list[Frame]:
    """The frames of a data set, in a fixed order. InputError if there is none, or one is broken."""
    layout, listing = list_frames(root, name)
    if listing.broken:
        raise InputError(str(listing.broken[0]))
    if not listing.frames:
        raise InputError(f"{root} looks like {layout.name!r} but has no frame in it")
    return listing.frames
