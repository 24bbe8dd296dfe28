"""`nyu-mat`: nyu_depth_v2_labeled.mat, the official file of NYU Depth v2.

A splits.mat (testNdxs), or a test.txt with the numbers of its frames from 1, beside it names the
test set. Without one, all frames are meant.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset.frame import Frame, Hdf5Array, Listing
from pnpdepth_cli.io.dataset.hdf5 import shape_of
from pnpdepth_cli.io.dataset.matlab import read_matlab_array
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts import Layout

_LABELED = "nyu_depth_v2_labeled.mat"
_MOST_FRAMES = 100_000
"""The official file has 1,449."""


def matches(root: Path) -> bool:
    """Returns whether this is the official file, or a folder with it."""
    return _labeled(root).is_file()


def listing(root: Path) -> Listing:
    """Returns the frames of the test set, or all without a split; numbered from 1."""
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


def _labeled(root: Path) -> Path:
    return root if root.name == _LABELED else root / _LABELED


def _split(folder: Path, count: int) -> list[int]:
    """The numbers of the test set, sorted; empty without a file of them."""
    text, matlab = folder / "test.txt", folder / "splits.mat"
    if text.is_file():
        source = text
        words: Any = read_bytes(text).decode("utf-8", "replace").split()
    elif matlab.is_file():
        source, words = matlab, read_matlab_array(matlab, "testNdxs")[:_MOST_FRAMES]
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


LAYOUT = Layout(matches=matches, listing=listing, needs=("nyu_depth_v2_labeled.mat",))
