"""A camera, and the pose of a scanner in its coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_OF_LEFT_AND_RIGHT = (3, 8, 9, 13)
"""Coefficients of a radial-tangential lens that differ in sign between left and right: p2, s1, s2
and tau_y."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera: pixel = intrinsics · lens(x / z, y / z), which `sensors.lens` computes.

    Camera axes are x right, y down, z forward; whole pixel numbers are pixel centres.
    """

    intrinsics: Floats  # (3, 3), last row 0 0 1, in pixels
    lens: str = "radial-tangential"  # one of `choices.LENSES`: what the coefficients are
    distortion: tuple[float, ...] = ()  # coefficients of the lens, in OpenCV's order
    size: tuple[int, int] | None = None  # (H, W) of its images. None: not stated.
    source: str = ""  # where it is from, for a person

    @property
    def has_lens(self) -> bool:
        """Whether the lens distorts, so that the image differs from a pinhole camera's."""
        return self.lens != "radial-tangential" or any(self.distortion)

    def resized(self, height: int, width: int) -> Camera:
        """Returns the camera of the same images resized to height × width pixels.

        Raises:
            ValueError: The size of its images is unknown.
        """
        if self.size is None:
            raise ValueError("a camera whose image size is unknown cannot be resized")
        # Half a pixel leads from pixel centres to the image's corner, about which pixels scale.
        intrinsics = self.intrinsics.copy()
        intrinsics[:2, 2] += 0.5
        intrinsics[:2] *= np.array([[width / self.size[1]], [height / self.size[0]]])
        intrinsics[:2, 2] -= 0.5
        return replace(self, intrinsics=intrinsics, size=(height, width))

    def mirrored(self, width: int) -> Camera:
        """Returns the camera of the same images, `width` pixels wide, left and right exchanged.

        It sees the mirrored scene, in which x of every point is −x.
        """
        # x' = width − 1 − x for (−X, Y, Z): the focal length stays, skew and centre change.
        intrinsics = self.intrinsics.copy()
        intrinsics[0, 1] = -intrinsics[0, 1]  # skew
        intrinsics[0, 2] = width - 1 - intrinsics[0, 2]  # centre
        # Coefficients of terms that differ between left and right change their sign; a fisheye has
        # none.
        distortion = self.distortion
        if self.lens == "radial-tangential":
            distortion = tuple(
                -coefficient if number in _OF_LEFT_AND_RIGHT else coefficient
                for number, coefficient in enumerate(self.distortion)
            )
        return replace(self, intrinsics=intrinsics, distortion=distortion)


class Extrinsics(NamedTuple):
    """The pose of a scanner beside a camera: x_camera = rotation · x_scanner + translation."""

    rotation: Floats  # (3, 3)
    translation: Floats  # (3,) metres, the scanner's origin in the camera's coordinates

    def apply(self, points: NDArray[np.floating]) -> Floats:
        """Returns points (N, 3) of the scanner's coordinates in the camera's, metres."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def __matmul__(self, other: Extrinsics) -> Extrinsics:
        """Returns the pose of a third sensor in the camera's coordinates: first `other`, then this.

        Args:
            other: Pose of the third sensor in the scanner's coordinates.
        """
        rotation = self.rotation @ other.rotation
        translation = self.rotation @ other.translation + self.translation
        return Extrinsics(rotation, translation)

    def inverse(self) -> Extrinsics:
        """Returns the pose of the camera in the scanner's coordinates."""
        return Extrinsics(self.rotation.T, -self.rotation.T @ self.translation)

    def square(self) -> Floats:
        """Returns the pose as a matrix (4, 4) of homogeneous coordinates."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix


SAME_PLACE = Extrinsics(np.eye(3), np.zeros(3))
"""The pose of a sensor in its own coordinates."""
