"""Data set layouts: which one a folder is, and its frames; one file each in `choices.LAYOUTS`.

    frames = read_frames(Path("KITTI/object"))            # layout guessed
    frames = read_frames(Path("frames"), "pairs")         # layout named

A new layout is one new file in this folder, or an entry point of the group `pnpdepth.layouts`, that
holds a `Layout` called `LAYOUT`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.choices import LAYOUTS
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.dataset.frame import Frame, Hdf5Array, Listing, Source, Unmatched
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS, Protocol, find_protocol
from pnpdepth_cli.io.dataset.reading import read_frame_ground_truth, read_frame_image

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


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How the files of a data set lie on disk."""

    matches: Callable[[Path], bool]
    """Whether a folder or file is of this layout."""

    listing: Callable[[Path], Listing]
    """The frames of a folder or file that matches, and what is in no frame."""


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
    looks = f"like {name!r}" if name else f"like any layout ({', '.join(LAYOUTS)})"
    raise InputError(f"{root} does not look {looks}; check the folder, or name its layout")


def list_frames(root: Path, name: str | None = None) -> tuple[str, Listing]:
    """Returns the name of a data set's layout, its frames, and all that is in no frame.

    Args:
        root: The data set.
        name: Its layout; None to guess.

    Raises:
        InputError: The folder matches no layout, or cannot be read.
    """
    try:
        layout = find_layout(root, name)
        return layout, LAYOUTS[layout].listing(root)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{error.filename or root} cannot be read ({reason}); check it") from error


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
    return listing.frames
