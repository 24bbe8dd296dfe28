"""Data set layouts: which one a folder is, and its frames.

    layout, frames, unmatched = list_frames(Path("KITTI/object"))     # layout guessed
    layout, frames, unmatched = list_frames(Path("frames"), "pairs")  # layout named

`choices.LAYOUTS` says where each is. A new layout is a row here, or a `Layout` in a file of this
folder, and its line there; or an entry point of the group `pnpdepth.layouts`.
docs/guides/many-frames.md shows the folders of all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from pnpdepth_cli.choices import LAYOUTS
from pnpdepth_cli.dataset.frame_files import FrameFiles, Unmatched, check_path
from pnpdepth_cli.dataset.layouts.layout import Layout, row
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import read_bytes

__all__ = ["LAYOUTS", "Layout", "list_frames"]


def _prefix_with_place(mark: str) -> Callable[[Path, Path, str], str]:
    """A function that puts the place's name and a mark before the stem, if it is not the root."""
    return lambda root, place, stem: stem if place == root else f"{place.name}{mark}{stem}"


def _of_void(place: Path) -> Callable[[FrameFiles], FrameFiles | None]:
    """Keeps the frames of the test split, or all where no split is listed."""
    split = place.parent.parent / "test_image.txt"
    if place.parent.name != "data" or not split.is_file():
        return replace
    words = read_bytes(split).decode("utf-8", "replace").split()
    wanted = {path.stem for path in map(Path, words) if path.parts[-3:-2] == (place.name,)}
    return lambda frame: frame if frame.name in wanted else None


SEVEN_SCENES = row(
    {"image": r"(frame-[^.]+)\.color.IMAGE", "gt": r"(frame-[^.]+)\.depth.png"},
    below="|seq-*/",
    marks=("frame-*.color.*",),
    name=_prefix_with_place("_"),
    calib="camera-intrinsics.txt",
    shared=FrameFiles(gt_scale=1000.0),
)

ARKITSCENES = row(
    {
        "image": "wide|color|lowres_wide/*.png",
        "sparse": "lowres_depth/*.png",
        "sparse_mask": "confidence/*.png?",
        "gt": "highres_depth/*.png?",
    },
    below="|*/|*/*/",
    name=_prefix_with_place("/"),
    shared=FrameFiles(sparse_scale=1000.0, gt_scale=1000.0, gt_other_size=True, one_view=True),
)

DIODE = row(
    {"gt": "*_depth.npy", "image": "*.png", "mask": "*_depth_mask.npy"},
    below="|*/|*/*/|*/*/*/|*/*/*/*/",
    marks=("*_depth_mask.npy", "*_depth.npy"),
)

ETH3D = row(
    {"image": "images/dslr_images/*.JPG", "gt": "ground_truth_depth/dslr_images/*.JPG"},
    below="|*/|*/*/",
    marks=("ground_truth_depth",),
    name=_prefix_with_place("/"),
)

IBIMS = row(
    {
        "image": "rgb/*.png",
        "gt": "depth/*.png",
        "mask": "mask_invalid/*.png?",
        "mask of transparent things": "mask_transp/*.png?",
    },
    marks=("mask_invalid", "mask_transp"),
    shared=FrameFiles(gt_scale=65535 / 50),
)

IMAGE_DEPTH = row({"image": "image|images/**.IMAGE", "gt": "depth/**.DEPTH"}, calib="calib.txt")

KITTI_OBJECT = row(
    {"image": "image_2/*.IMAGE", "sparse": "velodyne/*.bin", "calib": "calib/*.txt"},
    below="|training/|testing/",
    name=_prefix_with_place("_"),
    shared=FrameFiles(camera=2),
)

PAIRS = row(
    {
        "image": "rgb/**.IMAGE",
        "sparse": "sparse/**.SPARSE",
        "gt": "gt/**.DEPTH?",
        "calib": "calib/**.CALIB?",
    },
    calib="calib.txt",
)

SCANNET = row(
    {"image": "color/*.IMAGE", "gt": "depth/*.png"},
    below="|*/|*/*/",
    marks=("intrinsic",),
    name=_prefix_with_place("/"),
    calib="intrinsic/intrinsic_color.txt",
    shared=FrameFiles(gt_scale=1000.0, gt_other_size=True),
)

VOID = row(
    {
        "image": "image/*.png",
        "sparse": "sparse_depth/*.png",
        "sparse_mask": "validity_map/*.png?",
        "gt": "ground_truth/*.png?",
    },
    below="|*/|data/*/|*/data/*/",
    marks=("sparse_depth", "ground_truth"),
    calib="K.txt",
    more=_of_void,
    shared=FrameFiles(sparse_scale=256.0, gt_scale=256.0, one_view=True),
)


class DataSet(NamedTuple):
    """The frames of a data set."""

    layout: str
    """Name of its layout."""
    frames: list[FrameFiles]
    """In a fixed order."""
    unmatched: list[Unmatched]
    """Files and folders that belong to no frame."""


def list_frames(root: Path, name: str | None = None) -> DataSet:
    """Returns the frames of a data set.

    Args:
        root: The data set, or a folder with several of one layout.
        name: Name of the layout; None to guess.

    Raises:
        InputError: The folder matches no layout, or cannot be read.
    """
    try:
        folders = _data_sets(root, [*LAYOUTS] if name is None else [name])
        layouts = sorted({*folders.values()})
        if len(layouts) > 1:
            raise InputError(
                f"{root} holds folders of several layouts ({', '.join(layouts)}); give one of them,"
                " or name the layout"
            )
        layout = layouts[0]
        found = [(path, entry) for path in folders for entry in LAYOUTS[layout].frames(path)]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{error.filename or root} cannot be read ({reason}); check it") from error
    frames = [
        frame if folder == root else replace(frame, name=f"{folder.name}/{frame.name}")
        for folder, frame in found
        if isinstance(frame, FrameFiles)
    ]
    lost = dict.fromkeys(entry for _, entry in found if isinstance(entry, tuple))
    for path, _ in lost:
        check_path(path)
    return DataSet(layout, frames, list(lost))


def _data_sets(root: Path, names: Sequence[str]) -> dict[Path, str]:
    """The layout of the folder, or else of those in it, by their paths; at least one."""
    if not root.exists():
        raise InputError(f"{root}: no such folder; check the path")
    if root.suffix.lower() == ".r3d":
        raise InputError(
            f"{root}: the depth in it is compressed with LZFSE, which is not read; export 'EXR +"
            " RGB' in Record3D, and give the folder EXR_RGBD"
        )
    # The folder itself, else those in it.
    inside = sorted(root.iterdir()) if root.is_dir() else []
    below = [path for path in inside if path.is_dir() and not path.name.startswith(".")]
    for folders in ([root], below):
        found = dict[Path, str]()
        for folder in folders:
            matching = next((name for name in names if LAYOUTS[name].matches(folder)), None)
            if matching is not None:
                found[folder] = matching
        if found:
            return found
    # It is none. What a folder lacks is said where one layout is wanted.
    if root.is_file():
        raise InputError(
            f"{root} is one file; give a folder, a CSV list of frames or a bag, or refine one image"
        )
    lacked = LAYOUTS[names[0]].lacks(root) if len(names) == 1 else None
    if lacked is not None:
        place, pattern = lacked
        raise InputError(f"{place} has no {pattern}, which {names[0]} needs; add it")
    raise InputError(
        f"{root} does not look like {', '.join(names)}, whose folders docs/guides/many-frames.md"
        " lists, and --layout NAME says what is missing; put images into rgb/ and their sparse"
        " depth into sparse/, with equal names, or give a CSV list with columns image and sparse"
    )
