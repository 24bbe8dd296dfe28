"""Between pixels of the image and of the network. Depth values of points are never touched."""

from __future__ import annotations

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
_ROUNDING = 1e-4  # of weights with a sum of 1


@dataclass(frozen=True, kw_only=True)
class FrameMap:
    """How an image gets into a network: crop a box, resize it, pad right and bottom.

    image: (H, W). crop: (top, left, height, width) in the image. resized: what the crop becomes.
    network: (h, w), the resized crop with padding.
    """

    image: tuple[int, int]
    crop: tuple[int, int, int, int]
    resized: tuple[int, int]
    network: tuple[int, int]

    @classmethod
    def fit(cls, size: Fixed | Multiple | Near, height: int, width: int) -> FrameMap:
        """The map for an image of this size under a network's size policy."""
        crop = (0, 0, height, width)
        if isinstance(size, Multiple):
            shrink = min(1.0, (size.longest or max(height, width)) / max(height, width))
            resized = (max(1, round(height * shrink)), max(1, round(width * shrink)))
            network = (-(-resized[0] // size.of) * size.of, -(-resized[1] // size.of) * size.of)
        elif isinstance(size, Near):
            sides = ((size.height, height), (size.width, width))
            factors = [wanted / side for wanted, side in sides if wanted]
            factor = min(factors, key=lambda f: abs(1 - f), default=1.0)
            rows, columns = (max(1, round(n * factor / size.of)) * size.of for n in (height, width))
            resized = network = (rows, columns)
        else:
            resized = network = (size.height, size.width)
            if size.fit == "crop":
                scale = min(height / size.height, width / size.width)
                rows = max(1, round(size.height * scale))
                columns = max(1, round(size.width * scale))
                crop = ((height - rows) // 2, (width - columns) // 2, rows, columns)
        return cls(image=(height, width), crop=crop, resized=resized, network=network)

    def rgb_to_network(self, rgb: Tensor) -> Tensor:
        """(1, 3, H, W) → (1, 3, h, w); antialiased when shrinking, edge pixels in the padding."""
        image = _resize(self._cropped(rgb), self.resized, antialias=True)
        return F.pad(image, self._padding, mode="replicate") if any(self._padding) else image

    def prior_to_network(self, depth: Tensor) -> Tensor:
        """Depth (1, 1, H, W), 0 = unknown → (1, 1, h, w); unknown in the padding.

        A pixel is known where everything that it is interpolated from is.
        """
        depth = self._cropped(depth)
        known = _resize((depth > 0).to(depth.dtype), self.resized)
        depth = _resize(depth, self.resized)
        return F.pad(torch.where(known > 1 - _ROUNDING, depth, 0.0), self._padding)

    def _cropped(self, image: Tensor) -> Tensor:
        top, left, height, width = self.crop
        return image[..., top : top + height, left : left + width]

    @property
    def _padding(self) -> tuple[int, int, int, int]:
        return 0, self.network[1] - self.resized[1], 0, self.network[0] - self.resized[0]

    def points_to_network(self, points: SparsePoints) -> SparsePoints:
        """The points inside the crop, at pixel coordinates of the network."""
        resized = points.cropped(*self.crop).resized(*self.resized)
        return SparsePoints(xy=resized.xy, depth=resized.depth, size=self.network)

    def intrinsics_to_network(self, camera: Camera) -> Tensor:
        """The camera of the image → its matrix (1, 3, 3) in the network's pixels."""
        top, left, height, width = self.crop
        moved = camera.intrinsics - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])
        resized = Camera(intrinsics=moved, size=(height, width)).resized(*self.resized)
        return torch.from_numpy(resized.intrinsics)[None].float()

    def depth_to_image(self, depth: Tensor) -> Tensor:
        """Depth (1, 1, h', w') over the network's pixels → (H, W); 0 outside the crop."""
        if any(self._padding):
            depth = _resize(depth, self.network)[..., : self.resized[0], : self.resized[1]]
        top, left, height, width = self.crop
        depth = _resize(depth, (height, width))
        image = depth.new_zeros(self.image)
        image[top : top + height, left : left + width] = depth[0, 0]
        return image


def _resize(image: Tensor, size: tuple[int, int], *, antialias: bool = False) -> Tensor:
    if tuple(image.shape[-2:]) == size:
        return image
    return F.interpolate(image, size, mode="bilinear", align_corners=False, antialias=antialias)


class SyntheticFrame(NamedTuple):
    """A frame that a network is tried with."""

    rgb: Tensor
    """(1, 3, H, W) in 0…1."""
    points: SparsePoints
    camera: Camera


def synthetic_frame(size: tuple[int, int]) -> SyntheticFrame:
    """A smooth random image, points on a slanted plane, and a camera.

    The seed is fixed; the focal length is the width of the image.
    """
    height, width = size
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, max(2, height // 8), max(2, width // 8), generator=generator)
    rgb = F.interpolate(coarse, size, mode="bilinear")
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
