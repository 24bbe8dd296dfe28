"""Between pixels of the image and of the network. Depth values of points are never touched."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.models.definition import Fixed, Multiple, Near
from pnpdepth_cli.points import SparsePoints

_SYNTHETIC_POINTS = 500

_ROUNDING = 1e-4
"""Error of the sum of interpolation weights, which is 1 where all pixels are known."""


@dataclass(frozen=True, kw_only=True)
class FrameMap:
    """How an image gets into a network: crop a box, resize it, pad right and bottom."""

    image: tuple[int, int]
    """(H, W) of the image."""
    crop: tuple[int, int, int, int]
    """(top, left, height, width) of the box in the image."""
    resized: tuple[int, int]
    """(height, width) of the box once it is resized."""
    network: tuple[int, int]
    """(h, w) of the network's input, the resized box with padding."""

    @classmethod
    def fit(cls, size: Fixed | Multiple | Near, height: int, width: int) -> FrameMap:
        """Returns the map for an image into a network that takes these sizes.

        Args:
            size: Image sizes that the network takes.
            height: Rows of the image.
            width: Columns of the image.
        """
        image = (height, width)
        crop = (0, 0, height, width)
        if isinstance(size, Multiple):
            resized = _shrink(image, size.longest)
            network = (_multiple_above(resized[0], size.of), _multiple_above(resized[1], size.of))
        elif isinstance(size, Near):
            resized = network = _size_near(size, image)
        else:
            resized = network = (size.height, size.width)
            if size.fit == "crop":
                crop = _largest_crop(image, aspect_of=network)
        return cls(image=image, crop=crop, resized=resized, network=network)

    def rgb_to_network(self, rgb: Tensor) -> Tensor:
        """Returns an image (1, 3, H, W) as (1, 3, h, w), antialiased where it shrinks.

        Edge pixels are repeated in the padding.
        """
        image = _resize(self._cropped(rgb), self.resized, antialias=True)
        return F.pad(image, self._padding, mode="replicate") if any(self._padding) else image

    def prior_to_network(self, depth: Tensor) -> Tensor:
        """Returns dense depth (1, 1, H, W), 0 = unknown, as (1, 1, h, w); the padding is unknown.

        A pixel is known where everything that it is interpolated from is.
        """
        depth = self._cropped(depth)
        known_weight = _resize((depth > 0).to(depth.dtype), self.resized)
        is_known = known_weight > 1 - _ROUNDING
        depth = _resize(depth, self.resized)
        return F.pad(torch.where(is_known, depth, 0.0), self._padding)

    def _cropped(self, image: Tensor) -> Tensor:
        """Returns the box of an image (…, H, W)."""
        top, left, height, width = self.crop
        return image[..., top : top + height, left : left + width]

    @property
    def _padding(self) -> tuple[int, int, int, int]:
        """Pixels at the left, right, top and bottom of the resized box, as F.pad takes them."""
        return 0, self.network[1] - self.resized[1], 0, self.network[0] - self.resized[0]

    def points_to_network(self, points: SparsePoints) -> SparsePoints:
        """Returns the points inside the crop, at pixel coordinates of the network."""
        resized = points.cropped(*self.crop).resized(*self.resized)
        # Padding at the right and the bottom moves no coordinates.
        return SparsePoints(xy=resized.xy, depth=resized.depth, size=self.network)

    def intrinsics_to_network(self, camera: Camera) -> Tensor:
        """Returns the matrix (1, 3, 3) of the image's camera, in pixels of the network."""
        top, left, height, width = self.crop
        moved = camera.intrinsics - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])
        resized = Camera(intrinsics=moved, size=(height, width)).resized(*self.resized)
        return torch.from_numpy(resized.intrinsics)[None].float()

    def depth_to_image(self, depth: Tensor) -> Tensor:
        """Returns the network's depth (1, 1, h', w') as (H, W) of the image, 0 outside the crop.

        Its size may differ from the input's, but its field of view is that of the whole input.
        """
        if any(self._padding):
            depth = _resize(depth, self.network)
            depth = depth[..., : self.resized[0], : self.resized[1]]
        top, left, height, width = self.crop
        depth = _resize(depth, (height, width))
        image = depth.new_zeros(self.image)
        image[top : top + height, left : left + width] = depth[0, 0]
        return image


def _shrink(image: tuple[int, int], longest: int | None) -> tuple[int, int]:
    """Returns (height, width) with no side longer than `longest`, in about the image's aspect.

    The image's own size if `longest` is None.
    """
    height, width = image
    longer_side = max(height, width)
    factor = 1.0 if longest is None else min(1.0, longest / longer_side)
    return max(1, round(height * factor)), max(1, round(width * factor))


def _multiple_above(side: int, of: int) -> int:
    """Returns the least multiple of a number that is not below the side."""
    return math.ceil(side / of) * of


def _size_near(size: Near, image: tuple[int, int]) -> tuple[int, int]:
    """Returns the (height, width) that `Near` makes of the image's."""
    height, width = image
    # The factor of the stated side that needs less resizing; 1 if none is stated.
    stated = ((size.height, height), (size.width, width))
    factors = [wanted / side for wanted, side in stated if wanted]
    factor = min(factors, key=lambda factor: abs(1 - factor), default=1.0)
    # The nearest multiples.
    rows = max(1, round(height * factor / size.of)) * size.of
    columns = max(1, round(width * factor / size.of)) * size.of
    return rows, columns


def _largest_crop(image: tuple[int, int], aspect_of: tuple[int, int]) -> tuple[int, int, int, int]:
    """Returns (top, left, height, width) of the image's largest centred part of another's aspect.

    Args:
        image: (height, width) of the image.
        aspect_of: (height, width) whose aspect ratio the part has.
    """
    height, width = image
    scale = min(height / aspect_of[0], width / aspect_of[1])
    rows = max(1, round(aspect_of[0] * scale))
    columns = max(1, round(aspect_of[1] * scale))
    return (height - rows) // 2, (width - columns) // 2, rows, columns


def _resize(image: Tensor, size: tuple[int, int], *, antialias: bool = False) -> Tensor:
    """Returns an image (1, c, …) resized to (height, width); the image itself if it has that."""
    if tuple(image.shape[-2:]) == size:
        return image
    return F.interpolate(image, size, mode="bilinear", align_corners=False, antialias=antialias)


class SyntheticFrame(NamedTuple):
    """A made-up frame that a network is tried with."""

    rgb: Tensor
    """(1, 3, H, W) in 0…1."""
    points: SparsePoints
    """Points at pixel coordinates of the image."""
    camera: Camera
    """Camera of the image."""


def synthetic_frame(size: tuple[int, int]) -> SyntheticFrame:
    """Returns a smooth random image of (height, width), points near a slanted plane, and a camera.

    The seed is fixed, so a size always gives the same frame. The focal length is the width of the
    image.
    """
    height, width = size
    generator = torch.Generator().manual_seed(0)
    # Random colours at every eighth pixel, with smooth transitions.
    coarse = torch.rand(1, 3, max(2, height // 8), max(2, width // 8), generator=generator)
    rgb = F.interpolate(coarse, size, mode="bilinear")
    # Depth grows from 2 m in the top row to 5 m at the bottom, with up to 1 m of noise.
    pixels = torch.randperm(height * width, generator=generator)[:_SYNTHETIC_POINTS]
    y = pixels // width
    x = pixels % width
    points = SparsePoints(
        xy=torch.stack([x, y], dim=1).float(),
        depth=2 + 3 * y.float() / height + torch.rand(len(pixels), generator=generator),
        size=size,
    )
    matrix = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])
    return SyntheticFrame(rgb, points, Camera(intrinsics=matrix, size=size))
