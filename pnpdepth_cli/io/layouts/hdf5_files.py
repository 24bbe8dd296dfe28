"""NYU Depth v2 in HDF5 and MATLAB files.

`nyu-h5`: one .h5 file a frame, as Ma et al. distribute NYU Depth v2 and KITTI odometry. Files as
wide as KITTI's hold the projected scan as depth, and are cropped as the paper crops KITTI.

`nyu-mat`: nyu_depth_v2_labeled.mat, the official file of NYU Depth v2. A splits.mat (testNdxs), or
a test.txt with the numbers of its frames from 1, beside it names the test set, else all are meant.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset.frame import Frame, Hdf5Array, Listing
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS, Protocol
from pnpdepth_cli.io.dataset.reading import read_matlab_array, shape_of
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts.layout import Layout

_WIDEST_KINECT = 1000  # pixels; NYU's frames have 640, KITTI's 1224 or more
_LABELED = "nyu_depth_v2_labeled.mat"
_MOST_FRAMES = 100_000
"""The official file of NYU has 1,449."""


def _h5_files(root: Path) -> list[Path]:
    return sorted(p for start in ("", "*/", "*/*/") for p in root.glob(f"{start}*.h5"))


def _h5_listing(root: Path) -> Listing:
    """One frame per file, with rgb (3, H, W) and depth (H, W) in it."""
    files = _h5_files(root)
    protocol = _protocol_of(files)
    frames = [
        Frame(
            name="_".join(path.relative_to(root).with_suffix("").parts),
            image=Hdf5Array(path=path, name="rgb", axes=(1, 2, 0)),
            gt=Hdf5Array(path=path, name="depth", axes=(0, 1)),
            protocol=protocol,
        )
        for path in files
    ]
    return Listing(frames=frames)


def _protocol_of(files: list[Path]) -> Protocol:
    """The protocol for the width of the first file that can be read."""
    for path in files:
        try:
            width = shape_of(path, "depth")[-1]
        except FileFormatError:
            continue  # it is reported when the frame is read
        return PROTOCOLS["kitti-odometry" if width > _WIDEST_KINECT else "nyu"]
    return PROTOCOLS["nyu"]


NYU_H5 = Layout(matches=lambda root: bool(_h5_files(root)), listing=_h5_listing, needs=("*.h5",))


def _labeled(root: Path) -> Path:
    return root if root.name == _LABELED else root / _LABELED


def _mat_listing(root: Path) -> Listing:
    """The frames of the test set, or all without a split; numbered from 1."""
    path = _labeled(root)
    count = shape_of(path, "depths")[0]
    if count > _MOST_FRAMES:
        raise FileFormatError(f"{path} claims {count:,} frames; the official file has 1,449")
    frames = [
        Frame(
            name=f"{number:04}",
            image=Hdf5Array(path=path, name="images", axes=(2, 1, 0), index=number - 1),
            gt=Hdf5Array(path=path, name="depths", axes=(1, 0), index=number - 1),
            protocol=PROTOCOLS["nyu"],
        )
        for number in _split(path.parent, count) or range(1, count + 1)
    ]
    return Listing(frames=frames)


def _split(folder: Path, count: int) -> list[int]:
    """The numbers of the test set, sorted; empty without a file of them."""
    text, source = folder / "test.txt", folder / "splits.mat"
    words: Any
    if text.is_file():
        source, words = text, read_bytes(text).decode("utf-8", "replace").split()
    elif source.is_file():
        words = read_matlab_array(source, "testNdxs")[:_MOST_FRAMES]
    else:
        return []
    try:
        numbers = sorted({int(word) for word in words})
    except ValueError as error:
        raise FileFormatError(
            f"{source} is not a list of frame numbers: {one_line(error)}"
        ) from error
    if not numbers or not 1 <= numbers[0] <= numbers[-1] <= count:
        raise FileFormatError(f"{source}: frame numbers must be from 1 to {count:,}")
    return numbers


NYU_MAT = Layout(
    matches=lambda root: _labeled(root).is_file(), listing=_mat_listing, needs=(_LABELED,)
)
