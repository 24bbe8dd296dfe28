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
from pnpdepth_cli.dataset.layouts.layout import Finish, Layout, as_it_is, layout_of_folders
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import read_bytes

__all__ = ["LAYOUTS", "Layout", "list_frames"]


def _name_with_place(mark: str) -> Callable[[Path, Path, str], str]:
    """The function of root, place and stem that names a frame by its place's folder and its stem.

    Args:
        mark: Text between the two. A frame of the root itself is named by its stem alone.
    """

    def name(root: Path, place: Path, stem: str) -> str:
        """The name of a frame, such as seq-01_frame-000012."""
        return stem if place == root else f"{place.name}{mark}{stem}"

    return name


def _test_frames_of(place: Path) -> Finish:
    """The function that keeps the frames of VOID's test split, or all where no split is listed.

    Args:
        place: Folder of one sequence of VOID, data/SEQUENCE, with test_image.txt beside data/.
    """
    split = place.parent.parent / "test_image.txt"
    if place.parent.name != "data" or not split.is_file():
        return as_it_is
    # The split lists images of all sequences as .../SEQUENCE/image/STEM.png.
    words = read_bytes(split).decode("utf-8", "replace").split()
    stems = {path.stem for path in map(Path, words) if path.parts[-3:-2] == (place.name,)}

    def keep(frame: FrameFiles) -> FrameFiles | None:
        """The frame if it is of the split, else None."""
        return frame if frame.name in stems else None

    return keep


SEVEN_SCENES = layout_of_folders(
    {"image": r"(frame-[^.]+)\.color.IMAGE", "gt": r"(frame-[^.]+)\.depth.png"},
    below="|seq-*/",
    marks=("frame-*.color.*",),
    name=_name_with_place("_"),
    calib="camera-intrinsics.txt",
    shared=FrameFiles(gt_scale=1000.0),
)

ARKITSCENES = layout_of_folders(
    {
        "image": "wide|color|lowres_wide/*.png",
        "sparse": "lowres_depth/*.png",
        "sparse_mask": "confidence/*.png?",
        "gt": "highres_depth/*.png?",
    },
    below="|*/|*/*/",
    name=_name_with_place("/"),
    shared=FrameFiles(sparse_scale=1000.0, gt_scale=1000.0, gt_other_size=True, one_view=True),
)

DIODE = layout_of_folders(
    {"gt": "*_depth.npy", "image": "*.png", "mask": "*_depth_mask.npy"},
    below="|*/|*/*/|*/*/*/|*/*/*/*/",
    marks=("*_depth_mask.npy", "*_depth.npy"),
)

ETH3D = layout_of_folders(
    {"image": "images/dslr_images/*.JPG", "gt": "ground_truth_depth/dslr_images/*.JPG"},
    below="|*/|*/*/",
    marks=("ground_truth_depth",),
    name=_name_with_place("/"),
)

IBIMS = layout_of_folders(
    {
        "image": "rgb/*.png",
        "gt": "depth/*.png",
        "mask": "mask_invalid/*.png?",
        "mask of transparent things": "mask_transp/*.png?",
    },
    marks=("mask_invalid", "mask_transp"),
    shared=FrameFiles(gt_scale=65535 / 50),
)

IMAGE_DEPTH = layout_of_folders(
    {"image": "image|images/**.IMAGE", "gt": "depth/**.DEPTH"}, calib="calib.txt"
)

KITTI_OBJECT = layout_of_folders(
    {"image": "image_2/*.IMAGE", "sparse": "velodyne/*.bin", "calib": "calib/*.txt"},
    below="|training/|testing/",
    name=_name_with_place("_"),
    shared=FrameFiles(camera=2),
)

PAIRS = layout_of_folders(
    {
        "image": "rgb/**.IMAGE",
        "sparse": "sparse/**.SPARSE",
        "gt": "gt/**.DEPTH?",
        "calib": "calib/**.CALIB?",
    },
    calib="calib.txt",
)

SCANNET = layout_of_folders(
    {"image": "color/*.IMAGE", "gt": "depth/*.png"},
    below="|*/|*/*/",
    marks=("intrinsic",),
    name=_name_with_place("/"),
    calib="intrinsic/intrinsic_color.txt",
    shared=FrameFiles(gt_scale=1000.0, gt_other_size=True),
)

VOID = layout_of_folders(
    {
        "image": "image/*.png",
        "sparse": "sparse_depth/*.png",
        "sparse_mask": "validity_map/*.png?",
        "gt": "ground_truth/*.png?",
    },
    below="|*/|data/*/|*/data/*/",
    marks=("sparse_depth", "ground_truth"),
    calib="K.txt",
    finish_of=_test_frames_of,
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
    """Returns the layout and the frames of a data set, and the files that belong to no frame.

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
        entries = [
            (folder, entry) for folder in folders for entry in LAYOUTS[layout].frames(folder)
        ]
    except OSError as error:  # pathlib's, of a folder that cannot be read
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{error.filename or root} cannot be read ({reason}); check it") from error
    # Frames of a folder in the root have its name before theirs.
    frames = list[FrameFiles]()
    unmatched = dict[Unmatched, None]()  # in their order, each once
    for folder, entry in entries:
        if isinstance(entry, tuple):  # a file of no frame, and why
            unmatched[entry] = None
        elif folder == root:
            frames.append(entry)
        else:
            frames.append(replace(entry, name=f"{folder.name}/{entry.name}"))
    for path, _ in unmatched:
        check_path(path)
    return DataSet(layout, frames, list(unmatched))


def _data_sets(root: Path, names: Sequence[str]) -> dict[Path, str]:
    """The name of the layout of the root, by its path; or else those of the folders in it.

    Args:
        root: The folder, or file.
        names: Names of the layouts that it may have, in the order in which they are tried.

    Raises:
        InputError: Neither the root nor a folder in it has one of these layouts.
    """
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
        layouts = dict[Path, str]()
        for folder in folders:
            matching = next((name for name in names if LAYOUTS[name].matches(folder)), None)
            if matching is not None:
                layouts[folder] = matching
        if layouts:
            return layouts
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
