"""What one frame tells of the registration of its image to its sparse depth.

Where depth changes between two neighbouring points, the image has edges between them. So pairs of
points have weights by how much depth changes, and a registration is the more likely, the more of
the weights it moves onto edges. `completion.image_registration` decides by the evidence of frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from pnpdepth_cli.completion.gaussian_process import cielab
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_pattern

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

# The points and the image that are used.
_LONGEST_PX = 320
"""Longer side of the reduced image; a smaller image stays."""
_MIN_POINTS = 10
"""Fewer points tell nothing."""
_MOST_POINTS = 2000
"""Points that are used at most; of more, evenly spaced ones in their order."""
_LEAST_HULL = 0.5
"""Area of the points' hull over the image's, at least: points of one part say little of the zoom"""
_MOST_AT_EDGES = 4.0
"""Standard errors of the mean edge strength at points; above, they were found in the image."""
_LONGEST_PAIR = 0.95
"""Quantile of the distances between neighbouring points, up to which pairs are used."""
_STEPS = 12
"""Samples between two points."""
_JUMP = 0.15
"""Change of log depth between two neighbouring points above which it is a jump."""
_SMALLEST_CHANGE = 0.03
"""Change of log depth between two points that is added to all; smaller ones are noise."""
_LENGTH_OFFSET = 0.1
"""Pixels of the reduced image that are added to a length, so that it has a logarithm."""
_LEAST_SPREAD = 0.4
"""Standard deviation of the log of the changes, at least; a noisy wall has 0.4, rooms 0.6."""
_LARGEST_EVIDENCE = 2.5
"""Standard deviations of the log of the changes beyond which a pair counts no more."""
_LEAST_CONTRAST = 0.02
"""Range of the values 0…1 of an image with edges."""

# Edges of the image: standard deviations of Gaussians in pixels of the reduced image.
_EDGE_SIGMA = 1.0
"""Standard deviation of the blur before the gradient is taken."""
_EDGE_REACH = 8.0
"""Standard deviation of the surroundings that an edge's strength is relative to."""
_EDGE_BAND = 6.0
"""Standard deviation of the surroundings whose mean relative strength is taken off."""
_FAINT_EDGE = 0.01
"""Strength that is added to the surroundings': where there is nothing, noise is no edge."""
TINY = 1e-9
"""Added to what is divided by, so that this is not 0."""

# What is searched, and by which parts of the image.
_LARGEST_SHIFT = 0.05
"""Shift that is tried, at most, over the image's sides."""
_PARTS = (24, 32)
"""Rows and columns of parts of the image."""

# What the correlation of edges and changes of depth tells.
_WEIGHT = 0.1
"""Log likelihood per unit of the correlation."""
_INDEPENDENT = 37.0
"""Norm of the pairs' weights from which pairs are no longer independent."""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What one frame tells of the registration of its image.

    Positions are x and y in the reduced image, whose left and upper edges are 0. Between two
    neighbouring points are samples; where depth changes between the two, the image should have
    edges at the samples.
    """

    edges: Image
    """(h, w) strength of the reduced image's edges, of mean 0 and standard deviation 1."""
    between: Floats
    """(S, 2) positions of samples between neighbouring points."""
    weight: Floats
    """(S,) log likelihood of each sample per unit of edge strength; the more depth changes between
    the two points, the larger, and below 0 where it changes little."""
    size: tuple[int, int]
    """(H, W) of the image before it was reduced."""
    points: int
    """Number of points."""
    jumps: int
    """Number of pairs of neighbouring points across a jump of depth."""
    short_jumps: int
    """Number of these that are short: all pairs as short have half of the length of all pairs."""

    def log_likelihood(self, zoom: float) -> Floats:
        """Returns (rows, columns), the log likelihood of registrations with this zoom by shift.

        Element (i, j) is that of the shift by i − rows // 2 down and j − columns // 2 to the right,
        in pixels of the reduced image. Edges outside the image have strength 0.
        """
        rows, columns = self.edges.shape
        most_down = round(_LARGEST_SHIFT * rows)
        most_right = round(_LARGEST_SHIFT * columns)
        # The weights at their pixels of a map that has the image in its middle.
        map_rows = rows + 2 * most_down
        map_columns = columns + 2 * most_right
        x, y = self._zoomed_pixels(zoom).T
        x = x + most_right
        y = y + most_down
        inside = (x >= 0) & (x < map_columns) & (y >= 0) & (y < map_rows)
        pixel = (y * map_columns + x)[inside]
        weights = np.bincount(pixel, self.weight[inside], map_rows * map_columns)
        template = weights.reshape(map_rows, map_columns).astype(np.float32)
        # Their correlation with the edges at all shifts, from −most to +most. The map reaches over
        # the image by `most` and moves by as much, so the edges need twice that border of zeros.
        top = 2 * most_down
        left = 2 * most_right
        padded = cv2.copyMakeBorder(self.edges, top, top, left, left, cv2.BORDER_CONSTANT, value=0)
        return cv2.matchTemplate(padded, template, cv2.TM_CCORR).astype(np.float64)

    def gain(self, zoom: float, right: int, down: int) -> Floats:
        """Returns (P,), by how much a registration's log likelihood exceeds that of none.

        It is the sum over the samples in each of P parts of the image, row after row (`_PARTS`).

        Args:
            zoom: Zoom of the registration.
            right: Shift to the right in pixels of the reduced image.
            down: Shift downwards in pixels of the reduced image.
        """
        of_samples = self._sample_likelihoods(zoom, right, down)
        of_samples = of_samples - self._sample_likelihoods(1.0, 0, 0)
        # The part that each sample is in.
        rows, columns = self.edges.shape
        part_rows, part_columns = _PARTS
        row = (self.between[:, 1] * part_rows / rows).astype(np.intp).clip(0, part_rows - 1)
        column = (self.between[:, 0] * part_columns / columns).astype(np.intp)
        column = column.clip(0, part_columns - 1)
        gains = np.bincount(row * part_columns + column, of_samples, part_rows * part_columns)
        return np.asarray(gains, np.float64)

    def _sample_likelihoods(self, zoom: float, right: int, down: int) -> Floats:
        """(S,) the log likelihood of a registration by each sample; 0 for one outside the image.

        It is the strength of the edge at the sample, times the sample's weight.

        Args:
            zoom: Zoom of the registration.
            right: Shift to the right in pixels of the reduced image.
            down: Shift downwards in pixels of the reduced image.
        """
        rows, columns = self.edges.shape
        x, y = (self._zoomed_pixels(zoom) + np.array([right, down])).T
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        strength = self.edges[y.clip(0, rows - 1), x.clip(0, columns - 1)]
        return np.where(inside, strength * self.weight, 0.0)

    def _zoomed_pixels(self, zoom: float) -> NDArray[np.intp]:
        """(S, 2) column and row of the samples' pixels, zoomed from the image's centre."""
        rows, columns = self.edges.shape
        centre = np.array([columns, rows]) / 2
        return np.floor((self.between - centre) * zoom + centre).astype(np.intp)


def evidence(rgb: Image, points: SparsePoints) -> Evidence | None:
    """Returns what the frame tells of the registration of its image.

    None where it tells nothing: the points are too few, in a part of the image only, scan lines of
    a LiDAR, or were matched in the image, as SfM points are; or image or depth are flat.

    Args:
        rgb: Image (H, W, 3) in 0…1.
        points: Points of the frame, on the CPU.
    """
    xy = points.xy.double().numpy()
    depth = points.depth.double().numpy()
    if len(xy) < _MIN_POINTS or scan_pattern(xy, points.size) is not None:
        return None
    if len(xy) > _MOST_POINTS:
        used = np.linspace(0, len(xy) - 1, _MOST_POINTS).astype(np.intp)
        xy = xy[used]
        depth = depth[used]
    # They must spread over the image.
    height, width = points.size
    hull = cv2.convexHull(xy.astype(np.float32))
    if cv2.contourArea(hull) < _LEAST_HULL * height * width:
        return None
    # The edges of the image, at a reduced size.
    scale = reduction(points.size)
    rows = round(height * scale)
    columns = round(width * scale)
    small = cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA)
    if np.ptp(small) < _LEAST_CONTRAST:
        return None
    edges = _edges(np.asarray(small, np.float32))
    # Points that lie on edges were matched in the image. Edges have mean 0 and deviation 1.
    positions = (xy + 0.5) * scale
    x, y = positions.astype(np.intp).T
    at_points = edges[y.clip(0, rows - 1), x.clip(0, columns - 1)]
    if at_points.mean() * np.sqrt(len(positions)) > _MOST_AT_EDGES:
        return None
    # Pairs of neighbouring points, and by how much log depth changes between the two.
    pairs, length = _neighbours(positions)
    change = np.abs(np.diff(np.log(depth)[pairs], axis=1)[:, 0])
    weight = _weights_of_pairs(change, length)
    if weight is None:
        return None
    # Samples between the two points of each pair, and jumps of depth.
    fraction = ((np.arange(_STEPS) + 0.5) / _STEPS)[None, :, None]  # of the way, (1, _STEPS, 1)
    ends = positions[pairs]  # (M, 2, 2): pair, end, x and y
    between = ends[:, :1] * (1 - fraction) + ends[:, 1:] * fraction
    is_jump = change > _JUMP
    is_short = length < _length_of_half(length)
    return Evidence(
        edges=edges,
        between=between.reshape(-1, 2),
        weight=np.repeat(weight / _STEPS, _STEPS),
        size=points.size,
        points=len(xy),
        jumps=int(is_jump.sum()),
        short_jumps=int((is_jump & is_short).sum()),
    )


def reduction(size: tuple[int, int]) -> float:
    """Returns the factor by which an image (H, W) is reduced, at most 1."""
    return min(1.0, _LONGEST_PX / max(size))


def _weights_of_pairs(change: Floats, length: Floats) -> Floats | None:
    """(M,) log likelihood per unit of edge strength between pairs of points, whose mean is 0.

    It follows by how many standard deviations log depth changes more than at other pairs of that
    length. None where that is about the same everywhere, such as of a wall.

    Args:
        change: |Difference| (M,) of log depth between the two points.
        length: Distance (M,) of the two in pixels of the reduced image.
    """
    # The change that is usual at a length, by least squares in logarithms, and what exceeds it.
    terms = np.stack([np.ones_like(length), np.log(length + _LENGTH_OFFSET)], axis=1)
    log_change = np.log(change + _SMALLEST_CHANGE)
    excess = log_change - terms @ np.linalg.lstsq(terms, log_change, rcond=None)[0]
    if excess.std() < _LEAST_SPREAD:
        return None
    weight = (excess / excess.std()).clip(-_LARGEST_EVIDENCE, _LARGEST_EVIDENCE)
    weight -= weight.mean()
    # Many pairs see the same edges, so that their evidence is bounded.
    weight *= _WEIGHT * min(1.0, _INDEPENDENT / float(np.linalg.norm(weight)))
    return np.asarray(weight)


def _length_of_half(length: Floats) -> float:
    """The length up to which pairs, of lengths (M,), have half of the summed length of all."""
    ordered = np.sort(length)
    return float(ordered[np.searchsorted(ordered.cumsum(), ordered.sum() / 2)])


def _edges(rgb: Image) -> Image:
    """(h, w) strength of edges relative to the surroundings, of mean 0 and standard deviation 1.

    Args:
        rgb: Image (h, w, 3) in 0…1.
    """
    # CIELAB over 100; OpenCV's own conversion takes 0.1 s when it is called first.
    channels = torch.from_numpy(np.clip(rgb, 0, 1)).permute(2, 0, 1)
    lab = np.ascontiguousarray(cielab(channels).permute(1, 2, 0)) / 100
    # The length of the gradient in x and y, of all three channels; Sobel's weights sum to 8.
    blurred = cv2.GaussianBlur(lab, (0, 0), _EDGE_SIGMA)
    gradients = [
        cv2.Sobel(blurred, cv2.CV_32F, dx, dy, scale=0.125, borderType=cv2.BORDER_REFLECT)
        for dx, dy in ((1, 0), (0, 1))
    ]
    strength = np.sqrt(np.square(gradients).sum((0, 3)))  # over (direction, h, w, channel)
    # Relative to the surroundings, so that an edge of little contrast counts where it is alone. The
    # mean around is taken off, so that even texture counts nothing.
    relative = strength / (cv2.GaussianBlur(strength, (0, 0), _EDGE_REACH) + _FAINT_EDGE)
    edges = relative - cv2.GaussianBlur(relative, (0, 0), _EDGE_BAND)
    return np.asarray(edges / (edges.std() + TINY), np.float32)


def _neighbours(positions: Floats) -> tuple[NDArray[np.intp], Floats]:
    """The pairs of neighbouring points, numbers (M, 2), and their distances (M,).

    They are the sides of Delaunay's triangles of positions (N, 2), without the longest ones, which
    are hardly neighbours, such as those along the hull.
    """
    # QJ: Qhull moves points at random, so that points on one line or circle have triangles, too.
    triangles = Delaunay(positions, qhull_options="QJ").simplices
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [0, 2]]])
    sides = np.sort(sides)  # a side of two triangles is in both, in either order
    pairs = np.unique(sides, axis=0).astype(np.intp)
    length = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    is_near = length <= np.quantile(length, _LONGEST_PAIR)
    return pairs[is_near], length[is_near]
