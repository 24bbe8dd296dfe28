"""Data sets whose frames are found by the names of folders and files: a row each.

`7scenes`: frame-000000.color.png and frame-000000.depth.png, in the folder or in its seq-*/.
`arkitscenes`: the upsampling set, <video>/ with wide/ (color/, lowres_wide/), the phone's
lowres_depth/ with confidence/, and the laser scanner's highres_depth/, in millimetres.
`diode`: NAME.png, NAME_depth.npy in metres and NAME_depth_mask.npy in <scene>/<scan>/.
`ibims`: iBims-1 as images: rgb/ depth/ mask_invalid/ mask_transp/; a depth of 65535 is 50 m.
`image-depth`: image/ (or images/) and depth/, ground truth; a calib.txt beside them is of all.
`kitti-object`: image_2/ velodyne/ calib/, in training/ or testing/.
`nyu-h5`: one .h5 file a frame, as Ma et al. distribute NYU Depth v2 and KITTI odometry. Files as
wide as KITTI's hold the projected scan as depth, and are cropped as the paper crops KITTI.
`pairs`: rgb/ and sparse/, and optionally gt/ and calib/, with files of the same stems. Folders in
them are searched too: rgb/drive_1/000.png belongs to sparse/drive_1/000.png. calib/ has one file
per frame; a calib.txt beside the folders applies to all.
`scannet`: exported scans, color/ depth/ intrinsic/ in one or more scene*/; depth in millimetres,
smaller than the images.
`void`: <sequence>/ with image/ sparse_depth/ validity_map/ ground_truth/ and K.txt, below a
sequence, data/, a density or the release; where test_image.txt lists the test split, only its
frames.

And `nyu-mat`: nyu_depth_v2_labeled.mat, the official file of NYU Depth v2. A test.txt beside it,
with the numbers of its frames from 1, names the test set, else all are meant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.dataset.arrays import shape_of
from pnpdepth_cli.dataset.frame_files import FrameFiles, Hdf5Array, RawDepth
from pnpdepth_cli.dataset.layouts.layout import Layout, row
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.protocols import NYU_PART, ODOMETRY_PART

_WIDEST_KINECT = 1000  # pixels; NYU's frames have 640, KITTI's 1224 or more
_LABELED = "nyu_depth_v2_labeled.mat"
_MOST_FRAMES = 100_000
"""The official file of NYU has 1,449."""


def _prefix_with_place(mark: str) -> Callable[[Path, Path, str], str]:
    """A function that puts the place's name and a mark before the stem, if it is not the root."""
    return lambda root, place, stem: stem if place == root else f"{place.name}{mark}{stem}"


def _below(root: Path, place: Path, stem: str) -> str:
    return (place.relative_to(root) / stem).as_posix()


def _of_void(place: Path) -> Callable[[FrameFiles], FrameFiles | None]:
    """Keeps the frames of the test split, or all where no split is listed."""
    split = place.parent.parent / "test_image.txt"
    if place.parent.name != "data" or not split.is_file():
        return replace
    words = read_bytes(split).decode("utf-8", "replace").split()
    wanted = {path.stem for path in map(Path, words) if path.parts[-3:-2] == (place.name,)}
    return lambda frame: frame if frame.name in wanted else None


def _raw_truth(place: Path) -> Callable[[FrameFiles], FrameFiles]:
    def with_raw(frame: FrameFiles) -> FrameFiles:
        assert isinstance(frame.gt, Path)
        assert isinstance(frame.image, Path)
        return replace(frame, gt=RawDepth(path=frame.gt, image=frame.image))

    return with_raw


def _of_h5(place: Path) -> Callable[[FrameFiles], FrameFiles]:
    """The arrays rgb (3, H, W) and depth (H, W); the protocol for the width of the first file."""
    part = NYU_PART
    for path in sorted(place.glob("*.h5")):
        with suppress(FileFormatError):  # it is reported when the frame is read
            if shape_of(path, "depth")[-1] > _WIDEST_KINECT:
                part = ODOMETRY_PART
            break

    def arrays_of(frame: FrameFiles) -> FrameFiles:
        assert isinstance(frame.gt, Path)
        rgb = Hdf5Array(path=frame.gt, name="rgb", axes=(1, 2, 0))
        depth = Hdf5Array(path=frame.gt, name="depth", axes=(0, 1))
        return replace(frame, image=rgb, gt=depth, part=part)

    return arrays_of


ROWS: dict[str, Layout] = {
    "7scenes": row(
        {"image": r"(frame-[^.]+)\.color.IMAGE", "gt": r"(frame-[^.]+)\.depth.png"},
        below="|seq-*/",
        marks=("frame-*.color.*",),
        name=_prefix_with_place("_"),
        calib="camera-intrinsics.txt",
        gt_scale=1000.0,
    ),
    "arkitscenes": row(
        {
            "image": "wide|color|lowres_wide/*.png",
            "sparse": "lowres_depth/*.png",
            "sparse_mask": "confidence/*.png?",
            "gt": "highres_depth/*.png?",
        },
        below="|*/|*/*/",
        name=_prefix_with_place("/"),
        sparse_scale=1000.0,
        gt_scale=1000.0,
        gt_other_size=True,
        one_view=True,
    ),
    "diode": row(
        {"gt": "*_depth.npy", "image": "*.png", "mask": "*_depth_mask.npy"},
        below="|*/|*/*/|*/*/*/|*/*/*/*/",
        marks=("*_depth_mask.npy", "*_depth.npy"),
        name=_below,
    ),
    "eth3d": row(
        {"image": "images/dslr_images/*.JPG", "gt": "ground_truth_depth/dslr_images/*.JPG"},
        below="|*/|*/*/",
        marks=("ground_truth_depth",),
        name=_prefix_with_place("/"),
        more=_raw_truth,
    ),
    "ibims": row(
        {
            "image": "rgb/*.png",
            "gt": "depth/*.png",
            "mask": "mask_invalid/*.png?",
            "mask of transparent things": "mask_transp/*.png?",
        },
        marks=("mask_invalid", "mask_transp"),
        name=_below,
        gt_scale=65535 / 50,
    ),
    "image-depth": row(
        {"image": "image|images/**.IMAGE", "gt": "depth/**.DEPTH"},
        name=_below,
        calib="calib.txt",
    ),
    "kitti-object": row(
        {"image": "image_2/*.IMAGE", "sparse": "velodyne/*.bin", "calib": "calib/*.txt"},
        below="|training/|testing/",
        name=_prefix_with_place("_"),
        camera=2,
    ),
    "nyu-h5": row(
        {"gt": "*.h5"},
        below="|*/|*/*/",
        marks=("*.h5",),
        name=lambda root, place, stem: "_".join((*place.relative_to(root).parts, stem)),
        more=_of_h5,
    ),
    "pairs": row(
        {
            "image": "rgb/**.IMAGE",
            "sparse": "sparse/**.SPARSE",
            "gt": "gt/**.DEPTH?",
            "calib": "calib/**.CALIB?",
        },
        name=_below,
        calib="calib.txt",
    ),
    "scannet": row(
        {"image": "color/*.IMAGE", "gt": "depth/*.png"},
        below="|*/|*/*/",
        marks=("intrinsic",),
        name=_prefix_with_place("/"),
        calib="intrinsic/intrinsic_color.txt",
        gt_scale=1000.0,
        gt_other_size=True,
    ),
    "void": row(
        {
            "image": "image/*.png",
            "sparse": "sparse_depth/*.png",
            "sparse_mask": "validity_map/*.png?",
            "gt": "ground_truth/*.png?",
        },
        below="|*/|data/*/|*/data/*/",
        marks=("sparse_depth", "ground_truth"),
        name=_below,
        calib="K.txt",
        more=_of_void,
        sparse_scale=256.0,
        gt_scale=256.0,
        one_view=True,
    ),
}


def _labelled(root: Path) -> Path:
    return root if root.name == _LABELED else root / _LABELED


def _of_mat(root: Path) -> Iterator[FrameFiles]:
    """The frames of the test set, or all without a split; numbered from 1."""
    path = _labelled(root)
    count = shape_of(path, "depths")[0]
    if count > _MOST_FRAMES:
        raise FileFormatError(f"{path} claims {count:,} frames; the official file has 1,449")
    for number in _split(path.parent, count) or range(1, count + 1):
        yield FrameFiles(
            name=f"{number:04}",
            image=Hdf5Array(path=path, name="images", axes=(2, 1, 0), index=number - 1),
            gt=Hdf5Array(path=path, name="depths", axes=(1, 0), index=number - 1),
            one_view=True,
            part=NYU_PART,
        )


def _split(folder: Path, count: int) -> list[int]:
    """The numbers of the test set, sorted; empty without a file of them."""
    source, of_matlab = folder / "test.txt", folder / "splits.mat"
    if not source.is_file():
        if of_matlab.is_file():
            raise InputError(
                f"{of_matlab} is not read; write the numbers of its testNdxs into {source}:"
                " print(*scipy.io.loadmat('splits.mat')['testNdxs'].ravel())"
            )
        return []
    words = read_bytes(source).decode("utf-8", "replace").split()
    try:
        numbers = sorted({int(word) for word in words})
    except ValueError as error:
        raise FileFormatError(
            f"{source} is not a list of frame numbers: {one_line(error)}"
        ) from error
    if not numbers or not 1 <= numbers[0] <= numbers[-1] <= count:
        raise FileFormatError(f"{source}: frame numbers must be from 1 to {count:,}")
    return numbers


NYU_MAT = Layout(matches=lambda root: _labelled(root).is_file(), frames=_of_mat, needs=(_LABELED,))
