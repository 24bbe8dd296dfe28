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
        folders = _data_sets(root, [*LAYOUTS] if name is None else [name])
        layouts = sorted({*folders.values()})
        if len(layouts) > 1:
            raise InputError(
                f"{root} holds folders of several layouts ({', '.join(layouts)}); give one of them,"
                " or name the layout"
            )
        found = [(path, each) for path in folders for each in LAYOUTS[layouts[0]].frames(path)]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{error.filename or root} cannot be read ({reason}); check it") from error
    frames = [
        each if folder == root else replace(each, name=f"{folder.name}/{each.name}")
        for folder, each in found
        if isinstance(each, FrameFiles)
    ]
    lost = dict.fromkeys(each for _, each in found if isinstance(each, tuple))
    for path, _ in lost:
        check_path(path)
    return layouts[0], frames, list(lost)


def _data_sets(root: Path, names: Sequence[str]) -> dict[Path, str]:
    """The layout of the folder, or else of those in it, by their paths; at least one."""
    if not root.exists():
        raise InputError(f"{root}: no such folder; check the path")
    if root.suffix.lower() == ".r3d":
        raise InputError(
            f"{root}: the depth in it is compressed with LZFSE, which is not read; export 'EXR +"
            " RGB' in Record3D, and give the folder EXR_RGBD"
        )
    inside = sorted(root.iterdir()) if root.is_dir() else []
    below = [path for path in inside if path.is_dir() and not path.name.startswith(".")]
    for folders in ([root], below):
        layouts = {p: next((n for n in names if LAYOUTS[n].matches(p)), None) for p in folders}
        if found := {path: name for path, name in layouts.items() if name is not None}:
            return found
    if root.is_file():
        raise InputError(
            f"{root} is one file; give a folder, a CSV list of frames or a bag, or refine one image"
        )
    if len(names) == 1 and (lacked := LAYOUTS[names[0]].lacks(root)):
        raise InputError("{} has no {}, which {} needs; add it".format(*lacked, names[0]))
    raise InputError(
        f"{root} does not look like {', '.join(names)}, whose folders docs/guides/many-frames.md"
        " lists, and --layout NAME says what is missing; put images into rgb/ and their sparse"
        " depth into sparse/, with equal names, or give a CSV list with columns image and sparse"
    )
