"""Data set layouts: which one a folder is, and its frames; `TABLE` has them by name.

    layout, frames, unmatched = list_frames(Path("KITTI/object"))     # layout guessed
    layout, frames, unmatched = list_frames(Path("frames"), "pairs")  # layout named

A new layout is a row of `rows`, or a `Layout` in `TABLE`, with its name in `choices.LAYOUTS`; or an
entry point of the group `pnpdepth.layouts`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.choices import LAYOUTS
from pnpdepth_cli.dataset.frame_files import FrameFiles, Unmatched
from pnpdepth_cli.dataset.layouts import indexed, kitti, manifest, rows
from pnpdepth_cli.dataset.layouts.layout import Layout
from pnpdepth_cli.errors import InputError

__all__ = ["LAYOUTS", "Layout", "list_frames"]

TABLE: dict[str, Layout] = {
    **rows.ROWS,
    "manifest": manifest.MANIFEST,
    "kitti-odometry": kitti.ODOMETRY,
    "kitti-depth": kitti.DEPTH,
    "kitti-raw": kitti.RAW,
    "tum": indexed.TUM,
    "colmap": indexed.COLMAP,
    "stray-scanner": indexed.STRAY_SCANNER,
    "record3d": indexed.RECORD3D,
}
"""The layouts of this package, which `choices.LAYOUTS` lists in the order of guessing."""


def _match(root: Path, name: str | None) -> str | None:
    names = LAYOUTS if name is None else (name,)
    return next((layout for layout in names if LAYOUTS[layout].matches(root)), None)


def list_frames(
    root: Path, name: str | None = None
) -> tuple[str, list[FrameFiles], list[Unmatched]]:
    """Returns the name of a data set's layout, its frames in a fixed order, and what is in none.

    Args:
        root: The data set, or a folder with several of one layout.
        name: Name of the layout; None to guess.

    Raises:
        InputError: The folder matches no layout, or cannot be read.
    """
    try:
        folders, layout = _data_sets(root, name)
        found = [(folder, each) for folder in folders for each in LAYOUTS[layout].frames(folder)]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{error.filename or root} cannot be read ({reason}); check it") from error
    frames = [
        each if folder == root else replace(each, name=f"{folder.name}/{each.name}")
        for folder, each in found
        if isinstance(each, FrameFiles)
    ]
    lost = dict.fromkeys(each for _, each in found if isinstance(each, Unmatched))
    return layout, frames, list(lost)


def _data_sets(root: Path, name: str | None) -> tuple[list[Path], str]:
    """The folder, or those in it that are of one layout, and that layout."""
    if not root.exists():
        raise InputError(f"{root}: no such folder; check the path")
    if (layout := _match(root, name)) is not None:
        return [root], layout
    # The folders in it may be data sets of one layout.
    inside = sorted(root.iterdir()) if root.is_dir() else []
    folders = [path for path in inside if path.is_dir() and not path.name.startswith(".")]
    found = {path: each for path in folders if (each := _match(path, name)) is not None}
    layouts = sorted(set(found.values()))
    if len(layouts) > 1:
        raise InputError(
            f"{root} holds folders of several layouts ({', '.join(layouts)}); give one of them, or"
            " name the layout"
        )
    if found:
        return list(found), layouts[0]
    # Why there is none.
    if root.suffix.lower() == ".r3d":
        raise InputError(
            f"{root}: the depth in it is compressed with LZFSE, which is not read; export 'EXR +"
            " RGB' in Record3D, and give the folder EXR_RGBD"
        )
    if name is None:
        raise InputError(
            f"{root} does not look like any layout ({', '.join(LAYOUTS)}); name one to see what it"
            " needs, or put images into rgb/ and their sparse depth into sparse/, with equal names,"
            " or give a CSV list with the columns image and sparse"
        )
    needed = ", ".join(LAYOUTS[name].needs)
    raise InputError(
        f"{root} does not look like {name!r}" + (f", which needs {needed}" if needed else "")
    )
