"""A camera, and the pose of a scanner in its coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera: pixels = intrinsics · lens(x / z); `sensors.lens` computes them.

    Camera axes are x right, y down, z forward; whole pixel numbers are pixel centres.
    """

    intrinsics: Floats  # (3, 3), last row 0 0 1, in pixels
    lens: str = "radial-tangential"  # one of `choices.LENSES`: what the coefficients are
    distortion: tuple[float, ...] = ()
    size: tuple[int, int] | None = None  # (H, W) of its images. None: not stated.
    source: str = ""  # where it is from, for a person

    @property
    def has_lens(self) -> bool:
        """Whether the image differs from a pinhole camera's."""
        return self.lens != "radial-tangential" or any(self.distortion)

    def resized(self, height: int, width: int) -> Camera:
        """Returns the camera of its images, whose size is known, in height × width pixels."""
        if self.size is None:
            raise ValueError("a camera whose image size is unknown cannot be resized")
        intrinsics = self.intrinsics.copy()
        intrinsics[:2, 2] += 0.5
        intrinsics[:2] *= np.array([[width / self.size[1]], [height / self.size[0]]])
        intrinsics[:2, 2] -= 0.5
        return replace(self, intrinsics=intrinsics, size=(height, width))


class Extrinsics(NamedTuple):
    """The pose of a scanner beside a camera: x_camera = rotation · x_scanner + translation."""

    rotation: Floats  # (3, 3)
    translation: Floats  # (3,) metres, the scanner's origin in the camera's coordinates

    def apply(self, points: NDArray[np.floating]) -> Floats:
        """Returns (N, 3) points of the scanner in the camera's coordinates, metres."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def __matmul__(self, other: Extrinsics) -> Extrinsics:
        """Returns the pose beside this camera of what has the other pose beside the scanner."""
        turn, shift = self
        return Extrinsics(turn @ other.rotation, turn @ other.translation + shift)

    def inverse(self) -> Extrinsics:
        """Returns the pose of the camera in the scanner's coordinates."""
        return Extrinsics(self.rotation.T, -self.rotation.T @ self.translation)

    def square(self) -> Floats:
        """Returns the pose as a (4, 4) matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self
        return matrix


SAME_PLACE = Extrinsics(np.eye(3), np.zeros(3))
"""The pose of a sensor in its own coordinates."""
