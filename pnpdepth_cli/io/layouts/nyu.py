"""NYU Depth v2: `nyu-h5`, one .h5 a frame as Ma et al. have it, and `nyu-mat`, the official file.

Ma et al. have KITTI odometry in .h5 files too, the scan on its pixels as depth; what is as wide as
that is cut as the paper cuts KITTI. nyu-mat is nyu_depth_v2_labeled.mat; a splits.mat (testNdxs),
or a test.txt with the numbers from 1 of its frames, beside it says which are the test set. Without
one, all frames are meant.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts.frame import Frame, Hdf5Array, Listing
from pnpdepth_cli.io.layouts.hdf5 import shape_of
from pnpdepth_cli.io.layouts.protocols import PROTOCOLS, Protocol

_WIDEST_KINECT = 1000  # pixels; NYU's frames have 640, KITTI's 1224 or more
_LABELED = "nyu_depth_v2_labeled.mat"


def h5_matches(root: Path) -> bool:
    """True if .h5 files are in the folder or at most two below it."""
    return bool(_h5_files(root))


def h5_listing(root: Path) -> Listing:
    """One frame a file, with rgb (3, H, W) and depth (H, W) in it."""
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


def mat_matches(root: Path) -> bool:
    """True for the official file, or a folder with it."""
    return _labeled(root).is_file()


def mat_listing(root: Path) -> Listing:
    """The frames of the split beside the file, or all of them; numbered from 1 as there."""
    path = _labeled(root)
    count = shape_of(path, "depths")[0]
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


def _h5_files(root: Path) -> list[Path]:
    return sorted(p for start in ("", "*/", "*/*/") for p in root.glob(f"{start}*.h5"))


def _protocol_of(files: list[Path]) -> Protocol:
    """What the first file that can be read asks for."""
    for path in files:
        try:
            width = shape_of(path, "depth")[-1]
        except FileFormatError:
            continue  # it is named when it is its turn
        return PROTOCOLS["kitti-odometry" if width > _WIDEST_KINECT else "nyu"]
    return PROTOCOLS["nyu"]


def _labeled(root: Path) -> Path:
    return root if root.name == _LABELED else root / _LABELED


def _split(folder: Path, count: int) -> list[int]:
    """The numbers of the test set, sorted; empty if there is no file that says them."""
    text, matlab = folder / "test.txt", folder / "splits.mat"
    if text.is_file():
        source = text
        words: Any = read_bytes(text).decode("utf-8", "replace").split()
    elif matlab.is_file():
        source, words = matlab, _test_numbers(matlab)
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


def _test_numbers(path: Path) -> Any:
    from scipy.io import loadmat

    try:
        return loadmat(path, variable_names=["testNdxs"])["testNdxs"].ravel().tolist()
    except Exception as error:  # scipy raises many kinds for a damaged file
        raise FileFormatError(f"{path} has no testNdxs ({one_line(error)})") from error
