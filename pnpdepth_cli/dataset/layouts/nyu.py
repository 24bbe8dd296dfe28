"""NYU Depth v2 in HDF5 and MATLAB files.

`nyu-h5`: one .h5 file a frame, as Ma et al. distribute NYU Depth v2 and KITTI odometry. Files as
wide as KITTI's hold the projected scan as depth, and are cropped as the paper crops KITTI.

`nyu-mat`: nyu_depth_v2_labeled.mat, the official file of NYU Depth v2. A
test.txt beside it, with the numbers of its frames from 1, names the test set, else all are meant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.dataset.arrays import shape_of
from pnpdepth_cli.dataset.frame_files import FrameFiles, Hdf5Array
from pnpdepth_cli.dataset.layouts.layout import Layout, row
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.protocols import NYU_PART, ODOMETRY_PART

_WIDEST_KINECT = 1000  # pixels; NYU's frames have 640, KITTI's 1224 or more
_LABELED = "nyu_depth_v2_labeled.mat"
_MOST_FRAMES = 100_000
"""The official file of NYU has 1,449."""


def _of_folder(place: Path) -> Callable[[FrameFiles], FrameFiles]:
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


H5 = row(
    {"gt": "*.h5"},
    below="|*/|*/*/",
    marks=("*.h5",),
    name=lambda root, place, stem: "_".join((*place.relative_to(root).parts, stem)),
    more=_of_folder,
)


def _labeled(root: Path) -> Path:
    return root if root.name == _LABELED else root / _LABELED


def _of_mat(root: Path) -> Iterator[FrameFiles]:
    """The frames of the test set, or all without a split; numbered from 1."""
    path = _labeled(root)
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


MAT = Layout(matches=lambda root: _labeled(root).is_file(), frames=_of_mat, needs=(_LABELED,))
