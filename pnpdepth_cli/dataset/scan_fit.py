"""Whether a scan belongs to its image, and by which other reading it belongs better.

One score, `sensors.edge_fit`, judges all readings: the scan as it is, turned, moved along the
camera's axis as by a difference of time, by other axes, another camera, a mirrored image, a
calibration of another size. The verdict is one of three: nothing is said, or a reading that is
better is named, or the two do not seem to fit. Nothing is moved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import Camera, Extrinsics, Floats
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.points import Size
from pnpdepth_cli.sensors.edge_fit import EdgeMap, Jumps, edge_map, jumps_of
from pnpdepth_cli.sensors.projection import points_in_image

_MOST_TURN_DEG = 9.0
"""About the camera's x and y."""
_LEAST_TURN_DEG = 1.0
"""Below, a calibration is taken for inexact."""
_MOST_ROLL_DEG = 10.0
"""About the camera's axis."""
_MOST_AHEAD_M = 3.0
"""0.1 s at 30 m/s."""
_LEAST_AHEAD_M = 0.5
"""0.1 s at 5 m/s."""
_TALLEST = 1 / 3
"""Of the image's height, by which points are shifted at most."""
_ROLLS_DEG = np.arange(-5.0, 5.1, 0.5)
"""Turns about the camera's axis that are tried with each turn about x and y."""
_RESIZED = 0.1
"""Log ratio of the image's size and twice the principal point, of an image that was resized."""
_SAME_RATIO = 0.12
"""Difference of the two sides' such log ratios, where an image was resized."""
_ABOUT = np.linspace(0.88, 1.12, 97)
"""Times that ratio, as principal points are not in the middle."""

_COARSE = 0.4
"""Of the largest weight, of jumps that are looked at first."""
_AS_IT_IS = np.zeros(4)
"""A pose: degrees about the camera's x, y and z, and metres ahead."""
_INEXACT = np.array([0.5, 0.5, 0.5, 0.3])
"""Such a pose, which a right calibration may be off."""
_PEAKS = 3
"""Best shifts, from which turns are looked for."""
_GOOD = 5.0
"""Score from which axes, cameras and mirrors are not looked at."""

_SOME_JUMPS = 60
"""Jumps of depth; fewer tell nothing."""
_MANY_JUMPS = 250
"""Jumps of depth, from which less is needed."""
_BY_CHANCE = 2.5
"""Score; a scan of many jumps that belongs to its image has more."""


class _Needed(NamedTuple):
    """What a reading needs to be told.

    The more readings of a kind there are, the better is the best of them by chance. All numbers are
    from right and wrong inputs made of KITTI's frames for object detection and depth completion by
    `benchmarks.scan_fit`, whose other frames report what comes of them.
    """

    score: float
    more: float  # than the scan as it is


_NEEDED = {
    "turn": _Needed(score=5.0, more=2.5),
    "roll": _Needed(score=5.0, more=2.5),
    "late": _Needed(score=5.0, more=2.0),
    "mirror": _Needed(score=4.5, more=1.5),
    "other": _Needed(score=4.5, more=1.5),
    "size": _Needed(score=4.5, more=1.5),
}
# By scans of less than many jumps:
_NEEDED_OF_FEW = {
    "turn": _Needed(score=7.0, more=4.5),
    "roll": _Needed(score=6.0, more=3.0),
    "late": _Needed(score=5.5, more=3.0),
    "mirror": _Needed(score=5.0, more=2.5),
    "other": _Needed(score=5.0, more=2.5),
    "size": _Needed(score=5.0, more=2.5),
}


class _Fit(NamedTuple):
    """A reading of the scan, and how well it belongs to the image."""

    kind: str
    score: float  # in standard deviations by chance
    text: str


def fit_warning(
    scan: NDArray[np.floating],
    own: Calibration,
    others: Mapping[str, Calibration],
    rgb: NDArray[np.float32],
    *,
    is_whole: bool = True,
) -> list[str]:
    """Returns a warning if the image's edges contradict how the scan is projected, or none.

    Args:
        scan: (N, 3) of the scanner.
        own: The calibration that projects it.
        others: Further calibrations, such as those of other cameras, by what they are.
        rgb: (H, W, 3) in 0…1.
        is_whole: Whether it has the returns of a scanner. The jumps of other clouds are known as
            inexactly as their points are far apart. So few of them tell nothing, and many may fit
            no better than by chance.
    """
    # Too few jumps of depth tell nothing.
    size = (rgb.shape[0], rgb.shape[1])
    jumps = _jumps(scan, own, size)
    if jumps is None or jumps.clear < (_SOME_JUMPS if is_whole else _MANY_JUMPS):
        return []
    # Readings that are clearly better than the scan as it is.
    judge = _Judge(rgb, own.camera, jumps)
    readings = list(_readings(judge, scan, own, others, size))
    needed = _NEEDED if jumps.clear >= _MANY_JUMPS else _NEEDED_OF_FEW
    better = [
        reading
        for reading in readings
        if reading.score >= needed[reading.kind].score
        and reading.score >= judge.as_it_is + needed[reading.kind].more
    ]
    if better:
        best = max(better, key=lambda reading: reading.score)
        return [
            "warning: the image's edges meet the scan's jumps of depth better"
            f" {best.text}: {best.score:.1f} standard deviations above chance instead of"
            f" {judge.as_it_is:.1f}; check calibration and times"
        ]
    # None is, and the scan as it is fits no better than by chance.
    if is_whole and judge.as_it_is < _BY_CHANCE and jumps.clear >= _MANY_JUMPS:
        return [
            "warning: the image's edges do not meet the scan's jumps of depth"
            f" ({judge.as_it_is:.1f} standard deviations above chance), and no turn, shift, mirror"
            " or camera that was tried is better; check that image, scan and calibration belong"
            " together"
        ]
    return []


class _Judge:
    """Scores readings of one scan in standard deviations by chance."""

    def __init__(self, rgb: NDArray[np.float32], camera: Camera, jumps: Jumps) -> None:
        self.edges: EdgeMap = edge_map(rgb)
        self.camera = camera
        self.jumps = jumps
        self.largest = jumps.largest(_COARSE)
        # Chance is the score of all shifts.
        focal_px = float(camera.intrinsics[0, 0])
        across_px = math.tan(math.radians(_MOST_TURN_DEG)) * focal_px
        down_px = min(across_px, _TALLEST * rgb.shape[0])
        xy, weights = jumps.projected(camera)
        self.shifted = self.edges.shifted(xy, weights, (down_px, across_px))
        self.chance = float(self.shifted.mean())
        self.spread = float(self.shifted.std()) + 1e-9
        # No calibration is exact: the scan as it is may be off by so little.
        self.as_it_is, self.base = self._as_it_is()

    def of_pixels(self, xy: Floats, weights: Floats) -> float:
        """The score of weights (N, 3) at pixels (N, 2)."""
        return (self.edges.score(xy, weights) - self.chance) / self.spread

    def of_pose(self, pose: Floats) -> float:
        """The score of the scan turned about the camera's x, y, z by degrees, and m ahead."""
        return self.of_pixels(*_at_pose(self.jumps, pose).projected(self.camera))

    def of_pose_coarsely(self, pose: Floats) -> float:
        """The same, by the largest jumps alone."""
        return self.of_pixels(*_at_pose(self.largest, pose).projected(self.camera))

    def climb(self, start: Floats, steps: Floats) -> tuple[float, Floats]:
        """The best score around a pose, which the largest jumps find, and its pose."""
        _, pose = _climb(self.of_pose_coarsely, start, steps)
        return self.of_pose(pose), pose

    def _as_it_is(self) -> tuple[float, Floats]:
        """The best score of a pose as inexact as a calibration may be, and the pose."""

        def score(pose: Floats) -> float:
            if (np.abs(pose) > _INEXACT).any():
                return -np.inf
            return self.of_pose_coarsely(pose)

        _, pose = _climb(score, _AS_IT_IS, _INEXACT / 4)
        best = max(_AS_IT_IS, pose, key=self.of_pose)
        return self.of_pose(best), best


def _at_pose(jumps: Jumps, pose: Floats) -> Jumps:
    """The jumps turned about the camera's x, y, z by degrees, and m ahead."""
    turn = Rotation.from_euler("xyz", pose[:3], degrees=True).as_matrix()
    return jumps.moved(Extrinsics(turn, np.array([0, 0, pose[3]])))


def _climb(score: Callable[[Floats], float], start: Floats, steps: Floats) -> tuple[float, Floats]:
    """The highest score around `start` (K,), coordinate by coordinate, and where it is."""
    best = score(start)
    at = start
    for _ in range(3):
        before = best
        for axis in np.flatnonzero(steps):
            for sign in (-1, 1):
                while True:
                    tried = at.copy()
                    tried[axis] += sign * steps[axis]
                    value = score(tried)
                    if value <= best:
                        break
                    best = value
                    at = tried
        if best == before:
            break
    return best, at


def _readings(
    judge: _Judge,
    scan: NDArray[np.floating],
    own: Calibration,
    others: Mapping[str, Calibration],
    size: Size,
) -> Iterator[_Fit]:
    """All readings but the scan as it is."""
    yield from _turned(judge)
    yield from _rolled(judge)
    yield from _of_another_time(judge)
    if judge.as_it_is >= _GOOD:
        return
    yield from _mirrored(judge, size)
    # The scan by other axes and cameras, whose points have other jumps.
    for text, reading in _other_readings(own, others).items():
        jumps = _jumps(scan, reading, size)
        if jumps is not None:
            yield _Fit("other", judge.of_pixels(*jumps.projected(reading.camera)), text)
    # The calibration of an image that was resized.
    resized, factor = _resized(own, size)
    jumps = None if resized is None else _jumps(scan, resized, size)
    if resized is not None and jumps is not None:
        xy, weights = jumps.projected(resized.camera)
        scores = [judge.of_pixels((xy + 0.5) * about - 0.5, weights) for about in _ABOUT]
        best = int(np.argmax(scores))
        factor *= float(_ABOUT[best])
        text = f"with the intrinsics × {factor:.3g}, as of an image that was resized"
        yield _Fit("size", scores[best], text)


def _turned(judge: _Judge) -> Iterator[_Fit]:
    """The best turns about the camera's x and y, which are shifts of the image at first."""
    focal_x = float(judge.camera.intrinsics[0, 0])
    focal_y = float(judge.camera.intrinsics[1, 1])
    rows = np.arange(judge.shifted.shape[0]) - judge.shifted.shape[0] // 2
    columns = np.arange(judge.shifted.shape[1]) - judge.shifted.shape[1] // 2
    down_deg = np.degrees(np.arctan(rows / judge.edges.scale / focal_y))[:, None]
    right_deg = np.degrees(np.arctan(columns / judge.edges.scale / focal_x))[None, :]
    # The best shifts that are no small ones, and none of them beside another.
    left = np.where(np.hypot(down_deg, right_deg) < _LEAST_TURN_DEG, -np.inf, judge.shifted)
    for _ in range(_PEAKS):
        row, column = np.unravel_index(left.argmax(), left.shape)
        about_x = -float(down_deg[row, 0])
        about_y = float(right_deg[0, column])
        near = np.hypot(down_deg + about_x, right_deg - about_y) < _LEAST_TURN_DEG
        left = np.where(near, -np.inf, left)
        # From there, turns about all three axes.
        rolls = [np.array([about_x, about_y, roll, 0]) for roll in _ROLLS_DEG]
        pose = max(rolls, key=judge.of_pose_coarsely)
        _, pose = _climb(judge.of_pose_coarsely, pose, np.array([0.4, 0.4, 0.4, 0]))
        best, pose = judge.climb(pose, np.array([0.15, 0.15, 0.15, 0]))
        if np.linalg.norm(pose[:2]) >= _LEAST_TURN_DEG:
            text = (
                f"with the extrinsics turned by {pose[0]:.1f}° about the camera's x,"
                f" {pose[1]:.1f}° about y and {pose[2]:.1f}° about its axis"
            )
            yield _Fit("turn", best, text)


def _rolled(judge: _Judge) -> Iterator[_Fit]:
    """The best turn about the camera's axis."""
    angles = np.arange(_LEAST_TURN_DEG, _MOST_ROLL_DEG + 0.1, 0.5)
    starts = [
        base + np.array([0, 0, sign * angle, 0])
        for base in (_AS_IT_IS, judge.base)
        for angle in angles
        for sign in (-1, 1)
    ]
    start = max(starts, key=judge.of_pose_coarsely)
    best, pose = judge.climb(start, np.array([0.1, 0.1, 0.1, 0]))
    if abs(pose[2]) >= _LEAST_TURN_DEG:
        yield _Fit("roll", best, f"with the extrinsics turned by {pose[2]:.1f}° about its axis")


def _of_another_time(judge: _Judge) -> Iterator[_Fit]:
    """The best way along the camera's axis."""
    ways = np.arange(_LEAST_AHEAD_M, _MOST_AHEAD_M + 0.1, 0.25)
    starts = [
        base + np.array([0, 0, 0, sign * way])
        for base in (_AS_IT_IS, judge.base)
        for way in ways
        for sign in (-1, 1)
    ]
    start = max(starts, key=judge.of_pose_coarsely)
    best, pose = judge.climb(start, np.array([0.1, 0.1, 0.1, 0.1]))
    if abs(pose[3]) >= _LEAST_AHEAD_M:
        where = "ahead" if pose[3] > 0 else "back"
        text = f"{abs(pose[3]):.1f} m {where}, as if the scan was of another time than the image"
        yield _Fit("late", best, text)


def _mirrored(judge: _Judge, size: Size) -> Iterator[_Fit]:
    """The image mirrored and turned, as EXIF says or rows are stored."""
    height, width = size
    xy, weights = judge.jumps.projected(judge.camera)
    left = width - 1 - xy[:, 0]
    up = height - 1 - xy[:, 1]
    opposite = weights * np.array([1, 1, -1])
    changed = [
        ("with the image mirrored", np.column_stack([left, xy[:, 1]]), opposite),
        ("with the image's rows in reverse", np.column_stack([xy[:, 0], up]), opposite),
        ("with the image turned by 180°", np.column_stack([left, up]), weights),
    ]
    if height == width:  # of other images the size tells
        exchanged = weights[:, [1, 0, 2]]
        across = exchanged * np.array([1, 1, -1])
        changed += [
            ("with the image's rows and columns exchanged", xy[:, ::-1], exchanged),
            ("with the image turned by 90°", np.column_stack([xy[:, 1], left]), across),
            ("with the image turned by -90°", np.column_stack([up, xy[:, 0]]), across),
            ("with the image mirrored and turned by 90°", np.column_stack([up, left]), exchanged),
        ]
    for text, pixels, of_pixels in changed:
        yield _Fit("mirror", judge.of_pixels(pixels, of_pixels), text)


def _resized(own: Calibration, size: Size) -> tuple[Calibration | None, float]:
    """The calibration of the image (H, W) if it was resized, and by what; None if it was not.

    An image that was resized has its principal point elsewhere than in its middle, by one factor in
    both directions.
    """
    centre = own.camera.intrinsics[:2, 2] + 0.5
    if centre.min() <= 0:
        return None, 1.0
    across = size[1] / (2 * centre[0])
    down = size[0] / (2 * centre[1])
    factor = math.sqrt(across * down)
    if abs(math.log(across / down)) > _SAME_RATIO or abs(math.log(factor)) < _RESIZED:
        return None, 1.0
    intrinsics = own.camera.intrinsics.copy()
    intrinsics[:2] *= factor
    intrinsics[:2, 2] += 0.5 * factor - 0.5
    return replace(own, camera=replace(own.camera, intrinsics=intrinsics, size=size)), factor


def _other_readings(own: Calibration, others: Mapping[str, Calibration]) -> dict[str, Calibration]:
    """Calibrations of other axes of the scan, of the inverse pose, and the others."""
    scanner = own.known_scanner
    readings = {"with the extrinsics inverted": replace(own, scanner=scanner.inverse())}
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
        changed = Extrinsics(np.asarray(matrix, np.float64), np.zeros(3))
        readings[text] = replace(own, scanner=scanner @ changed)
    return readings | dict(others)


def points_by_reading(scan: NDArray[np.floating], own: Calibration, size: Size) -> dict[str, int]:
    """Returns how many points of a scan (N, 3) are in the image (H, W), by other axes of it."""
    found = dict[str, int]()
    for text, reading in _other_readings(own, {}).items():
        seen = reading.known_scanner.apply(scan)
        found[text] = len(points_in_image(seen, reading.camera, size)[0])
    return found


def _jumps(scan: NDArray[np.floating], reading: Calibration, size: Size) -> Jumps | None:
    """The jumps of depth of the scan (N, 3) that are in the image (H, W)."""
    return jumps_of(scan, reading.camera, reading.known_scanner, size)
