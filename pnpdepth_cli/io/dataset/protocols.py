"""The part of a frame that the paper's experiments use: halved or not, and a crop of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import SizeError, UsageError


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """The part of a frame that is used."""

    name: str
    """One of `choices.FRAME_PROTOCOLS`."""
    halved: bool = False
    """Every second pixel in both directions (nearest neighbour) is used."""
    crop: tuple[int, int] | None = None
    """(H, W) of the crop after halving; None for the whole image."""
    anchor: Literal["centre", "bottom"] = "centre"
    """Vertical position of the crop, which is centred horizontally."""

    def apply(self, image: NDArray[Any]) -> NDArray[Any]:
        """Returns the part of an image (H, W) or (H, W, C). Raises SizeError if it is too small."""
        top, left, height, width = self._window((image.shape[0], image.shape[1]))
        # nearest neighbour at half the size: the pixel whose area holds the new pixel's centre
        small = image[1::2, 1::2] if self.halved else image
        return small[top : top + height, left : left + width]

    def in_crop(self, xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.float32]:
        """Returns pixel coordinates (N, 2) in that part, from those in the whole image."""
        top, left, _, _ = self._window(size)
        moved = (np.asarray(xy, np.float64) + 0.5) / 2 - 0.5 if self.halved else xy
        return np.asarray(moved - np.array([left, top]), np.float32)

    def intrinsics_in_crop(
        self, intrinsics: NDArray[np.float64], size: tuple[int, int]
    ) -> NDArray[np.float64]:
        """Returns the (3, 3) intrinsics of that part, from those of the whole image of (H, W)."""
        top, left, _, _ = self._window(size)
        result = np.array(intrinsics, np.float64)
        if self.halved:  # x becomes (x + 0.5) / 2 - 0.5
            result[:2] /= 2
            result[:2, 2] -= 0.25
        result[:2, 2] -= (left, top)
        return result

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
        # The benchmark scores all pixels with ground truth; its selection is cropped already.
        Protocol(name="kitti-depth"),
    )
}
"""The paper's protocols (Wang et al. 2019, section on data sets), and all of the frame."""


def find_protocol(name: str) -> Protocol:
    """Returns the protocol of this name. Raises UsageError if there is none."""
    if name not in PROTOCOLS:
        raise UsageError(f"no protocol {name!r}; there are {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]
