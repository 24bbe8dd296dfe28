"""Lens distortion: from the direction of a ray to the point on the image plane where it is seen.

A lens is a name of `choices.LENSES` and its coefficients. A direction is (x / z, y / z), so all
models here cover less than 180 degrees, where z is positive.

Sources: `radial-tangential` and `fisheye`, OpenCV's calib3d documentation; all others, the camera
models of COLMAP (`src/colmap/sensor/models.h`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Coefficients = tuple[float, ...]

_WIDEST_PLANE = 10.0
"""Tangent of the largest angle to the axis at which a lens without angles of its own is checked."""

_WIDEST_ANGLE = 1.569
"""Radians; the same for a lens that is defined by angles."""

_SAMPLES = 8192
_NEWTON_STEPS = 12
_NEWTON_STEP = 1e-7


def distort(plane: Floats, lens: str, coefficients: Coefficients) -> Floats:
    """Returns (N, 2) points on the image plane, z = 1, as the lens shows them.

    NaN beyond the angle at which the distortion turns back on itself: there the model would show
    directions from outside the field of view inside it.

    Args:
        plane: (N, 2) directions x / z and y / z.
        lens: One of `choices.LENSES`.
        coefficients: Of the lens.
    """
    with np.errstate(all="ignore"):
        shown = _LENSES[lens](plane, coefficients)
        shown[np.einsum("ij,ij->i", plane, plane) > largest_radius(lens, coefficients) ** 2] = (
            np.nan
        )
    return shown


def undistort(shown: Floats, lens: str, coefficients: Coefficients) -> Floats:
    """Returns the (N, 2) directions that the lens shows at points on the image plane.

    Newton's method from the inverse of the radial part; NaN where the lens shows nothing.

    Args:
        shown: (N, 2) points on the image plane.
        lens: One of `choices.LENSES`.
        coefficients: Of the lens.
    """
    radius, seen = _radial_curve(lens, coefficients)
    last = int(np.searchsorted(radius, largest_radius(lens, coefficients), side="right"))
    distance = np.hypot(shown[:, 0], shown[:, 1])
    with np.errstate(all="ignore"):
        inverse = np.interp(distance, seen[:last], radius[:last])
        plane = shown * np.where(distance > 0, inverse / distance, 1.0)[:, None]
        for _ in range(_NEWTON_STEPS):
            off = _LENSES[lens](plane, coefficients) - shown
            plane = plane - _solved(lens, coefficients, plane, off)
        plane[~(np.hypot(*(distort(plane, lens, coefficients) - shown).T) < 1e-6)] = np.nan
    return plane


@functools.lru_cache(maxsize=64)
def largest_radius(lens: str, coefficients: Coefficients) -> float:
    """Returns the tangent of the angle to the axis up to which the distortion is monotonic."""
    radius, seen = _radial_curve(lens, coefficients)
    turning = np.flatnonzero(~(np.diff(seen) > 0))
    return float(radius[turning[0]]) if turning.size else np.inf


def _radial_curve(lens: str, coefficients: Coefficients) -> tuple[Floats, Floats]:
    """Radius before and after the lens, without its tangential and prism parts."""
    kept = _RADIAL[lens]
    radial_only = tuple(c if kept is None or i in kept else 0.0 for i, c in enumerate(coefficients))
    if lens in _BY_ANGLE:
        radius = np.tan(np.linspace(0, _WIDEST_ANGLE, _SAMPLES))
    else:
        radius = np.linspace(0, _WIDEST_PLANE, _SAMPLES)
    with np.errstate(all="ignore"):
        seen = _LENSES[lens](np.column_stack([radius, 0 * radius]), radial_only)
    return radius, seen[:, 0]


def _solved(lens: str, coefficients: Coefficients, plane: Floats, off: Floats) -> Floats:
    """The step of Newton's method, with the Jacobian by central differences."""
    columns = []
    for axis in np.eye(2) * _NEWTON_STEP:
        ahead, behind = (_LENSES[lens](plane + s * axis, coefficients) for s in (1, -1))
        columns.append((ahead - behind) / (2 * _NEWTON_STEP))
    (a, c), (b, d) = columns[0].T, columns[1].T
    determinant = a * d - b * c
    steps = [d * off[:, 0] - b * off[:, 1], a * off[:, 1] - c * off[:, 0]]
    return np.asarray(np.column_stack(steps) / determinant[:, None])


def _radial_tangential(plane: Floats, coefficients: Coefficients) -> Floats:
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *tilt = (*coefficients, *[0.0] * 14)[:14]
    x, y = plane[:, 0], plane[:, 1]
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (
        1 + square * (k4 + square * (k5 + square * k6))
    )
    shown = np.column_stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square),
        ]
    )
    return _tilted(shown, tilt[0], tilt[1]) if any(tilt) else shown


def _tilted(plane: Floats, tau_x: float, tau_y: float) -> Floats:
    """The image plane of a sensor that is rotated about x and y (Scheimpflug), as in OpenCV."""
    cos_x, sin_x, cos_y, sin_y = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    about_x = np.array([[1, 0, 0], [0, cos_x, sin_x], [0, -sin_x, cos_x]])
    about_y = np.array([[cos_y, 0, -sin_y], [0, 1, 0], [sin_y, 0, cos_y]])
    r = about_y @ about_x
    project = np.array([[r[2, 2], 0, -r[0, 2]], [0, r[2, 2], -r[1, 2]], [0, 0, 1]])
    tilted = np.column_stack([plane, np.ones(len(plane))]) @ (project @ r).T
    return np.asarray(tilted[:, :2] / tilted[:, 2:])


def _angle_plane(plane: Floats) -> Floats:
    """Directions with the angle to the axis as their distance from the centre."""
    radius = np.hypot(plane[:, 0], plane[:, 1])
    factor = np.where(radius > 1e-8, np.arctan(radius) / np.where(radius > 0, radius, 1), 1.0)
    return np.asarray(plane * factor[:, None])


def _fisheye(plane: Floats, coefficients: Coefficients) -> Floats:
    """OpenCV's equidistant k1 k2 k3 k4."""
    k1, k2, k3, k4 = (*coefficients, *[0.0] * 4)[:4]
    angles = _angle_plane(plane)
    square = np.einsum("ij,ij->i", angles, angles)
    radial = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
    return np.asarray(angles * radial[:, None])


def _fov(plane: Floats, coefficients: Coefficients) -> Floats:
    """One angle omega (Devernay and Faugeras, 2001)."""
    (omega,) = coefficients
    radius = np.hypot(plane[:, 0], plane[:, 1])
    if omega == 0:
        return plane.copy()
    wide = 2 * np.tan(omega / 2)
    factor = np.where(radius > 1e-8, np.arctan(radius * wide) / (radius * omega), wide / omega)
    return np.asarray(plane * factor[:, None])


def _thin_prism_fisheye(plane: Floats, coefficients: Coefficients) -> Floats:
    """k1 k2 p1 p2 k3 k4 sx1 sy1 on the equidistant plane."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = coefficients
    angles = _angle_plane(plane)
    u, v = angles[:, 0], angles[:, 1]
    square = u * u + v * v
    radial = square * (k1 + square * (k2 + square * (k3 + square * k4)))
    u_off = u * radial + 2 * p1 * u * v + p2 * (square + 2 * u * u) + sx1 * square
    v_off = v * radial + 2 * p2 * u * v + p1 * (square + 2 * v * v) + sy1 * square
    return np.column_stack([u + u_off, v + v_off])


def _rad_tan_thin_prism_fisheye(plane: Floats, coefficients: Coefficients) -> Floats:
    """k0 … k5 p0 p1 s0 … s3, as of Project Aria."""
    k, p, s = coefficients[:6], np.array(coefficients[6:8]), coefficients[8:]
    angles = _angle_plane(plane)
    square = np.einsum("ij,ij->i", angles, angles)
    radial = 1 + sum(factor * square ** (power + 1) for power, factor in enumerate(k))
    seen = angles * np.asarray(radial)[:, None]
    square = np.einsum("ij,ij->i", seen, seen)
    tangential = 2 * (seen @ p)[:, None] * seen + square[:, None] * p
    prism = [square * (s[i] + square * s[i + 1]) for i in (0, 2)]
    return np.asarray(seen + tangential + np.column_stack(prism))


def _division(plane: Floats, coefficients: Coefficients) -> Floats:
    """One k: direction = seen / (1 + k seen²) (Fitzgibbon, 2001)."""
    (k,) = coefficients
    square = np.einsum("ij,ij->i", plane, plane)
    return np.asarray(plane * (2 / (1 + np.sqrt(1 - 4 * k * square)))[:, None])


def _eucm(plane: Floats, coefficients: Coefficients) -> Floats:
    """Alpha and beta of the enhanced unified camera model (Khomutenko et al., 2016)."""
    alpha, beta = coefficients
    square = np.einsum("ij,ij->i", plane, plane)
    return np.asarray(plane / (alpha * np.sqrt(beta * square + 1) + 1 - alpha)[:, None])


_LENSES: dict[str, Callable[[Floats, Coefficients], Floats]] = {
    "radial-tangential": _radial_tangential,
    "fisheye": _fisheye,
    "fov": _fov,
    "thin-prism-fisheye": _thin_prism_fisheye,
    "rad-tan-thin-prism-fisheye": _rad_tan_thin_prism_fisheye,
    "division": _division,
    "eucm": _eucm,
}
_RADIAL: dict[str, tuple[int, ...] | None] = {
    "radial-tangential": (0, 1, 4, 5, 6, 7),
    "fisheye": None,
    "fov": None,
    "thin-prism-fisheye": (0, 1, 4, 5),
    "rad-tan-thin-prism-fisheye": (0, 1, 2, 3, 4, 5),
    "division": None,
    "eucm": None,
}
"""Which coefficients are radial; None for all."""

_BY_ANGLE = ("fisheye", "fov", "thin-prism-fisheye", "rad-tan-thin-prism-fisheye", "eucm")
