"""What of a frame the paper's experiments use: halved or not, and a window of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import SizeError, UsageError


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """halved: every second pixel in both directions (nearest neighbour). crop: (H, W) of a window
    in the middle, or at the bottom and in the middle across; None for all of it.
    """

    name: str
    halved: bool = False
    crop: tuple[int, int] | None = None
    anchor: Literal["centre", "bottom"] = "centre"

    def apply(self, picture: NDArray[Any]) -> NDArray[Any]:
        """The part of a picture (H, W) or (H, W, C) that counts. SizeError if it is too small."""
        top, left, height, width = self._window((picture.shape[0], picture.shape[1]))
        # nearest neighbour at half the size: the pixel whose area holds the new pixel's centre
        small = picture[1::2, 1::2] if self.halved else picture
        return small[top : top + height, left : left + width]

    def in_crop(self, xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.float32]:
        """Where the pixel coordinates (N, 2) of a picture of `size` (H, W) are in that part."""
        top, left, _, _ = self._window(size)
        moved = (np.asarray(xy, np.float64) + 0.5) / 2 - 0.5 if self.halved else xy
        return np.asarray(moved - np.array([left, top]), np.float32)

    def _window(self, size: tuple[int, int]) -> tuple[int, int, int, int]:
        """(top, left, height, width) after halving."""
        height, width = (side // 2 for side in size) if self.halved else size
        if self.crop is None:
            return 0, 0, height, width
        rows, columns = self.crop
        if rows > height or columns > width:
            raise SizeError(
                f"protocol {self.name!r} needs {columns}×{rows} pixels but the frame has"
                f" {width}×{height}{' after halving' if self.halved else ''}"
            )
        top = height - rows if self.anchor == "bottom" else (height - rows) // 2
        return top, (width - columns) // 2, rows, columns


WHOLE = Protocol(name="whole")

PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        WHOLE,
        Protocol(name="nyu", halved=True, crop=(228, 304)),
        Protocol(name="kitti-odometry", crop=(228, 912), anchor="bottom"),
        # The benchmark scores all pixels with truth; its selection is cropped already.
        Protocol(name="kitti-depth"),
    )
}
"""The paper's protocols (Wang et al. 2019, section on data sets), and all of the frame."""


def find_protocol(name: str) -> Protocol:
    """The protocol of this name. UsageError if there is none."""
    if name not in PROTOCOLS:
        raise UsageError(f"no protocol {name!r}; there are {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]
