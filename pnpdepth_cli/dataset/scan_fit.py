"""Whether a scan belongs to its image, and by which other reading it belongs better.

One score, `sensors.edge_fit`, judges all readings: the scan as it is, turned, moved along the
camera's axis as by a difference of time, by other axes, another camera, a calibration of another
size. The verdict is one of three: nothing is said, or a reading that is better is named, or the two
do not seem to fit. Nothing is moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import Camera, Extrinsics, Floats
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.points import Size
from pnpdepth_cli.sensors.edge_fit import EdgeMap, edge_map, jump_weights
from pnpdepth_cli.sensors.lens import pixels_of, unproject
from pnpdepth_cli.sensors.projection import Points, points_in_image, project_velodyne

_MOST_TURN_DEG, _LEAST_TURN_DEG = 9.0, 1.0  # about the camera's x and y
_ROLLS_DEG = (-8.0, -6.0, -5.0, -4.0, -3.0, -2.0, -1.5, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
_AHEAD_M = (-3.0, -2.5, -2.0, -1.5, -1.0, -0.75, -0.5, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0)
"""The way between scan and image: 0.1 s at 5 to 30 m/s."""
_TALLEST = 1 / 3  # of the image's height, by which points are shifted at most
_GOOD = 3.5  # score from which the other axes and cameras are not looked at
_RESIZED = 0.1  # log ratio of the image's size and twice the principal point
_SAME_RATIO = 0.12  # of the two sides' such ratios, where an image was resized
_ABOUT = np.linspace(0.88, 1.12, 49)  # times that ratio, as principal points are not in the middle

_MANY_JUMPS, _SOME_JUMPS = 280, 100  # points at jumps of depth; fewer tell less, or nothing
_BY_CHANCE = 1.7  # a scan of many jumps that belongs to its image has more


class _Needed(NamedTuple):
    """What a reading needs to be told: a score, and so much more than the scan as it is.

    The more readings of a kind there are, the better is the best of them by chance. All numbers are
    from 253 inputs that are right, made of 11 frames of KITTI by resizing, cropping, leaving out
    scan lines and points, noise, blur and darkness: none of them is told anything.
    """

    of_many: tuple[tuple[float, float], ...]  # with many jumps; one of these is enough
    of_some: tuple[float, float]  # with some


_TURNED = _Needed(of_many=((5.2, 1.5), (4.2, 2.5)), of_some=(5.5, 3.0))
_ROLLED = _Needed(of_many=((3.3, 1.7),), of_some=(5.5, 3.0))
_ANOTHER_TIME = _Needed(of_many=((3.3, 1.4),), of_some=(4.2, 2.4))
_OTHER = _Needed(of_many=((3.3, 1.2),), of_some=(3.7, 1.2))
_OF_OTHER_SIZE = _Needed(of_many=((4.0, 2.0),), of_some=(4.5, 2.5))


class _Fit(NamedTuple):
    """A reading of the scan, and how well it belongs to the image."""

    score: float  # in standard deviations by chance
    needed: _Needed
    text: str

    def exceeds(self, as_it_is: float, jumps: int) -> bool:
        """Whether it is better than the scan as it is by more than chance."""
        rules = self.needed.of_many if jumps >= _MANY_JUMPS else (self.needed.of_some,)
        return any(self.score >= score and self.score >= as_it_is + more for score, more in rules)


def fit_warning(
    points: Points,
    scan: NDArray[np.floating],
    own: Calibration,
    others: Mapping[str, Calibration],
    rgb: NDArray[np.float32],
) -> list[str]:
    """Returns a warning if the image's edges contradict how the scan is projected, or none.

    Args:
        points: Points of the scan that the camera sees.
        scan: (N, 3) of the scanner.
        own: The calibration that projects it.
        others: Further calibrations, such as those of other cameras, by what they are.
        rgb: (H, W, 3) in 0…1, of the points' size.
    """
    weight = jump_weights(points)
    if weight is None or rgb.shape[:2] != points.size:
        return []
    jumps = int(np.count_nonzero(weight > weight.max() / 2))
    if jumps < _SOME_JUMPS:
        return []
    as_it_is, found = _fits(points, weight, scan, own, others, rgb)
    better = [fit for fit in found if fit.exceeds(as_it_is, jumps)]
    if better:
        best = max(better, key=lambda fit: fit.score)
        return [
            "warning: the image's edges meet the scan's jumps of depth better"
            f" {best.text}: {best.score:.1f} standard deviations above chance instead of"
            f" {as_it_is:.1f}; check calibration and times"
        ]
    if as_it_is < _BY_CHANCE and jumps >= _MANY_JUMPS:
        return [
            "warning: the image's edges do not meet the scan's jumps of depth"
            f" ({as_it_is:.1f} standard deviations above chance), and no turn, shift, mirror or"
            " camera that was tried is better; check that image, scan and calibration belong"
            " together"
        ]
    return []


def _fits(
    points: Points,
    weight: Floats,
    scan: NDArray[np.floating],
    own: Calibration,
    others: Mapping[str, Calibration],
    rgb: NDArray[np.float32],
) -> tuple[float, list[_Fit]]:
    """The score of the scan as it is, and all other readings with theirs.

    `weight` (N,) is that of the points; the others are as in `fit_warning`.
    """
    edges, camera = edge_map(rgb), own.camera
    # The score of the scan as it is, and its spread by chance, over all shifts.
    focal_px = float(camera.intrinsics[0, 0])
    reach_px = math.tan(math.radians(_MOST_TURN_DEG)) * focal_px
    xy = points.xy.astype(np.float64)
    shifted = edges.shifted(xy, weight, (min(reach_px, _TALLEST * points.size[0]), reach_px))
    chance, spread = float(shifted.mean()), float(shifted.std()) + 1e-9

    def standing(xy: Floats, of: Floats) -> float:
        return (edges.score(xy, of) - chance) / spread

    as_it_is = standing(xy, weight)
    # The same points, turned, and moved along the camera's axis.
    seen = unproject(camera, points.xy, points.depth)
    found = [
        _Fit(standing(pixels_of(camera, moved[ahead]), weight[ahead]), needed, text)
        for moved, needed, text in _moved(seen, camera, edges, shifted)
        if (ahead := moved[:, 2] > 0).any()
    ]
    # The scan by other axes and cameras, whose points have other jumps.
    if as_it_is < _GOOD:
        for text, each in _other_readings(own, others).items():
            other = _project(scan, each, points.size)
            if other is not None and (of_other := jump_weights(other)) is not None:
                found.append(_Fit(standing(other.xy.astype(np.float64), of_other), _OTHER, text))
        # The calibration of an image that was resized.
        resized, factor = _resized(own, points.size)
        other = None if resized is None else _project(scan, resized, points.size)
        if other is not None and (of_other := jump_weights(other)) is not None:
            scores = [standing((other.xy + 0.5) * about - 0.5, of_other) for about in _ABOUT]
            factor *= float(_ABOUT[int(np.argmax(scores))])
            text = f"with the intrinsics × {factor:.3g}, as of an image that was resized"
            found.append(_Fit(max(scores), _OF_OTHER_SIZE, text))
    return as_it_is, found


def _resized(own: Calibration, size: Size) -> tuple[Calibration | None, float]:
    """The calibration of the image (H, W) if it was resized, and by what; None if it was not.

    An image that was resized has its principal point elsewhere than in its middle, by one factor in
    both directions.
    """
    centre = own.camera.intrinsics[:2, 2] + 0.5
    if centre.min() <= 0:
        return None, 1.0
    across, down = size[1] / (2 * centre[0]), size[0] / (2 * centre[1])
    factor = math.sqrt(across * down)
    if abs(math.log(across / down)) > _SAME_RATIO or abs(math.log(factor)) < _RESIZED:
        return None, 1.0
    intrinsics = own.camera.intrinsics.copy()
    intrinsics[:2] *= factor
    intrinsics[:2, 2] += 0.5 * factor - 0.5
    return replace(own, camera=replace(own.camera, intrinsics=intrinsics, size=size)), factor


def _moved(
    seen: Floats, camera: Camera, edges: EdgeMap, shifted: Floats
) -> Iterator[tuple[Floats, _Needed, str]]:
    """The points (N, 3) as turned or moved scans have them, what these need, and their texts."""
    # Small turns about x and y are shifts of the image; the best that is none of chance's.
    focal_x, focal_y = float(camera.intrinsics[0, 0]), float(camera.intrinsics[1, 1])
    rows, columns = (np.arange(n) - n // 2 for n in shifted.shape)
    down_deg = np.degrees(np.arctan(rows / edges.scale / focal_y))[:, None]
    right_deg = np.degrees(np.arctan(columns / edges.scale / focal_x))[None, :]
    far = np.hypot(down_deg, right_deg) >= _LEAST_TURN_DEG
    row, column = np.unravel_index(np.where(far, shifted, -np.inf).argmax(), shifted.shape)
    about_x, about_y = -float(down_deg[row, 0]), float(right_deg[0, column])
    for fine in (0.0, -0.15, 0.15):
        turn = Rotation.from_euler("xy", (about_x, about_y + fine), degrees=True).as_matrix()
        text = (  # whole degrees, as a jump lies half a degree beside the edge that it is of
            f"with the extrinsics turned by {round(about_x)}° about the camera's x and"
            f" {round(about_y)}° about y"
        )
        yield seen @ turn.T, _TURNED, text
    for roll in _ROLLS_DEG:
        turn = Rotation.from_euler("z", roll, degrees=True).as_matrix()
        yield seen @ turn.T, _ROLLED, f"with the extrinsics turned by {roll:g}° about its axis"
    for ahead_m in _AHEAD_M:
        where = "ahead" if ahead_m > 0 else "back"
        text = f"{abs(ahead_m):g} m {where}, as if the scan was of another time than the image"
        yield seen + np.array([0.0, 0.0, ahead_m]), _ANOTHER_TIME, text


def _other_readings(own: Calibration, others: Mapping[str, Calibration]) -> dict[str, Calibration]:
    """Calibrations of other axes of the scan, and the others."""
    assert own.scanner is not None
    readings = dict[str, Calibration]()
    for text, matrix in (
        ("with x of the scan negated", np.diag([-1.0, 1.0, 1.0])),
        (
            "with y of the scan negated, as of left-handed ones (CARLA, Unity)",
            np.diag([1.0, -1, 1]),
        ),
        ("with z of the scan negated", np.diag([1.0, 1.0, -1.0])),
        ("with x and y of the scan exchanged", np.eye(3)[[1, 0, 2]]),
        ("with the scan turned by 180° about z", np.diag([-1.0, -1.0, 1.0])),
    ):
        scanner = own.scanner @ Extrinsics(np.asarray(matrix, np.float64), np.zeros(3))
        readings[text] = replace(own, scanner=scanner)
    return readings | dict(others)


def points_by_reading(scan: NDArray[np.floating], own: Calibration, size: Size) -> dict[str, int]:
    """Returns how many points of a scan (N, 3) are in the image (H, W), by other axes of it."""
    found = dict[str, int]()
    for text, each in _other_readings(own, {}).items():
        assert each.scanner is not None
        found[text] = len(points_in_image(each.scanner.apply(scan), each.camera, size)[0])
    return found


def _project(scan: NDArray[np.floating], reading: Calibration, size: Size) -> Points | None:
    """The points of the scan in the image; None if there is none."""
    assert reading.scanner is not None
    try:
        return project_velodyne(scan, reading.camera, reading.scanner, size)
    except NoPointsError:
        return None
