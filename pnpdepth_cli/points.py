"""Sparse depth as points: pixel coordinates and depths, never a resampled image.

Files and sensors give numpy arrays; `core` and everything above it work on torch tensors, which
`SparsePoints.tensors` makes of them. Importing this module imports neither library.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Generic, overload

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray
    from scipy.spatial import cKDTree
    from torch import Tensor
    from typing_extensions import TypeVar

    A = TypeVar("A", Tensor, NDArray[np.float32], default=Tensor)
else:
    from typing import TypeVar

    A = TypeVar("A")

Size = tuple[int, int]
"""(height, width) of an image or a frame in pixels."""

METRES, MODEL_UNITS = "m", "model units"
"""Units of depth: metres, and those of a COLMAP model whose scale is not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SparsePoints(Generic[A]):
    """N measured depths at pixel coordinates of a frame, as tensors unless stated otherwise.

    Two sets of points are equal only if they are one object: arrays have no truth value.
    """

    xy: A
    """(N, 2) float32 pixel coordinates, x right, y down, whole numbers at pixel centres."""
    depth: A
    """(N,) float32 metres, all finite and positive."""
    size: tuple[int, int]
    """(height, width) of the frame."""
    dropped: Mapping[str, int] = field(default_factory=dict)
    """How many points were dropped when a sensor made these, by reason, in the order of steps."""

    def __len__(self) -> int:
        return len(self.depth)

    def __repr__(self) -> str:
        height, width = self.size
        return f"SparsePoints({width}×{height}, {len(self):,} points)"

    @functools.cached_property
    def tree(self: SparsePoints[Tensor]) -> cKDTree:
        """The k-d tree of the pixel coordinates, which finds nearest points; kept once made."""
        from scipy.spatial import cKDTree

        return cKDTree(self.xy.cpu().double().numpy())

    def resized(self, height: int, width: int) -> SparsePoints[A]:
        """Returns the points in a frame of the same field of view with height × width pixels.

        Coordinates scale with the pixel areas (half-pixel convention); depths do not change.
        """
        if (height, width) == self.size:
            return self
        xy = self.xy + 0.5
        xy[:, 0] *= width / self.size[1]
        xy[:, 1] *= height / self.size[0]
        return replace(self, xy=xy - 0.5, size=(height, width))

    def cropped(self, top: int, left: int, height: int, width: int) -> SparsePoints[A]:
        """Returns the points inside a crop of the frame, in the crop's coordinates, with its size.

        The crop is `height` rows from row `top`, and `width` columns from column `left`.
        """
        xy = self.xy + 0.0  # a copy, in either library
        xy[:, 0] -= left
        xy[:, 1] -= top
        moved = replace(self, xy=xy, size=(height, width))
        return moved.select(in_frame(xy, moved.size))

    def mirrored(self: SparsePoints[Tensor]) -> SparsePoints[Tensor]:
        """Returns the points with left and right of the frame exchanged."""
        import torch

        # Columns are 0 … W − 1, so x becomes W − 1 − x.
        x, y = self.xy.unbind(dim=1)
        return replace(self, xy=torch.stack([self.size[1] - 1 - x, y], dim=1))

    def where(self, mask: Tensor | NDArray[np.bool_]) -> SparsePoints[A]:
        """Returns the points where mask, (N,) bool, is true; this very object if all of it is true.

        So what is kept of the object, such as its tree, is not computed again.
        """
        return self if bool(mask.all()) else self.select(mask)

    def select(self, mask: Tensor | NDArray[np.bool_] | slice) -> SparsePoints[A]:
        """Returns some of the points: where a mask is true, or those of a slice or of numbers.

        Args:
            mask: (N,) bool, or (M,) numbers of points, of the points' library; or a slice.
        """
        return replace(self, xy=self.xy[mask], depth=self.depth[mask])

    def joined(self: SparsePoints[Tensor], others: SparsePoints[Tensor]) -> SparsePoints[Tensor]:
        """Returns these points followed by others of the same frame."""
        import torch

        return replace(
            self,
            xy=torch.cat([self.xy, others.xy]),
            depth=torch.cat([self.depth, others.depth]),
        )

    def tensors(self, device: torch.device | str = "cpu") -> SparsePoints[Tensor]:
        """Returns the points as tensors on the device; arrays already there are not copied."""
        import torch

        xy, depth = (torch.as_tensor(array, device=device) for array in (self.xy, self.depth))
        if xy is self.xy and depth is self.depth:
            return self  # type: ignore[return-value]
        return SparsePoints(xy=xy, depth=depth, size=self.size, dropped=self.dropped)

    def known_in(self: SparsePoints[Tensor], depth: Tensor) -> Tensor:
        """Returns (N,) bool, whether all pixels that `sample` reads a point from are known.

        Args:
            depth: (h, w), 0 = unknown, of the same field of view.
        """
        # The interpolation weight of known pixels: 1, but for rounding, where all are known.
        known_weight = self.sample((depth > 0).float())
        return known_weight > 0.999

    def sample(self: SparsePoints[Tensor], dense: Tensor) -> Tensor:
        """Returns the values (N,) of a dense map at the points, differentiable in `dense`.

        Plain indexing where all points lie on the map's grid, bilinear interpolation otherwise.
        Beyond the outermost pixel centres the border value holds.

        Args:
            dense: (…, h, w), one map of the same field of view, on the device of the points.

        Raises:
            ValueError: There are several maps.
        """
        height, width = dense.shape[-2:]
        xy = self.resized(height, width).xy
        flat = dense.reshape(-1)
        if flat.numel() != height * width:
            raise ValueError(f"one map is expected, not shape {tuple(dense.shape)}")
        x = xy[:, 0].clamp(0, width - 1)
        y = xy[:, 1].clamp(0, height - 1)
        left = x.floor().long()
        top = y.floor().long()
        from_left = x - left
        from_top = y - top
        # Whole coordinates need no interpolation.
        if not bool((from_left != 0).any()) and not bool((from_top != 0).any()):
            return flat[top * width + left]
        # `ceil` instead of + 1: on the grid both neighbours are the same pixel. The next one would
        # have weight 0, but may be infinite, and 0 · inf is NaN.
        right = x.ceil().long()
        bottom = y.ceil().long()
        top_left = flat[top * width + left]
        top_right = flat[top * width + right]
        bottom_left = flat[bottom * width + left]
        bottom_right = flat[bottom * width + right]
        upper = top_left * (1 - from_left) + top_right * from_left
        lower = bottom_left * (1 - from_left) + bottom_right * from_left
        return upper * (1 - from_top) + lower * from_top

    def scatter(self: SparsePoints[Tensor]) -> Tensor:
        """Returns (1, 1, H, W) metres, 0 = unknown: each point on its pixel, the nearest wins."""
        height, width = self.size
        # Resizing may round a point onto the right or bottom edge of the frame.
        inside = in_frame(self.xy, self.size, closed=True)
        column = self.xy[:, 0].round().clamp(0, width - 1).long()
        row = self.xy[:, 1].round().clamp(0, height - 1).long()
        flat = self.depth.new_full((height * width,), math.inf)
        pixel = row * width + column  # row-major
        flat.scatter_reduce_(0, pixel[inside], self.depth[inside], "amin")
        return flat.masked_fill(flat.isinf(), 0.0).reshape(1, 1, height, width)


@overload
def in_frame(xy: Tensor, size: Size, *, closed: bool = ...) -> Tensor: ...
@overload
def in_frame(xy: NDArray[np.floating], size: Size, *, closed: bool = ...) -> NDArray[np.bool_]: ...
def in_frame(xy: Any, size: Size, *, closed: bool = False) -> Any:
    """Returns (N,) true where a coordinate lies in a pixel of the frame; false for NaN.

    Args:
        xy: (N, 2) pixel coordinates.
        size: (height, width) of the frame.
        closed: Whether the right and bottom edges of the frame belong to it, as the others do.
    """
    # Pixels reach half a pixel to each side of their centres.
    x, y = xy[:, 0], xy[:, 1]
    right = size[1] - 0.5
    bottom = size[0] - 0.5
    is_after_begin = (x >= -0.5) & (y >= -0.5)
    if closed:
        return is_after_begin & (x <= right) & (y <= bottom)
    return is_after_begin & (x < right) & (y < bottom)
