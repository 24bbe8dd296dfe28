"""Pinhole camera with OpenCV distortion, and its pose relative to a scanner."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_UNDISTORT_STEPS = 50


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
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]], or none."""

    def from_scanner(self, points: NDArray[np.floating]) -> Floats:
        """Returns (N, 3) points of the scanner's frame in the camera's frame, metres."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def to_scanner(self, points: NDArray[np.floating]) -> Floats:
        """Returns (N, 3) points of the camera's frame in the scanner's frame, metres."""
        return (np.asarray(points, np.float64) - self.translation) @ self.rotation

    def pixels_of(self, points: NDArray[np.floating]) -> Floats:
        """Returns the (N, 2) pixel coordinates of points.

        NaN for a direction beyond the one where the distortion turns back on itself: there the
        model would project points from outside the field of view into the image.

        Args:
            points: (N, 3) metres in the camera's frame, all with z > 0.
        """
        plane = points[:, :2] / points[:, 2:3]
        if any(self.distortion):
            with np.errstate(over="ignore", invalid="ignore"):
                plane = _distorted(plane, self.distortion)
        return np.asarray(plane @ self.intrinsics[:2, :2].T + self.intrinsics[:2, 2])

    def unproject(self, xy: NDArray[np.floating], depth: NDArray[np.floating]) -> Floats:
        """Returns the (N, 3) points, metres in the camera's frame, at pixel coordinates.

        Args:
            xy: (N, 2) pixel coordinates.
            depth: (N,) metres along the camera's axis.
        """
        inverse = np.linalg.inv(self.intrinsics)
        plane = np.asarray(xy, np.float64) @ inverse[:2, :2].T + inverse[:2, 2]
        if any(self.distortion):
            plane = _undistorted(plane, self.distortion)
        rays = np.column_stack([plane, np.ones(len(plane))])
        return rays * np.asarray(depth, np.float64)[:, None]


def _distorted(plane: Floats, coefficients: tuple[float, ...]) -> Floats:
    """(N, 2) image plane coordinates after the lens; NaN where the lens model does not hold."""
    shown, square = _through_lens(plane, coefficients)
    shown[square > _largest_radius(coefficients) ** 2] = np.nan
    return shown


def _through_lens(plane: Floats, coefficients: tuple[float, ...]) -> tuple[Floats, Floats]:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0, 0, 0, 0)[:8]
    x, y = plane[:, 0], plane[:, 1]
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (
        1 + square * (k4 + square * (k5 + square * k6))
    )
    shown = np.column_stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ]
    )
    return shown, square


def _largest_radius(coefficients: tuple[float, ...]) -> float:
    """Radius on the image plane up to which the distortion is monotonic."""
    radial_only = (*coefficients[:2], 0.0, 0.0, *coefficients[4:])
    radius = np.linspace(0, 10, 8192)
    with np.errstate(divide="ignore", invalid="ignore"):
        shown, _ = _through_lens(np.column_stack([radius, 0 * radius]), radial_only)
    turning = np.flatnonzero(~(np.diff(shown[:, 0]) > 0))
    return float(radius[turning[0]]) if turning.size else np.inf


def _undistorted(shown: Floats, coefficients: tuple[float, ...]) -> Floats:
    """(N, 2) image plane coordinates before the lens, by fixed-point iteration as in OpenCV.

    Converges within about 45° of the axis for common lenses.
    """
    plane = shown.copy()
    for _ in range(_UNDISTORT_STEPS):
        plane += shown - _through_lens(plane, coefficients)[0]
    return plane
