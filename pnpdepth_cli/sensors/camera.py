"""Camera with lens distortion, and its pose relative to a scanner."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.sensors.lens import distort, undistort

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """x_camera = rotation · x_scanner + translation; pixels = intrinsics · distorted(x / z).

    Camera axes are x right, y down, z forward, in metres; whole pixel numbers are pixel centres.
    """

    intrinsics: Floats
    """(3, 3), last row 0 0 1, in pixels."""

    rotation: Floats = field(default_factory=lambda: np.eye(3))
    """(3, 3), from the scanner's frame to the camera's."""

    translation: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) metres, the scanner's origin in the camera's frame."""

    distortion: tuple[float, ...] = ()
    """Coefficients of the lens, or none."""

    lens: str = "radial-tangential"
    """One of `choices.LENSES`: what the coefficients are."""

    @property
    def has_lens(self) -> bool:
        """Whether the image differs from a pinhole camera's."""
        return self.lens != "radial-tangential" or any(self.distortion)

    def from_scanner(self, points: NDArray[np.floating]) -> Floats:
        """Returns (N, 3) points of the scanner's frame in the camera's frame, metres."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def to_scanner(self, points: NDArray[np.floating]) -> Floats:
        """Returns (N, 3) points of the camera's frame in the scanner's frame, metres."""
        return (np.asarray(points, np.float64) - self.translation) @ self.rotation

    def pixels_of(self, points: NDArray[np.floating]) -> Floats:
        """Returns the (N, 2) pixel coordinates of points.

        NaN for a direction beyond the one where the distortion turns back on itself.

        Args:
            points: (N, 3) metres in the camera's frame, all with z > 0.
        """
        plane = points[:, :2] / points[:, 2:3]
        if self.has_lens:
            plane = distort(plane, self.lens, self.distortion)
        return np.asarray(plane @ self.intrinsics[:2, :2].T + self.intrinsics[:2, 2])

    def unproject(self, xy: NDArray[np.floating], depth: NDArray[np.floating]) -> Floats:
        """Returns the (N, 3) points, metres in the camera's frame, at pixel coordinates.

        Args:
            xy: (N, 2) pixel coordinates.
            depth: (N,) metres along the camera's axis.
        """
        inverse = np.linalg.inv(self.intrinsics)
        plane = np.asarray(xy, np.float64) @ inverse[:2, :2].T + inverse[:2, 2]
        if self.has_lens:
            plane = undistort(plane, self.lens, self.distortion)
        rays = np.column_stack([plane, np.ones(len(plane))])
        return rays * np.asarray(depth, np.float64)[:, None]
