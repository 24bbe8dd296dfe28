"""From points in a camera's coordinates to its pixels and back, with lens distortion.

A lens is a name of `choices.LENSES` and its coefficients. It maps the direction of a ray, x / z and
y / z, to the point on the image plane z = 1 where it is seen, so all lenses here cover less than
180 degrees. Both are OpenCV's.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera, Floats
from pnpdepth_cli.points import Size

Coefficients = tuple[float, ...]
"""Distortion coefficients of a lens, in OpenCV's order."""

_RADIAL = (0, 1, 4, 5, 6, 7)  # which coefficients of a radial-tangential lens are radial

# Where a lens is looked at for the angle at which its distortion turns back.
_WIDEST_PLANE = 10.0  # of a radial-tangential lens: tangent of the angle to the axis
_WIDEST_ANGLE_RAD = 1.569  # of a fisheye
_SAMPLES = 8192  # distances from the axis, evenly spaced on the plane, or in angle of a fisheye

# Newton's method for the inverse of a distortion, on the plane z = 1.
_NEWTON_STEPS = 12
_NEWTON_DIFFERENCE = 1e-7  # step of the central differences
_NEWTON_END = 1e-9  # a smaller step leaves an error that is smaller than rounding
_SHOWN_ERROR = 1e-6  # largest distance of where the lens shows a direction from the point


def pixels_of(camera: Camera, points: NDArray[np.floating]) -> Floats:
    """Returns the (N, 2) pixel coordinates of (N, 3) points in the camera's coordinates, z > 0.

    NaN for a direction that the lens does not show: beyond where its distortion turns back on
    itself (`largest_radius`).
    """
    plane = points[:, :2] / points[:, 2:3]
    if camera.has_lens:
        plane = distort(plane, camera.lens, camera.distortion)
    return np.asarray(plane @ camera.intrinsics[:2, :2].T + camera.intrinsics[:2, 2])


def rays_of(camera: Camera, xy: NDArray[np.floating]) -> Floats:
    """Returns the directions seen at (N, 2) pixels: (N, 2) x / z and y / z in camera coordinates.

    NaN where the lens shows nothing.
    """
    inverse = np.linalg.inv(camera.intrinsics)  # its last row is 0 0 1, like that of the matrix
    plane = np.asarray(xy, np.float64) @ inverse[:2, :2].T + inverse[:2, 2]
    return undistort(plane, camera.lens, camera.distortion) if camera.has_lens else plane


def rays_of_image(camera: Camera, size: Size) -> Floats:
    """Returns the directions at all pixels of an image, (H, W, 2) x / z and y / z; read only.

    Those of the last camera are kept, as the frames of a sequence mostly have one. NaN where the
    lens shows nothing.

    Args:
        camera: The camera, in pixels of the image.
        size: (H, W) of the image.
    """
    intrinsics = tuple(camera.intrinsics.ravel().tolist())
    return _rays_of_image(intrinsics, camera.lens, camera.distortion, size)


@functools.lru_cache(maxsize=1)
def _rays_of_image(
    intrinsics: tuple[float, ...], lens: str, distortion: Coefficients, size: Size
) -> Floats:
    """The directions at all pixels of an image, (H, W, 2) x / z and y / z, read only.

    The camera is given by hashable values, by which the cache finds them.

    Args:
        intrinsics: The nine numbers of the matrix, row after row.
        lens: Name of `choices.LENSES`.
        distortion: Coefficients of the lens.
        size: (H, W) of the image.
    """
    camera = Camera(intrinsics=np.reshape(intrinsics, (3, 3)), lens=lens, distortion=distortion)
    height, width = size
    columns = np.arange(width)
    rays = np.empty((height, width, 2))
    for row in range(height):  # one by one, so that little more than the result is in memory
        rays[row] = rays_of(camera, np.column_stack([columns, np.full(width, row)]))
    rays.flags.writeable = False
    return rays


def unproject(camera: Camera, xy: NDArray[np.floating], depth: NDArray[np.floating]) -> Floats:
    """Returns the points (N, 3) in the camera's coordinates at pixels (N, 2) of depth z (N,).

    They are in the unit of the depth; NaN where the lens shows nothing.
    """
    rays = np.column_stack([rays_of(camera, xy), np.ones(len(xy))])
    return rays * np.asarray(depth, np.float64)[:, None]


def distort(plane: Floats, lens: str, coefficients: Coefficients) -> Floats:
    """Returns where on the image plane, z = 1, a lens shows directions; (N, 2).

    NaN beyond the angle at which the distortion turns back on itself: there the model would show
    directions from outside the field of view inside it.

    Args:
        plane: (N, 2) x / z and y / z of the directions.
        lens: Name of `choices.LENSES`.
        coefficients: Coefficients of the lens.
    """
    with np.errstate(all="ignore"):
        shown = _distort_anywhere(plane, lens, coefficients)
        shown[np.hypot(*plane.T) > largest_radius(lens, coefficients)] = np.nan
    return shown


def undistort(shown: Floats, lens: str, coefficients: Coefficients) -> Floats:
    """Returns the directions, (N, 2) x / z and y / z, that a lens shows at points of its image.

    It is the inverse of `distort`, by Newton's method; NaN where the lens shows nothing.

    Args:
        shown: (N, 2) points on the image plane, z = 1.
        lens: Name of `choices.LENSES`.
        coefficients: Coefficients of the lens.
    """
    # The curve of the radial part, up to where it turns back.
    radius, shown_radius = _radial_curve(lens, coefficients)
    rising = int(np.searchsorted(radius, largest_radius(lens, coefficients), side="right"))
    shown_distance = np.hypot(shown[:, 0], shown[:, 1])
    with np.errstate(all="ignore"):
        # The start is the inverse of that curve: the distance that it shows at the point's.
        distance = np.interp(shown_distance, shown_radius[:rising], radius[:rising])
        scale = np.where(shown_distance > 0, distance / shown_distance, 1.0)
        plane = shown * scale[:, None]
        # Steps of those directions that still move.
        moving = np.arange(len(plane))
        for _ in range(_NEWTON_STEPS):
            step = _newton_step(plane[moving], shown[moving], lens, coefficients)
            plane[moving] -= step
            moving = moving[np.abs(step).max(axis=1) > _NEWTON_END]
        # Where no direction is shown at the point, the steps end elsewhere, or at NaN.
        error = np.hypot(*(distort(plane, lens, coefficients) - shown).T)
        plane[~(error < _SHOWN_ERROR)] = np.nan
    return plane


def largest_radius(lens: str, coefficients: Coefficients) -> float:
    """Returns the radius on the plane z = 1 up to which a lens shows farther rays farther out.

    Beyond that radius √(x² + y²) of a ray (x, y, 1) its distortion turns back, and shows rays
    nearer to the axis again. Infinite if it does not turn back within the angles that
    `_radial_curve` samples.

    Args:
        lens: Name of `choices.LENSES`.
        coefficients: Coefficients of the lens.
    """
    radius, shown_radius = _radial_curve(lens, coefficients)
    # It turns back where what is shown rises no more, or is not finite.
    turning = np.flatnonzero(~(np.diff(shown_radius) > 0))
    return float(radius[turning[0]]) if turning.size else np.inf


def _newton_step(plane: Floats, shown: Floats, lens: str, coefficients: Coefficients) -> Floats:
    """The step of Newton's method for `undistort`, (N, 2), which is subtracted from directions.

    Args:
        plane: (N, 2) directions that were reached so far, x / z and y / z.
        shown: (N, 2) points on the image plane at which the lens shows the directions sought.
        lens: Name of `choices.LENSES`.
        coefficients: Coefficients of the lens.
    """
    # The derivatives [[a, b], [c, d]] of the shown point (a row for its x, a row for its y) by the
    # direction (a column for its x, a column for its y), by central differences.
    columns = []
    for axis in np.eye(2) * _NEWTON_DIFFERENCE:
        ahead = _distort_anywhere(plane + axis, lens, coefficients)
        behind = _distort_anywhere(plane - axis, lens, coefficients)
        columns.append((ahead - behind) / (2 * _NEWTON_DIFFERENCE))
    a, c = columns[0].T
    b, d = columns[1].T
    # Their inverse, [[d, −b], [−c, a]] over the determinant, applied to the error (x, y).
    x, y = (_distort_anywhere(plane, lens, coefficients) - shown).T
    determinant = a * d - b * c
    return np.asarray(np.column_stack([d * x - b * y, a * y - c * x]) / determinant[:, None])


@functools.lru_cache(maxsize=64)
def _radial_curve(lens: str, coefficients: Coefficients) -> tuple[Floats, Floats]:
    """Rising distances from the axis on the plane z = 1, and at which distance a lens shows each.

    The tangential parts of the lens, which are small, are left out.

    Args:
        lens: Name of `choices.LENSES`.
        coefficients: Coefficients of the lens.

    Returns:
        Two arrays of `_SAMPLES` distances; the second may fall where the lens turns back.
    """
    if lens == "fisheye":
        radius = np.tan(np.linspace(0, _WIDEST_ANGLE_RAD, _SAMPLES))
    else:
        radius = np.linspace(0, _WIDEST_PLANE, _SAMPLES)
        coefficients = tuple(
            coefficient if number in _RADIAL else 0.0
            for number, coefficient in enumerate(coefficients)
        )
    with np.errstate(all="ignore"):
        shown = _distort_anywhere(np.column_stack([radius, 0 * radius]), lens, coefficients)
    return radius, shown[:, 0]


def _distort_anywhere(plane: Floats, lens: str, coefficients: Coefficients) -> Floats:
    """Where on the image plane, z = 1, a lens model shows directions, (N, 2).

    Also beyond `largest_radius`, where its distortion turns back.

    Args:
        plane: (N, 2) x / z and y / z of the directions.
        lens: Name of `choices.LENSES`.
        coefficients: Coefficients of the lens.
    """
    if not len(plane):  # which OpenCV refuses
        return plane.copy()
    if lens == "fisheye":
        return _fisheye(plane, coefficients)
    return _radial_tangential(plane, coefficients)


def _radial_tangential(plane: Floats, coefficients: Coefficients) -> Floats:
    """Where on the image plane, z = 1, a radial-tangential lens shows directions, (N, 2).

    Args:
        plane: (N, 2) x / z and y / z of the directions.
        coefficients: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]; those that
            are not given are 0.
    """
    padded = (*coefficients, *[0.0] * 14)[:14]
    if any(padded[12:]):  # the sensor is tilted; OpenCV takes 6 times as long as what follows
        points = np.column_stack([plane, np.ones(len(plane))])
        no_motion = np.zeros(3)
        shown, _ = cv2.projectPoints(points, no_motion, no_motion, np.eye(3), np.array(padded))
        return np.asarray(shown[:, 0], np.float64)
    # OpenCV's formula for a sensor that is not tilted; r2, r4 and r6 are powers of the radius.
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = padded[:12]
    x, y = plane.T
    r2 = x * x + y * y
    r4 = r2 * r2
    r6 = r4 * r2
    radial = (1 + k1 * r2 + k2 * r4 + k3 * r6) / (1 + k4 * r2 + k5 * r4 + k6 * r6)
    tangential = 2 * x * y
    shown_x = x * radial + p1 * tangential + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r4
    shown_y = y * radial + p2 * tangential + p1 * (r2 + 2 * y * y) + s3 * r2 + s4 * r4
    return np.column_stack([shown_x, shown_y])


def _fisheye(plane: Floats, coefficients: Coefficients) -> Floats:
    """Where on the image plane, z = 1, a fisheye lens shows directions, (N, 2).

    Args:
        plane: (N, 2) x / z and y / z of the directions.
        coefficients: OpenCV's k1 k2 k3 k4; those that are not given are 0. With all 0 the distance
            to the centre is the angle to the axis in radians.
    """
    padded = np.array((*coefficients, *[0.0] * 4)[:4])
    return np.asarray(cv2.fisheye.distortPoints(plane[:, None], np.eye(3), padded)[:, 0])
