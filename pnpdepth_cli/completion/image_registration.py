"""Registration of the image to sparse depth, for cameras that are not registered to each other.

Colour and depth cameras have other focal lengths and positions, so depth belongs to other pixels of
the image: by a tenth of the distance from the centre for a raw Kinect. The zoom and the shift
between the two are estimated by one observation: where depth changes between two neighbouring
points, the image has edges between them. The sum of that evidence over all pairs of points is a
correlation of two maps, computed for all shifts at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import Delaunay
from scipy.special import logsumexp

from pnpdepth_cli.completion.gaussian_process import cielab
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_pattern

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

FOUND = 4.0
"""The image is moved from this evidence for a registration on.

It is the log of the Bayes factor over an image that is registered already. The constants here were
chosen on rendered frames. Of registered ones with 500 to 5,000 points 1 % exceed it, with 100
none."""

REGISTERED = 3.0
"""Evidence from which on an image is not moved.

It is the evidence that an image belongs to its points: the log of the Bayes factor over an
unrelated one."""

CHANCE = 3.0
"""Evidence, likewise, that an unrelated image reaches by chance somewhere.

So the best of all registrations must have it for one frame, and twice it for more."""

_LEAST_MOVED = 0.02
"""Root mean square, of the image's longer side, by which a registration moves pixels at least.

Colour and depth of one frame are not exposed at the same time. Where the camera turns fast, that
moves the images of a registered camera by 0.01 to 0.02, rarely 0.034, another way in each frame
(TUM fr1_rpy)."""

_TURNED = 4.0
"""Evidence for another orientation, at least."""

_TURNED_MORE = 5.0
"""By how much it must exceed the evidence for the image as it is."""

# What is searched, and the prior of it.
_ZOOMS = np.exp(np.linspace(-0.4, 0.4, 81))  # 0.67 to 1.49
_LARGEST_SHIFT = 0.05  # of the image's sides
_ZOOM_SCALE = 0.07  # of Laplace's prior of the log zoom
_SHIFT_SIGMA = 0.025  # standard deviation of the prior of the shift, of the image's sides

# The points and the image that are used.
_LONGEST_PX = 320  # the image is reduced to this size
_MIN_POINTS = 10  # fewer tell nothing
_MOST_POINTS = 2000  # of more, so many evenly spaced ones are used
_LEAST_HULL = 0.5  # of the image's area; points of one part say little of the zoom
_MOST_AT_EDGES = 4.0  # standard errors; points on edges of the image were found in the image
_LONGEST_PAIR = 0.95  # quantile of the distances between neighbouring points
_STEPS = 12  # samples between two points
_JUMP = 0.15  # of log depth between two neighbouring points
_LEAST_SHORT = 1 / 3
"""Share of the jumps that lie between points nearer to each other than half of all neighbours are.

It is 0.39 to 0.58 in the maps of five RGB-D sets. It is 0 to 0.28 where points within 8 px of the
jumps are missing, as of phones whose depth of low confidence is dropped. The points that are left
tell nothing of where in between the jump is."""
_SMALLEST_CHANGE = 0.03  # of log depth; smaller ones are noise
_LENGTH_OFFSET = 0.1  # pixels of the reduced image, so that a length has a logarithm
_LEAST_SPREAD = 0.4  # standard deviation of the log of that change; a noisy wall has 0.4, rooms 0.6
_LARGEST_EVIDENCE = 2.5  # standard deviations
_LEAST_CONTRAST = 0.02  # of an image with edges

# Edges of the image: standard deviations of Gaussians in pixels of the reduced image.
_EDGE_SIGMA = 1.0  # before the gradient is taken
_EDGE_REACH = 8.0  # of the surroundings that an edge's strength is relative to
_EDGE_BAND = 6.0  # of the mean that is taken off

# What must be better all over the image.
_PARTS = (24, 32)  # rows and columns of parts of the image
_LEAST_STANDING = 2.4  # standard errors of the gain of a registration, with 500 points a frame
_MORE_STANDING = 1.66  # of it for each e-fold of more points, which see more of chance as well
_POINTS_OF_STANDING = 500

# What the correlation of edges and changes of depth tells.
_WEIGHT = 0.1  # log likelihood per unit of it
_INDEPENDENT = 37.0  # norm of the evidence from which pairs are no longer independent
_NO_EVIDENCE = 25  # points that tell nothing
_EVIDENCE = 0.85  # standard deviations that each e-fold of more points tells


@dataclass(frozen=True, kw_only=True)
class ImageRegistration:
    """Where in the image the colour of a pixel of the depth camera is.

    The colour of pixel x is at c + zoom (x − c) + (right, down), where c is the image's centre.
    """

    zoom: float  # ratio of the focal lengths, image over depth
    right: float  # shift in pixels, as `down`
    down: float

    def __str__(self) -> str:
        return f"{self.zoom:.3f},{self.right:.1f},{self.down:.1f}"

    def apply_to(self, rgb: Image) -> Image:
        """Returns the image (H, W, 3) at the pixels of the depth camera, its border repeated."""
        height, width = rgb.shape[:2]
        # The matrix leads from a pixel of the result to where its colour is.
        x, y = (1 - self.zoom) * np.array([width - 1, height - 1]) / 2 + (self.right, self.down)
        matrix = np.array([[self.zoom, 0, x], [0, self.zoom, y]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        moved = cv2.warpAffine(
            rgb, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(moved, np.float32)


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What one frame tells of the registration, at the reduced size."""

    edges: Image  # (h, w) strength of the image's edges
    between: Floats  # (S, 2) x and y of samples between neighbouring points
    weight: Floats
    """(S,) log likelihood per unit of edge strength, by how much depth changes there."""
    size: tuple[int, int]  # (H, W) of the image
    points: int  # number of points
    jumps: int  # number of pairs of neighbouring points across a jump of depth
    short_jumps: int
    """Number of these that are short: all pairs as short have half of the length of all pairs."""

    def log_likelihood(self, zoom: float) -> Floats:
        """Returns (rows, columns), the log likelihood of each shift in pixels of the reduced image.

        Edges outside the image have strength 0.
        """
        reach = np.rint(_LARGEST_SHIFT * np.array(self.edges.shape)).astype(np.intp)
        centre = np.array(self.edges.shape[::-1]) / 2
        rows, columns = self.edges.shape + 2 * reach
        # The weights at their pixels of a map that has the image in its middle.
        x, y = np.floor((self.between - centre) * zoom + centre).astype(np.intp).T
        x = x + reach[1]
        y = y + reach[0]
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        drawn = np.bincount((y * columns + x)[inside], self.weight[inside], rows * columns)
        template = drawn.reshape(rows, columns).astype(np.float32)
        # Their correlation with the edges at all shifts.
        top, left = (int(n) for n in 2 * reach)
        padded = cv2.copyMakeBorder(self.edges, top, top, left, left, cv2.BORDER_CONSTANT, value=0)
        return cv2.matchTemplate(padded, template, cv2.TM_CCORR).astype(np.float64)

    def gain(self, zoom: float, right: int, down: int) -> Floats:
        """Returns the gain in log likelihood by a registration in each of the parts of the image.

        Args:
            zoom: Its zoom.
            right: Its shift in pixels of the reduced image, as `down`.
            down: The other shift.
        """
        of_samples = self._of_samples(zoom, right, down) - self._of_samples(1.0, 0, 0)
        rows, columns = self.edges.shape
        y = (self.between[:, 1] * _PARTS[0] / rows).astype(np.intp).clip(0, _PARTS[0] - 1)
        x = (self.between[:, 0] * _PARTS[1] / columns).astype(np.intp).clip(0, _PARTS[1] - 1)
        gains = np.bincount(y * _PARTS[1] + x, of_samples, _PARTS[0] * _PARTS[1])
        return np.asarray(gains, np.float64)

    def _of_samples(self, zoom: float, right: int, down: int) -> Floats:
        """(S,) the log likelihood of each sample."""
        rows, columns = self.edges.shape
        centre = np.array([columns, rows]) / 2
        moved = np.floor((self.between - centre) * zoom + centre).astype(np.intp)
        x, y = (moved + np.array([right, down])).T
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        seen = self.edges[y.clip(0, rows - 1), x.clip(0, columns - 1)]
        return np.where(inside, seen * self.weight, 0.0)


def evidence(rgb: Image, points: SparsePoints) -> Evidence | None:
    """Returns what the frame tells of the registration of its image.

    Args:
        rgb: (H, W, 3) in 0…1.

    Returns:
        The evidence. None where the points tell nothing: they are too few, in a part of the image
        only, scan lines of a LiDAR, or were matched in the image, as SfM points are.
    """
    xy = points.xy.double().numpy()
    depth = points.depth.double().numpy()
    if len(xy) < _MIN_POINTS or scan_pattern(xy, points.size):
        return None
    if len(xy) > _MOST_POINTS:
        chosen = np.linspace(0, len(xy) - 1, _MOST_POINTS).astype(np.intp)
        xy, depth = xy[chosen], depth[chosen]
    # They must spread over the image.
    hull = cv2.convexHull(xy.astype(np.float32))
    if cv2.contourArea(hull) < _LEAST_HULL * points.size[0] * points.size[1]:
        return None
    # The edges of the image, at a reduced size.
    scale = min(1.0, _LONGEST_PX / max(points.size))
    rows, columns = (round(side * scale) for side in points.size)
    small = cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA)
    if np.ptp(small) < _LEAST_CONTRAST:
        return None
    edges = _edges(np.asarray(small, np.float32))
    # Points that lie on edges were matched in the image.
    at = (xy + 0.5) * scale
    x, y = at.astype(np.intp).T
    at_edges = edges[y.clip(0, rows - 1), x.clip(0, columns - 1)].mean() * np.sqrt(len(at))
    if at_edges > _MOST_AT_EDGES:
        return None
    # Pairs of neighbouring points, and by how much log depth changes between the two.
    pairs, length = _neighbours(at)
    change = np.abs(np.diff(np.log(depth)[pairs], axis=1)[:, 0])
    weight = _weights_of_pairs(change, length)
    if weight is None:
        return None
    # Samples between the two points of each pair, and jumps of depth.
    step = ((np.arange(_STEPS) + 0.5) / _STEPS)[None, :, None]
    jumps = change > _JUMP
    return Evidence(
        edges=edges,
        between=(at[pairs][:, :1] * (1 - step) + at[pairs][:, 1:] * step).reshape(-1, 2),
        weight=np.repeat(weight / _STEPS, _STEPS),
        size=points.size,
        points=len(xy),
        jumps=int(jumps.sum()),
        short_jumps=int((jumps & (length < _length_of_half(length))).sum()),
    )


def _weights_of_pairs(change: Floats, length: Floats) -> Floats | None:
    """(M,) log likelihood per unit of edge strength between pairs of points, whose mean is 0.

    It follows by how many standard deviations log depth changes more than at other pairs of that
    length. None where that is about the same everywhere, such as of a wall.
    """
    # The change that is usual at a length, by least squares in logarithms.
    terms = np.stack([np.ones_like(length), np.log(length + _LENGTH_OFFSET)], axis=1)
    log_change = np.log(change + _SMALLEST_CHANGE)
    rest = log_change - terms @ np.linalg.lstsq(terms, log_change, rcond=None)[0]
    if rest.std() < _LEAST_SPREAD:
        return None
    weight = (rest / rest.std()).clip(-_LARGEST_EVIDENCE, _LARGEST_EVIDENCE)
    weight -= weight.mean()
    weight *= _WEIGHT * min(1.0, _INDEPENDENT / float(np.linalg.norm(weight)))
    return np.asarray(weight)


def _length_of_half(length: Floats) -> float:
    """The length up to which pairs have half of the length of all pairs (M,)."""
    ordered = np.sort(length)
    return float(ordered[np.searchsorted(ordered.cumsum(), ordered.sum() / 2)])


def better_orientation(frames: Sequence[Evidence]) -> str | None:
    """Returns how the depth of frames of one size is turned or mirrored against the image, or None.

    None also where the image belongs to its points as it is, and where the evidence for another
    orientation is no better than chance.
    """
    height, width = frames[0].size
    scale = min(1.0, _LONGEST_PX / max(height, width))
    right = width * scale  # edges of the reduced image
    bottom = height * scale

    def factor(orient: Callable[[Floats], Floats]) -> float:
        """Evidence that the depth belongs to the image when its positions are turned like this."""
        turned = [replace(frame, between=orient(frame.between)) for frame in frames]
        maps = [frame.log_likelihood(1.0) for frame in turned]
        return _bayes_factor(frames, maps, tuple(count // 2 for count in maps[0].shape))

    as_it_is = factor(lambda at: at)
    if as_it_is > REGISTERED:
        return None
    # What else it can be; sides are exchanged only where they are equal.
    across = np.array([right, 0.0])
    down = np.array([0.0, bottom])
    orientations: dict[str, Callable[[Floats], Floats]] = {
        "mirrored left to right": lambda at: np.abs(across - at),
        "upside down, its rows from the bottom up": lambda at: np.abs(down - at),
        "turned by 180°": lambda at: across + down - at,
    }
    if height == width:
        orientations |= {
            "turned by 90°": lambda at: np.column_stack([bottom - at[:, 1], at[:, 0]]),
            "turned by −90°": lambda at: np.column_stack([at[:, 1], right - at[:, 0]]),
            "with x and y exchanged": lambda at: at[:, ::-1],
            "with x and y exchanged, and turned by 180°": lambda at: (across + down - at)[:, ::-1],
        }
    factors = {text: factor(orient) for text, orient in orientations.items()}
    best = max(factors, key=lambda text: factors[text])
    return best if factors[best] > max(_TURNED, as_it_is + _TURNED_MORE) else None


def estimate_registration(frames: Iterable[Evidence | None]) -> ImageRegistration | None:
    """Returns the registration that frames of one size have in common: the posterior's mean.

    None where the evidence is no better than chance, or than for an image that is registered
    already, where it is not spread over the image, and where points are missing beside the jumps of
    depth.

    Args:
        frames: Evidence of the frames; None of a frame that tells nothing. The first decides the
            size.
    """
    telling = [frame for frame in frames if frame is not None]
    usable = [frame for frame in telling if frame.size == telling[0].size]
    if not usable:
        return None
    # Beside jumps of depth there must be points.
    jumps = sum(frame.jumps for frame in usable)
    if sum(frame.short_jumps for frame in usable) < _LEAST_SHORT * jumps:
        return None
    # An image that belongs to its points as it is stays.
    unmoved = [frame.log_likelihood(1.0) for frame in usable]
    middle = tuple(count // 2 for count in unmoved[0].shape)
    if _bayes_factor(usable, unmoved, middle) > REGISTERED:
        return None
    # Depth that is mirrored or turned is no matter of zoom and shift.
    if better_orientation(usable) is not None:
        return None
    # The posterior over zoom, down and right: likelihood of all frames, and prior.
    total = np.stack(
        [np.sum([frame.log_likelihood(zoom) for frame in usable], axis=0) for zoom in _ZOOMS]
    )
    height, width = usable[0].size
    scale = min(1.0, _LONGEST_PX / max(height, width))
    down, right = ((np.arange(count) - count // 2) / scale for count in total.shape[1:])
    prior = (
        (np.abs(np.log(_ZOOMS)) / _ZOOM_SCALE)[:, None, None]
        + ((down / height / _SHIFT_SIGMA) ** 2 / 2)[None, :, None]
        + ((right / width / _SHIFT_SIGMA) ** 2 / 2)[None, None, :]
    )
    logits = total - prior - logsumexp(-prior)
    # It must be far better than no registration.
    if logsumexp(logits) - sum(float(by_shift[middle]) for by_shift in unmoved) < FOUND:
        return None
    # The best registration must be better than chance.
    number, *place = np.unravel_index(logits.argmax(), logits.shape)
    maps = [frame.log_likelihood(float(_ZOOMS[number])) for frame in usable]
    if _bayes_factor(usable, maps, tuple(place)) < CHANCE * min(len(usable), 2):
        return None
    # It must be better in most parts of the image, not by a few edges.
    best_down, best_right = (int(n) - half for n, half in zip(place, middle, strict=True))
    if not _is_spread(usable, float(_ZOOMS[number]), best_right, best_down):
        return None
    # The posterior's mean.
    probability = np.exp(logits - logsumexp(logits))
    found = ImageRegistration(
        zoom=round(float(_ZOOMS @ probability.sum((1, 2))), 4),
        right=round(float(right @ probability.sum((0, 1))), 2),
        down=round(float(down @ probability.sum((0, 2))), 2),
    )
    # It must be more than what moves the images of a registered camera that turns.
    of_zoom = (found.zoom - 1) * np.hypot(height, width) / np.sqrt(12)
    moved = np.sqrt(of_zoom**2 + found.right**2 + found.down**2)
    return found if moved >= _LEAST_MOVED * max(height, width) else None


def _is_spread(frames: Sequence[Evidence], zoom: float, right: int, down: int) -> bool:
    """Whether a registration fits better all over the image than none, by more than chance.

    Neighbouring points see the same edges, so their gains are not independent; those of parts of
    the image are. By chance their sum is 0 ± the root of the sum of their squares. A part is that
    of all frames: many frames of a still scene are no more evidence than one.
    """
    gains = np.sum([frame.gain(zoom, right, down) for frame in frames], axis=0)
    standing = gains.sum() / (np.linalg.norm(gains) + 1e-9)
    points = np.mean([frame.points for frame in frames])
    more = _MORE_STANDING * np.log(points / _POINTS_OF_STANDING)
    return bool(standing >= _LEAST_STANDING + more)


def _bayes_factor(
    frames: Sequence[Evidence], maps: Sequence[Floats], place: tuple[int | np.intp, ...]
) -> float:
    """Log of the Bayes factor of images that belong to their points at one shift over chance.

    The log likelihood there exceeds its mean over all shifts by so many standard deviations. For an
    unrelated image these are 0 ± 1. For one that belongs there they grow with the logarithm of the
    number of points (even frames of 7-Scenes and ICL-NUIM).
    """
    standing = np.array(
        [(by_shift[place] - by_shift.mean()) / (by_shift.std() + 1e-9) for by_shift in maps]
    )
    points = np.array([frame.points for frame in frames])
    expected = _EVIDENCE * np.log(np.maximum(points / _NO_EVIDENCE, 1.0))
    return float(np.sum(expected * (standing - expected / 2)))


def _edges(rgb: Image) -> Image:
    """(h, w) strength of edges relative to the surroundings, of mean 0 and standard deviation 1."""
    # OpenCV's own conversion takes 0.1 s when it is called first.
    channels = torch.from_numpy(np.clip(rgb, 0, 1)).permute(2, 0, 1)
    lab = np.ascontiguousarray(cielab(channels).permute(1, 2, 0)) / 100
    blurred = cv2.GaussianBlur(lab, (0, 0), _EDGE_SIGMA)
    gradients = [
        cv2.Sobel(blurred, cv2.CV_32F, dx, dy, scale=0.125, borderType=cv2.BORDER_REFLECT)
        for dx, dy in ((1, 0), (0, 1))
    ]
    strength = np.sqrt(np.square(gradients).sum((0, 3)))
    relative = strength / (cv2.GaussianBlur(strength, (0, 0), _EDGE_REACH) + 0.01)
    edges = relative - cv2.GaussianBlur(relative, (0, 0), _EDGE_BAND)
    return np.asarray(edges / (edges.std() + 1e-9), np.float32)


def _neighbours(at: Floats) -> tuple[NDArray[np.intp], Floats]:
    """(M, 2) pairs of neighbouring points and (M,) their distances: triangles' sides, not long."""
    triangles = Delaunay(at, qhull_options="QJ").simplices
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [0, 2]]])
    sides = np.sort(sides)
    pairs = np.unique(sides, axis=0).astype(np.intp)
    length = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
    near = length <= np.quantile(length, _LONGEST_PAIR)
    return pairs[near], length[near]
