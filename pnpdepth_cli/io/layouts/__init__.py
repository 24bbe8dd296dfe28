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
from pnpdepth_cli.io.layouts.frame import Frame, Hdf5Array
from pnpdepth_cli.io.layouts.protocols import PROTOCOLS, Protocol, find_protocol
from pnpdepth_cli.io.layouts.reading import read_frame_image, read_frame_truth

__all__ = [
    "LAYOUTS",
    "PROTOCOLS",
    "Frame",
    "Hdf5Array",
    "Layout",
    "Protocol",
    "find_layout",
    "find_protocol",
    "read_frame_image",
    "read_frame_truth",
    "read_frames",
]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """matches(root): whether a folder or file is of this layout. frames(root): what is in it."""

    name: str
    matches: Callable[[Path], bool]
    frames: Callable[[Path], list[Frame]]


LAYOUTS = {
    layout.name: layout
    for layout in (
        Layout(name="manifest", matches=manifest.matches, frames=manifest.frames),
        Layout(name="nyu-mat", matches=nyu.mat_matches, frames=nyu.mat_frames),
        Layout(name="kitti-odometry", matches=kitti_odometry.matches, frames=kitti_odometry.frames),
        Layout(name="kitti-object", matches=kitti_object.matches, frames=kitti_object.frames),
        Layout(name="kitti-depth", matches=kitti_depth.matches, frames=kitti_depth.frames),
        Layout(name="tum", matches=tum.matches, frames=tum.frames),
        Layout(name="7scenes", matches=seven_scenes.matches, frames=seven_scenes.frames),
        Layout(name="synthia", matches=synthia.matches, frames=synthia.frames),
        Layout(name="pairs", matches=pairs.matches, frames=pairs.frames),
        Layout(name="nyu-h5", matches=nyu.h5_matches, frames=nyu.h5_frames),
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


def read_frames(root: Path, name: str | None = None) -> list[Frame]:
    """The frames of a data set, in a fixed order. InputError if there is none."""
    layout = find_layout(root, name)
    frames = layout.frames(root)
    if not frames:
        raise InputError(f"{root} looks like {layout.name!r} but has no frame in it")
    return frames
