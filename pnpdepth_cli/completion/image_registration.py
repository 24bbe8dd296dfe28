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
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import logsumexp

from pnpdepth_cli.completion.registration_evidence import (
    TINY,
    Evidence,
    Floats,
    Image,
    reduction,
)

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
"""Evidence that an unrelated image reaches by chance at some registration.

It is a log of the Bayes factor, too. So the best of all registrations must have it for one frame,
and twice it for more."""

_LEAST_MOVED = 0.02
"""Root mean square, over the image's longer side, by which a registration moves pixels at least.

Colour and depth of one frame are not exposed at the same time. Where the camera turns fast, that
moves the images of a registered camera by 0.01 to 0.02, rarely 0.034, another way in each frame
(TUM fr1_rpy)."""

_TURNED = 4.0
"""Evidence that another orientation must have, at least."""

_TURNED_MORE = 5.0
"""By how much the evidence for another orientation must exceed that for the image as it is."""

_LEAST_SHORT = 1 / 3
"""Share of the jumps that lie between points nearer to each other than half of all neighbours are.

It is 0.39 to 0.58 in the maps of five RGB-D sets. It is 0 to 0.28 where points within 8 px of the
jumps are missing, as of phones whose depth of low confidence is dropped. The points that are left
tell nothing of where in between the jump is."""

# What is searched, and the prior of it.
_ZOOMS = np.exp(np.linspace(-0.4, 0.4, 81))
"""Zooms that are tried, 0.67 to 1.49."""
_ZOOM_SCALE = 0.07
"""Scale of Laplace's prior of the log zoom."""
_SHIFT_SIGMA = 0.025
"""Standard deviation of the normal prior of the shift, over the image's sides."""

# What must be better all over the image (docs/notes/registration.md, "What is better all over the
# image").
_LEAST_STANDING = 2.4
"""Standard errors of the gain of a registration, at least, with `_POINTS_OF_STANDING` a frame."""
_MORE_STANDING = 1.66
"""Standard errors that are added for each e-fold of more points, which see more of chance."""
_POINTS_OF_STANDING = 500
"""Points of a frame for which none are added."""

# What the likelihood of an image's own place tells.
_NO_EVIDENCE = 25
"""Points of a frame up to which an image's own place is like any other."""
_EVIDENCE = 0.85
"""Standard deviations that the likelihood of that place rises by each e-fold of more points."""


@dataclass(frozen=True, kw_only=True)
class ImageRegistration:
    """Where in the image the colour of a pixel of the depth camera is.

    The colour of pixel x is at c + zoom (x − c) + (right, down), where c is the image's centre.
    """

    zoom: float
    """Ratio of the focal lengths, image over depth."""
    right: float
    """Shift to the right in pixels of the image."""
    down: float
    """Shift downwards in pixels of the image."""

    def __str__(self) -> str:
        """`zoom,right,down`, as messages show it."""
        return f"{self.zoom:.3f},{self.right:.1f},{self.down:.1f}"

    def apply_to(self, rgb: Image) -> Image:
        """Returns the image as the depth camera would see it, its border repeated.

        Args:
            rgb: Image (H, W, 3); another number of channels, or none, will do.
        """
        height, width = rgb.shape[:2]
        # The matrix leads from a pixel x of the result to where its colour is: zoom·x, and what
        # follows from the centre and the shift.
        centre = np.array([width - 1, height - 1]) / 2
        right, down = (1 - self.zoom) * centre + (self.right, self.down)
        matrix = np.array([[self.zoom, 0, right], [0, self.zoom, down]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        moved = cv2.warpAffine(
            rgb, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(moved, np.float32)


def better_orientation(frames: Sequence[Evidence]) -> str | None:
    """Returns how depth is turned or mirrored against the image, in words; None if it is not.

    None also where the evidence for another orientation is no better than chance.

    Args:
        frames: Evidence of one frame or more, all of one size.
    """
    # An image that belongs to its points as it is has no other orientation.
    as_it_is = _orientation_factor(frames, _unchanged)
    if as_it_is > REGISTERED:
        return None
    # The best of the others must have evidence of its own, and far more than the image as it is.
    factors = {
        words: _orientation_factor(frames, orient)
        for words, orient in _orientations(frames[0].size).items()
    }
    best = max(factors, key=lambda words: factors[words])
    return best if factors[best] > max(_TURNED, as_it_is + _TURNED_MORE) else None


_Orient = Callable[[Floats], Floats]
"""Takes positions (S, 2), x and y in the reduced image, to where they are if depth was turned."""


def _unchanged(xy: Floats) -> Floats:
    """The positions themselves."""
    return xy


def _orientations(size: tuple[int, int]) -> dict[str, _Orient]:
    """The ways in which depth can be turned or mirrored against an image (H, W), by words for them.

    Each takes positions in the reduced image to where they belong then. x and y are exchanged only
    in a square image.
    """
    height, width = size
    right = width * reduction(size)  # edges of the reduced image
    bottom = height * reduction(size)
    corner = np.array([right, bottom])
    # |0 − y| leaves y as it is.
    orientations: dict[str, _Orient] = {
        "mirrored left to right": lambda xy: np.abs(np.array([right, 0.0]) - xy),
        "upside down, its rows from the bottom up": lambda xy: np.abs(np.array([0.0, bottom]) - xy),
        "turned by 180°": lambda xy: corner - xy,
    }
    if height == width:
        orientations |= {
            "turned by 90°": lambda xy: np.column_stack([bottom - xy[:, 1], xy[:, 0]]),
            "turned by −90°": lambda xy: np.column_stack([xy[:, 1], right - xy[:, 0]]),
            "with x and y exchanged": lambda xy: xy[:, ::-1],
            "with x and y exchanged, and turned by 180°": lambda xy: (corner - xy)[:, ::-1],
        }
    return orientations


def _orientation_factor(frames: Sequence[Evidence], orient: _Orient) -> float:
    """The log of the Bayes factor, over chance, of images that belong to their turned depth.

    Args:
        frames: What single frames tell of their registration.
        orient: Function that turns or mirrors positions in the image.
    """
    maps = [replace(frame, between=orient(frame.between)).log_likelihood(1.0) for frame in frames]
    return _bayes_factor(frames, maps, _no_shift(maps[0]))


def _no_shift(log_likelihood: Floats) -> tuple[int, int]:
    """The index of the shift by 0 in a map of `Evidence.log_likelihood`: its middle."""
    rows, columns = log_likelihood.shape
    return rows // 2, columns // 2


def estimate_registration(frames: Iterable[Evidence | None]) -> ImageRegistration | None:
    """Returns the registration that frames of one size have in common: the posterior's mean.

    None where the evidence is no better than chance, or than for an image that is registered
    already, where it is not spread over the image, and where points are missing beside the jumps of
    depth.

    Args:
        frames: Evidence of the frames; None of a frame that tells nothing. The first decides the
            size; frames of another one are left out.
    """
    telling = [frame for frame in frames if frame is not None]
    usable = [frame for frame in telling if frame.size == telling[0].size]
    if not usable:  # no frame tells anything
        return None
    # Beside jumps of depth there must be points.
    jumps = sum(frame.jumps for frame in usable)
    if sum(frame.short_jumps for frame in usable) < _LEAST_SHORT * jumps:
        return None
    # An image that belongs to its points as it is stays.
    unmoved = [frame.log_likelihood(1.0) for frame in usable]
    no_shift = _no_shift(unmoved[0])
    if _bayes_factor(usable, unmoved, no_shift) > REGISTERED:
        return None
    # Depth that is mirrored or turned is no matter of zoom and shift.
    if better_orientation(usable) is not None:
        return None
    # All registrations together must be far better than none.
    posterior = _posterior(usable)
    of_none = sum(float(by_shift[no_shift]) for by_shift in unmoved)
    if logsumexp(posterior.logits) - of_none < FOUND:
        return None
    # The best registration must be better than chance.
    number, row, column = np.unravel_index(posterior.logits.argmax(), posterior.logits.shape)
    best_zoom = float(_ZOOMS[number])
    maps = [frame.log_likelihood(best_zoom) for frame in usable]
    if _bayes_factor(usable, maps, (int(row), int(column))) < CHANCE * min(len(usable), 2):
        return None
    # It must be better in most parts of the image, not by a few edges.
    best_right = int(column) - no_shift[1]
    best_down = int(row) - no_shift[0]
    if not _is_spread(usable, best_zoom, best_right, best_down):
        return None
    # The mean must be more than what moves the images of a registered camera that turns.
    mean = posterior.mean()
    size = usable[0].size
    return mean if _moves_px(mean, size) >= _LEAST_MOVED * max(size) else None


class _Posterior(NamedTuple):
    """The probabilities of registrations, given some frames."""

    logits: Floats
    """(Z, rows, columns) log of likelihood × prior for each of `_ZOOMS` and each shift."""
    down: Floats
    """(rows,) shifts downwards in pixels of the image."""
    right: Floats
    """(columns,) shifts to the right in pixels of the image."""

    def mean(self) -> ImageRegistration:
        """Returns the mean zoom and the mean shift.

        They are rounded to the decimals that are shown, so that what is shown is what was applied.
        """
        probability = np.exp(self.logits - logsumexp(self.logits))  # (zoom, down, right)
        return ImageRegistration(
            zoom=round(float(_ZOOMS @ probability.sum((1, 2))), 4),
            right=round(float(self.right @ probability.sum((0, 1))), 2),
            down=round(float(self.down @ probability.sum((0, 2))), 2),
        )


def _posterior(frames: Sequence[Evidence]) -> _Posterior:
    """The posterior over zoom and shift, given frames of one size."""
    # The log likelihood of all frames together.
    by_zoom = [np.sum([frame.log_likelihood(zoom) for frame in frames], axis=0) for zoom in _ZOOMS]
    log_likelihood = np.stack(by_zoom)
    # The shifts that the elements of a map are of.
    height, width = frames[0].size
    scale = reduction(frames[0].size)
    _, rows, columns = log_likelihood.shape
    down = (np.arange(rows) - rows // 2) / scale
    right = (np.arange(columns) - columns // 2) / scale
    # Minus the log of the prior, up to a constant: Laplace's of the log zoom, normal of the shift.
    penalty = (
        (np.abs(np.log(_ZOOMS)) / _ZOOM_SCALE)[:, None, None]
        + ((down / height / _SHIFT_SIGMA) ** 2 / 2)[None, :, None]
        + ((right / width / _SHIFT_SIGMA) ** 2 / 2)[None, None, :]
    )
    # The last term is that constant, by which the prior sums to 1.
    logits = log_likelihood - penalty - logsumexp(-penalty)
    return _Posterior(logits, down, right)


def _moves_px(registration: ImageRegistration, size: tuple[int, int]) -> float:
    """By how many pixels a registration moves those of an image (H, W), as root mean square."""
    height, width = size
    # Pixels are hypot(H, W) / √12 from the image's centre in root mean square.
    by_zoom = (registration.zoom - 1) * np.hypot(height, width) / np.sqrt(12)
    return float(np.sqrt(by_zoom**2 + registration.right**2 + registration.down**2))


def _is_spread(frames: Sequence[Evidence], zoom: float, right: int, down: int) -> bool:
    """Whether a registration fits better all over the image than none, by more than chance.

    Neighbouring points see the same edges, so their gains are not independent; those of parts of
    the image are. By chance their sum is 0 ± the root of the sum of their squares. A part is that
    of all frames: many frames of a still scene are no more evidence than one.

    Args:
        frames: Evidence of the frames.
        zoom: Zoom of the registration.
        right: Shift to the right in pixels of the reduced image.
        down: Shift downwards in pixels of the reduced image.
    """
    # The gain of each part (P,), and by how many standard errors their sum exceeds chance.
    gains = np.sum([frame.gain(zoom, right, down) for frame in frames], axis=0)
    standard_errors = gains.sum() / (np.linalg.norm(gains) + TINY)
    # More points see more of chance, so that more is asked of them, and of fewer points less.
    points = np.mean([frame.points for frame in frames])
    more = _MORE_STANDING * np.log(points / _POINTS_OF_STANDING)
    return bool(standard_errors >= _LEAST_STANDING + more)


def _bayes_factor(
    frames: Sequence[Evidence], maps: Sequence[Floats], shift: tuple[int, int]
) -> float:
    """Log of the Bayes factor: that images belong to their points at one shift, over chance.

    What counts is by how many standard deviations the log likelihood at the shift exceeds its mean
    over all shifts. For an unrelated image that is 0 ± 1. For one that belongs there it grows with
    the logarithm of the number of points (even frames of 7-Scenes and ICL-NUIM).

    Args:
        frames: Evidence of the frames.
        maps: Log likelihood (rows, columns) of each frame by shift.
        shift: Row and column of the shift in the maps.
    """
    deviations = np.array(
        [(by_shift[shift] - by_shift.mean()) / (by_shift.std() + TINY) for by_shift in maps]
    )
    points = np.array([frame.points for frame in frames])
    # The log of N(deviations; expected, 1) over N(deviations; 0, 1), summed over the frames.
    expected = _EVIDENCE * np.log(np.maximum(points / _NO_EVIDENCE, 1.0))
    return float(np.sum(expected * (deviations - expected / 2)))
