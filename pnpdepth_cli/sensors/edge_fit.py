"""How well points belong to an image: jumps of depth lie on its edges, along them, and there alone.

The score of one way to put points into the image is a correlation: weights of the points, large at
the near side of a jump of depth, with the strength of the image's edges in the jump's direction.
Its spread by chance is that of the same points at all shifts, since nearly all of these are wrong.
So a score in standard deviations has one meaning for all images: it is 0 ± 1 for an image that the
points do not belong to, and of ten frames of KITTI it is 7 to 13 where they do.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnpdepth_cli.camera import Camera, Extrinsics, Floats
from pnpdepth_cli.points import Size
from pnpdepth_cli.sensors.lens import pixels_of
from pnpdepth_cli.sensors.projection import points_in_image

_LONGEST_PX = 1280
"""Longer side of the image, to which it is reduced. The constants of blurs below are pixels of the
reduced image."""
_BLUR = 1.0
"""Standard deviation of the blur that smooths noise."""
_SURROUNDINGS = 16.0
"""Standard deviation of the surroundings that an edge is compared with."""
_BAND = 12.0
"""Standard deviation beyond which the strength of edges says nothing of a place."""
_COARSER = 4
"""Factor by which an image is reduced before it is blurred by many pixels, to save time."""
_REACH = 1.0
"""Standard deviation of the blur of an edge; jumps are no better known."""
_DARK = 0.004
"""Gradient that noise has, per pixel, of an image in 0…1. It is added to the strength of an edge's
surroundings: where there is nothing, noise is no edge."""
_NEIGHBOURS = 12
"""Nearest points, among which a jump of depth is looked for."""
_JUMP = 1.3
"""Ratio of the farther to the nearer depth, from which on a jump is a clear one, of weight 1."""
_LEAST_WEIGHT = 0.15
"""Weight of a jump that counts; below are slopes, such as a road."""
_TO_THE_FAR_SIDE = 0.3
"""Fraction of the way to the far neighbour where the edge is: beams are wide, and the near side
returns."""
_LEAST_DEPTH_M = 0.1
"""Depth before the camera from which on a point has a pixel."""
_LEAST_JUMPS = 30
"""Points at jumps of weight 1; fewer tell too little."""
_LEAST_DISTANCE_PX = 1e-6
"""Distances between points are at least this before they are divided by: a point is among its own
nearest, at 0."""
_LEAST_LENGTH = 1e-9
"""Vectors are at least this long before they are divided by their length."""
_LEAST_SQUARE = 1e-12
"""Added to the square of an image's gradient, so that it can be divided by."""


class Jumps(NamedTuple):
    """Where depth jumps from a beam of a scan to a neighbour's, in a camera's coordinates."""

    xyz: Floats  # (N, 3) metres, between the two beams, at the depth of the nearer
    beyond: Floats  # (N, 3) metres, the same point moved by a pixel towards the farther side
    weights: Floats  # (N,) how large each jump is; their squares add up to 1
    clear: int  # number of jumps by a ratio of at least `_JUMP`, in the whole scan

    def largest(self, fraction: float) -> Jumps:
        """Returns the jumps whose weight is at least a fraction of the largest weight."""
        is_large = self.weights >= fraction * self.weights.max()
        return self._replace(
            xyz=self.xyz[is_large], beyond=self.beyond[is_large], weights=self.weights[is_large]
        )

    def moved(self, motion: Extrinsics) -> Jumps:
        """Returns the jumps moved: in the coordinates that a motion leads to."""
        return self._replace(xyz=motion.apply(self.xyz), beyond=motion.apply(self.beyond))

    def projected(self, camera: Camera) -> tuple[Floats, Floats]:
        """Returns pixels (M, 2) and weights (M, 3) of the M jumps in front of the camera.

        (x, y) is the direction of a jump in the image, a unit vector, x right and y down. The three
        weights are the jump's own weight times x·x, y·y and x·y. `EdgeMap.score` multiplies them by
        the edge strengths of the same three products.

        Args:
            camera: The camera, in whose coordinates the jumps are.
        """
        ahead = (self.xyz[:, 2] > _LEAST_DEPTH_M) & (self.beyond[:, 2] > _LEAST_DEPTH_M)
        xy = pixels_of(camera, self.xyz[ahead])
        steps = pixels_of(camera, self.beyond[ahead]) - xy
        steps /= np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), _LEAST_LENGTH)
        x, y = steps.T
        products = np.column_stack([x * x, y * y, x * y])
        return xy, products * self.weights[ahead, None]


class EdgeMap(NamedTuple):
    """Edges of an image at a reduced size."""

    strength: NDArray[np.float32]
    """(h, w, 3) strength of edges, less its mean over the surroundings.

    (x, y) is the direction of the image's gradient, a unit vector. The three channels are the
    strength times x·x, y·y and 2·x·y."""
    scale: float  # size of the reduced image over that of the image

    def score(self, xy: Floats, weights: Floats) -> float:
        """Returns how well jumps of depth lie on edges: the sum of weights times edge strength.

        A jump counts the strength of the edge at its pixel times its own weight times the squared
        cosine of the angle between the jump and the image's gradient. Outside the image the
        strength is 0.

        Args:
            xy: (N, 2) pixel coordinates of the image at full size.
            weights: (N, 3) weights of the jumps by direction, from `Jumps.projected`.
        """
        height, width = self.strength.shape[:2]
        x, y = self._reduced(xy)
        inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
        pixel = y[inside] * width + x[inside]  # row-major
        strength = self.strength.reshape(-1, 3).take(pixel, axis=0)
        return float(np.vdot(strength, weights.take(inside, axis=0)))

    def shifted(self, xy: Floats, weights: Floats, reach_px: tuple[float, float]) -> Floats:
        """Returns the score at all shifts of the jumps, (2·down + 1, 2·right + 1).

        `down` and `right` are the largest shifts in pixels of the reduced image. Element (i, j) is
        the score with the jumps moved by i − down pixels down and j − right to the right.

        Args:
            xy: (N, 2) pixel coordinates of the image at full size.
            weights: (N, 3) weights of the jumps by direction, from `Jumps.projected`.
            reach_px: Largest shift to each side, down and right, in pixels of the full image.
        """
        height, width = self.strength.shape[:2]
        down = max(1, round(reach_px[0] * self.scale))
        right = max(1, round(reach_px[1] * self.scale))
        # The weights are drawn into an image, which is correlated with the edges.
        x, y = self._reduced(xy)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        pixel = (y * width + x)[inside]
        total = np.zeros((2 * down + 1, 2 * right + 1))
        for channel in range(3):
            drawn = np.bincount(pixel, weights[inside, channel], height * width)
            template = drawn.reshape(height, width).astype(np.float32)
            strength = cv2.copyMakeBorder(
                self.strength[:, :, channel],
                top=down,
                bottom=down,
                left=right,
                right=right,
                borderType=cv2.BORDER_CONSTANT,
                value=0,
            )
            total += cv2.matchTemplate(strength, template, cv2.TM_CCORR)
        return total

    def _reduced(self, xy: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Columns (N,) and rows (N,) in the reduced image of pixels (N, 2) of the full one."""
        # The centre of a pixel is half a pixel from the image's edge, about which it was reduced.
        x, y = np.floor((np.asarray(xy, np.float64) + 0.5) * self.scale).astype(np.intp).T
        return x, y


def edge_map(rgb: NDArray[np.float32]) -> EdgeMap:
    """Returns the edges of an image (H, W, 3) in 0…1, relative to their surroundings."""
    # The image is reduced, and blurred against noise; OpenCV finds the window from the deviation.
    height, width = rgb.shape[:2]
    scale = min(1.0, _LONGEST_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    reduced = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(reduced, (0, 0), _BLUR)
    # The gradient (x, y) of each colour, per pixel: the sizes of Sobel's weights add up to 8.
    across_x = cv2.Sobel(small, cv2.CV_32F, dx=1, dy=0, scale=1 / 8)
    across_y = cv2.Sobel(small, cv2.CV_32F, dx=0, dy=1, scale=1 / 8)
    # The products of the gradient with itself, summed over the colours: x·x, y·y, 2·x·y.
    products = np.dstack(
        [
            np.square(across_x).sum(axis=2),
            np.square(across_y).sum(axis=2),
            2 * (across_x * across_y).sum(axis=2),
        ]
    )
    # The gradient's length, relative to its mean over the surroundings, is the strength of an edge.
    # The square root lets a strong edge count less than in proportion.
    squared = products[:, :, 0] + products[:, :, 1] + _LEAST_SQUARE  # squared length
    strength = np.sqrt(squared)
    relative = np.sqrt(strength / (_widely_blurred(strength, _SURROUNDINGS) + _DARK))
    # The strength times the products of the gradient's unit vector. Multiplied by x·x, y·y and x·y
    # of a jump's direction, their sum is the strength times the squared cosine of the angle between
    # gradient and jump.
    by_direction = products * (relative / squared)[:, :, None]
    # Blurred, as jumps are not known to the pixel, and less the mean over a wider band.
    sharp = cv2.GaussianBlur(by_direction, (0, 0), _REACH)
    return EdgeMap(np.asarray(sharp - _widely_blurred(by_direction, _BAND)), scale)


def _widely_blurred(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """The image (h, w) or (h, w, channels) blurred by a Gaussian of many pixels, of the same shape.

    Such a blur needs a fraction of the resolution only.

    Args:
        image: The image.
        sigma_px: Standard deviation of the Gaussian in pixels of the image, well above `_COARSER`.
    """
    height, width = image.shape[:2]
    small = max(1, round(width / _COARSER)), max(1, round(height / _COARSER))
    reduced = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(reduced, (0, 0), sigma_px / _COARSER)
    return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR))


def jumps_of(
    scan: NDArray[np.floating], camera: Camera, scanner: Extrinsics, size: Size
) -> Jumps | None:
    """Returns where depth jumps in a scan, in the camera's coordinates.

    None if fewer than `_LEAST_JUMPS` points are beside a clear jump, one by a ratio of `_JUMP`.
    Points are neighbours if they are so for the scanner: from elsewhere, near and far beams mix,
    and where the camera is taken to be must not change what a jump is.

    Args:
        scan: (N, 3) points in the scanner's coordinates, metres.
        camera: The camera of the image; points outside the image are left out.
        scanner: The scanner's pose beside the camera.
        size: (H, W) of the image.
    """
    # Points that the camera sees, in pixels of a camera at the scanner's place, which has the axes
    # and the focal length of the real one, and its principal point at 0.
    seen, _ = points_in_image(scanner.apply(scan), camera, size)
    seen = seen - scanner.translation
    seen = seen[seen[:, 2] > _LEAST_DEPTH_M]
    if len(seen) <= _NEIGHBOURS:
        return None  # fewer points than neighbours are looked for
    focal_px = float(camera.intrinsics[0, 0])
    depth = seen[:, 2]
    xy = focal_px * seen[:, :2] / seen[:, 2:]
    # A point's weight is that of the largest jump to a farther neighbour. `clear` counts the jumps
    # of full weight.
    tree = cKDTree(xy, compact_nodes=False, balanced_tree=False)
    distances, neighbours = tree.query(xy, k=_NEIGHBOURS)
    ratios = depth[neighbours] / depth[:, None]
    weights = np.clip(np.log(ratios) / np.log(_JUMP), 0, 1)  # 0 for a nearer neighbour
    largest = weights.max(axis=1)
    clear = int(np.count_nonzero(largest >= 1))
    if clear < _LEAST_JUMPS:
        return None
    is_jump = largest >= _LEAST_WEIGHT
    distances, neighbours = distances[is_jump], neighbours[is_jump]
    weights, largest = weights[is_jump], largest[is_jump]
    # The direction of a jump is the mean one to the neighbours whose jump is at least half as large
    # as the largest. The edge of the surface is on the way to the nearest of these.
    weights[weights < largest[:, None] / 2] = 0
    steps = xy[neighbours] - xy[is_jump][:, None]
    per_px = weights / np.maximum(distances, _LEAST_DISTANCE_PX)  # makes unit vectors of the steps
    directions = (steps * per_px[:, :, None]).sum(axis=1)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), _LEAST_LENGTH)
    nearest_of_them = np.where(weights > 0, distances, np.inf).argmin(axis=1)
    step = steps[np.arange(len(steps)), nearest_of_them]
    # Two points at the depth of the nearer beam: on the edge, and a pixel beyond it.
    between = xy[is_jump] + _TO_THE_FAR_SIDE * step
    on_edge, beyond = (
        np.column_stack([pixels / focal_px, np.ones(len(pixels))]) * depth[is_jump, None]
        for pixels in (between, between + directions)
    )
    return Jumps(
        xyz=on_edge + scanner.translation,
        beyond=beyond + scanner.translation,
        weights=largest / np.linalg.norm(largest),  # their squares add up to 1
        clear=clear,
    )
