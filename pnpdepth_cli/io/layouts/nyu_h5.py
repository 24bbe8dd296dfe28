"""`nyu-h5`: one .h5 file a frame, as Ma et al. distribute NYU Depth v2 and KITTI odometry.

Files as wide as KITTI's hold the projected scan as depth, and are cropped as the paper crops KITTI.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset.frame import Frame, Hdf5Array, Listing
from pnpdepth_cli.io.dataset.hdf5 import shape_of
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS, Protocol
from pnpdepth_cli.io.layouts import Layout

_WIDEST_KINECT = 1000  # pixels; NYU's frames have 640, KITTI's 1224 or more


def matches(root: Path) -> bool:
    """Returns whether .h5 files are in the folder or at most two levels below."""
    return bool(_h5_files(root))


def listing(root: Path) -> Listing:
    """Returns one frame per file, with rgb (3, H, W) and depth (H, W) in it."""
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


def _h5_files(root: Path) -> list[Path]:
    return sorted(p for start in ("", "*/", "*/*/") for p in root.glob(f"{start}*.h5"))


def _protocol_of(files: list[Path]) -> Protocol:
    """The protocol for the width of the first file that can be read."""
    for path in files:
        try:
            width = shape_of(path, "depth")[-1]
        except FileFormatError:
            continue  # it is reported when the frame is read
        return PROTOCOLS["kitti-odometry" if width > _WIDEST_KINECT else "nyu"]
    return PROTOCOLS["nyu"]


LAYOUT = Layout(matches=matches, listing=listing, needs=("*.h5",))
