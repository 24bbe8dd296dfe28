"""A camera in a scanner's world: pinhole, OpenCV distortion, and the pose between the two."""

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
    intrinsics: (3, 3) with last row 0 0 1. rotation: (3, 3). translation: (3,).
    distortion: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]], or none.
    """

    intrinsics: Floats
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    translation: Floats = field(default_factory=lambda: np.zeros(3))
    distortion: tuple[float, ...] = ()

    def from_scanner(self, points: NDArray[np.floating]) -> Floats:
        """(N, 3) points of the scanner's frame in the camera's frame."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def to_scanner(self, points: NDArray[np.floating]) -> Floats:
        """(N, 3) points of the camera's frame in the scanner's frame."""
        return (np.asarray(points, np.float64) - self.translation) @ self.rotation

    def pixels_of(self, points: NDArray[np.floating]) -> Floats:
        """(N, 2) pixel coordinates of (N, 3) points of the camera's frame, all with z > 0.

        NaN for a direction beyond the one where the distortion turns back on itself: there the
        model would put points from outside the view into the picture.
        """
        plane = points[:, :2] / points[:, 2:3]
        if any(self.distortion):
            plane = _distorted(plane, self.distortion)
        return np.asarray(plane @ self.intrinsics[:2, :2].T + self.intrinsics[:2, 2])

    def unproject(self, xy: NDArray[np.floating], depth: NDArray[np.floating]) -> Floats:
        """(N, 3) points of the camera's frame whose z is depth (N,) at the pixels xy (N, 2)."""
        inverse = np.linalg.inv(self.intrinsics)
        plane = np.asarray(xy, np.float64) @ inverse[:2, :2].T + inverse[:2, 2]
        if any(self.distortion):
            plane = _undistorted(plane, self.distortion)
        rays = np.column_stack([plane, np.ones(len(plane))])
        return rays * np.asarray(depth, np.float64)[:, None]


def _distorted(plane: Floats, coefficients: tuple[float, ...]) -> Floats:
    """The image plane (N, 2) as the lens shows it; NaN where the lens model does not hold."""
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
    """The radius on the image plane up to which a larger angle lands farther from the centre."""
    radial_only = (*coefficients[:2], 0.0, 0.0, *coefficients[4:])
    radius = np.linspace(0, 10, 8192)
    with np.errstate(divide="ignore", invalid="ignore"):
        shown, _ = _through_lens(np.column_stack([radius, 0 * radius]), radial_only)
    turning = np.flatnonzero(~(np.diff(shown[:, 0]) > 0))
    return float(radius[turning[0]]) if turning.size else np.inf


def _undistorted(shown: Floats, coefficients: tuple[float, ...]) -> Floats:
    """The image plane (N, 2) that the lens shows at `shown`, by fixed-point iteration.

    As in OpenCV, this settles where the lens moves a point by less than its distance from the
    centre changes: within some 45° of the axis for the usual lens.
    """
    plane = shown.copy()
    for _ in range(_UNDISTORT_STEPS):
        plane += shown - _through_lens(plane, coefficients)[0]
    return plane
