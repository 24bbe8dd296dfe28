"""Whether a scan belongs to its image, or would belong to it better if something was different.

One score, `sensors.edge_fit`, judges the scan as it is and all alternatives: the scan turned, moved
along the camera's axis as by a difference of time, by other axes, another camera, a mirrored image,
a calibration of another size. The verdict is one of three: nothing is said, or an alternative that
is better is named, or the two do not seem to fit. Nothing is moved.
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

# How far a scan may be turned and moved.
_MOST_TURN_DEG = 9.0
"""Largest turn about the camera's x and y that is searched."""
_LEAST_TURN_DEG = 1.0
"""Smallest turn that is told; below, a calibration is taken for inexact."""
_MOST_ROLL_DEG = 10.0
"""Largest turn about the camera's axis that is searched."""
_MOST_AHEAD_M = 3.0
"""Largest way along the camera's axis that is searched: 0.1 s at 30 m/s."""
_LEAST_AHEAD_M = 0.5
"""Smallest way that is told: 0.1 s at 5 m/s."""
_MOST_DOWN = 1 / 3
"""Fraction of the image's height by which points are shifted at most."""
_ROLLS_DEG = np.arange(-5.0, 5.1, 0.5)
"""Turns about the camera's axis that are tried with each turn about x and y."""

# An image that was resized.
_RESIZED = 0.1
"""Log ratio of the image's size and twice the principal point, from which an image was resized."""
_SAME_RATIO = 0.12
"""Difference of these log ratios across and down, up to which one factor explains both."""
_AROUND_FACTOR = np.linspace(0.88, 1.12, 97)
"""Multiples of the ratio that are tried, as principal points are not exactly in the middle."""

# The search. A pose is (4,): degrees about the camera's x, y and z, and metres ahead.
_COARSE = 0.4
"""Fraction of the largest weight, from which jumps of depth are in the quick search."""
_AS_IT_IS = np.zeros(4)
"""The pose that moves nothing."""
_INEXACT = np.array([0.5, 0.5, 0.5, 0.3])
"""The pose that a right calibration may be off, of either sign."""
_ROLL_STEP_DEG = 0.5
"""Between turns about the camera's axis that are tried by themselves."""
_AHEAD_STEP_M = 0.25
"""Between ways along the camera's axis that are tried."""
_TURN_STEPS = np.array([0.4, 0.4, 0.4, 0])
"""Steps of a pose, by which turns are climbed at first."""
_FINE_TURN_STEPS = np.array([0.15, 0.15, 0.15, 0])
"""Steps of a pose, by which they are climbed then."""
_ROLL_STEPS = np.array([0.1, 0.1, 0.1, 0])
"""Steps of a pose, by which turns about the camera's axis are climbed."""
_AHEAD_STEPS = np.array([0.1, 0.1, 0.1, 0.1])
"""Steps of a pose, by which ways along the camera's axis are climbed."""
_PEAKS = 3
"""Best shifts, from which turns are searched."""
_ROUNDS = 3
"""Times that all coordinates of a pose are climbed, at most."""
_GOOD = 5.0
"""Score of the scan as it is, from which axes, cameras and mirrors are not tried."""

# The verdict. Scores are in standard deviations by chance.
_SOME_JUMPS = 60
"""Jumps of depth; fewer tell nothing."""
_MANY_JUMPS = 250
"""Jumps of depth, from which less is needed."""
_BY_CHANCE = 2.5
"""Score; a scan of many jumps that belongs to its image has more."""


class _Needed(NamedTuple):
    """What an alternative to the scan as it is needs, at least, so that a person is told of it.

    The more alternatives of a kind there are, the better is the best of them by chance. All numbers
    are from right and wrong inputs made of KITTI's frames for object detection and depth completion
    by `benchmarks.scan_fit`, whose other frames report what comes of them.
    """

    score: float
    more: float
    """By how much the score must exceed that of the scan as it is."""


_NEEDED = {
    "turn": _Needed(score=5.0, more=2.5),
    "roll": _Needed(score=5.0, more=2.5),
    "late": _Needed(score=5.0, more=2.0),
    "mirror": _Needed(score=4.5, more=1.5),
    "other": _Needed(score=4.5, more=1.5),
    "size": _Needed(score=4.5, more=1.5),
}
"""By the kind of alternative."""
_NEEDED_OF_FEW = {
    "turn": _Needed(score=7.0, more=4.5),
    "roll": _Needed(score=6.0, more=3.0),
    "late": _Needed(score=5.5, more=3.0),
    "mirror": _Needed(score=5.0, more=2.5),
    "other": _Needed(score=5.0, more=2.5),
    "size": _Needed(score=5.0, more=2.5),
}
"""The same of scans with fewer than `_MANY_JUMPS`."""


class _Alternative(NamedTuple):
    """An alternative to the scan as it is, such as the scan turned, and how well it fits."""

    kind: str
    """A key of `_NEEDED`."""
    score: float
    """How well it belongs to the image, in standard deviations by chance."""
    text: str
    """What is different, as a line for a person ends."""


def fit_warning(
    scan: NDArray[np.floating],
    calibration: Calibration,
    others: Mapping[str, Calibration],
    rgb: NDArray[np.float32],
    *,
    is_whole: bool = True,
) -> list[str]:
    """Returns a warning if the image's edges contradict how the scan is projected, or none.

    They do if they meet the scan's jumps of depth clearly better with an alternative, such as the
    scan turned, or no better than by chance.

    Args:
        scan: (N, 3) metres in the scanner's coordinates.
        calibration: The calibration that projects the scan.
        others: Further calibrations, such as those of other cameras, by the option that gives each.
        rgb: (H, W, 3) in 0…1, the image.
        is_whole: Whether the points are the returns of a scanner. The jumps of other clouds are
            known as inexactly as their points are far apart. So few of them tell nothing, and many
            may fit no better than by chance.
    """
    # Too few jumps of depth tell nothing.
    size = (rgb.shape[0], rgb.shape[1])
    jumps = _jumps(scan, calibration, size)
    fewest_jumps = _SOME_JUMPS if is_whole else _MANY_JUMPS
    if jumps is None or jumps.clear < fewest_jumps:
        return []
    # Alternatives that fit well, and clearly better than the scan as it is.
    judge = _Judge(rgb, calibration.camera, jumps)
    needed_by_kind = _NEEDED if jumps.clear >= _MANY_JUMPS else _NEEDED_OF_FEW
    better = list[_Alternative]()
    for alternative in _alternatives(judge, scan, calibration, others, size):
        needed = needed_by_kind[alternative.kind]
        least_score = max(needed.score, judge.score_as_it_is + needed.more)
        if alternative.score >= least_score:
            better.append(alternative)
    if better:
        best = max(better, key=lambda alternative: alternative.score)
        return [
            "warning: the image's edges meet the scan's jumps of depth better"
            f" {best.text}: {best.score:.1f} standard deviations above chance instead of"
            f" {judge.score_as_it_is:.1f}; check calibration and times"
        ]
    # No alternative is better, and the scan as it is fits no better than by chance.
    if is_whole and judge.score_as_it_is < _BY_CHANCE and jumps.clear >= _MANY_JUMPS:
        return [
            "warning: the image's edges do not meet the scan's jumps of depth"
            f" ({judge.score_as_it_is:.1f} standard deviations above chance), and no turn, shift,"
            " mirror or camera that was tried is better; check that image, scan and calibration"
            " belong together"
        ]
    return []


class _Judge:
    """How well one scan, moved by a pose, belongs to its image.

    Scores are in standard deviations by chance. A pose is (4,): degrees about the camera's x, y and
    z, and metres ahead.
    """

    def __init__(self, rgb: NDArray[np.float32], camera: Camera, jumps: Jumps) -> None:
        """Finds what chance is, and how well the scan as it is belongs to the image.

        Args:
            rgb: (H, W, 3) in 0…1, the image.
            camera: The camera that the scan is projected by.
            jumps: Where depth jumps in the scan, in that camera's coordinates.
        """
        self.edges: EdgeMap = edge_map(rgb)
        self.camera = camera
        self.jumps = jumps
        self.largest_jumps = jumps.largest(_COARSE)
        # Chance is the correlation with the edges at all shifts of the image.
        focal_px = float(camera.intrinsics[0, 0])
        across_px = math.tan(math.radians(_MOST_TURN_DEG)) * focal_px
        down_px = min(across_px, _MOST_DOWN * rgb.shape[0])
        xy, weights = jumps.projected(camera)
        self.shifted = self.edges.shifted(xy, weights, (down_px, across_px))
        self.chance = float(self.shifted.mean())
        self.spread = float(self.shifted.std()) + 1e-9  # above 0, of an image without edges
        # No calibration is exact: the scan as it is may be off by so little.
        self.score_as_it_is, self.pose_as_it_is = self._as_it_is()

    def of_pixels(self, xy: Floats, weights: Floats) -> float:
        """The score of weights (N, 3), as `Jumps.projected` gives them, at pixels (N, 2)."""
        return (self.edges.score(xy, weights) - self.chance) / self.spread

    def of_pose(self, pose: Floats) -> float:
        """The score of the scan moved by a pose (4,)."""
        xy, weights = _at_pose(self.jumps, pose).projected(self.camera)
        return self.of_pixels(xy, weights)

    def of_pose_coarsely(self, pose: Floats) -> float:
        """As `of_pose`, by the largest jumps of depth alone: quick, for the search."""
        xy, weights = _at_pose(self.largest_jumps, pose).projected(self.camera)
        return self.of_pixels(xy, weights)

    def climb(self, start: Floats, steps: Floats) -> tuple[float, Floats]:
        """The best pose (4,) around another, which the largest jumps find, after its score.

        Args:
            start: Pose (4,) from which the search begins.
            steps: Steps (4,) of its coordinates; one of 0 stays as it is.
        """
        _, pose = _climb(self.of_pose_coarsely, start, steps)
        return self.of_pose(pose), pose

    def _as_it_is(self) -> tuple[float, Floats]:
        """The best score of a pose (4,) as inexact as a calibration may be, and that pose."""

        def score(pose: Floats) -> float:
            """The quick score of a pose; −∞ if no calibration is off by so much."""
            if (np.abs(pose) > _INEXACT).any():
                return -np.inf
            return self.of_pose_coarsely(pose)

        _, pose = _climb(score, _AS_IT_IS, _INEXACT / 4)
        best = max(_AS_IT_IS, pose, key=self.of_pose)
        return self.of_pose(best), best


def _at_pose(jumps: Jumps, pose: Floats) -> Jumps:
    """The jumps turned about the camera's x, y, z by degrees pose[:3], and pose[3] metres ahead."""
    turn = Rotation.from_euler("xyz", pose[:3], degrees=True).as_matrix()
    return jumps.moved(Extrinsics(turn, np.array([0, 0, pose[3]])))


def _climb(score: Callable[[Floats], float], start: Floats, steps: Floats) -> tuple[float, Floats]:
    """The highest score around a place (K,), coordinate by coordinate; and where it is, (K,).

    The search ends where no step raises the score, or after `_ROUNDS` of all coordinates.

    Args:
        score: Function of a place that is to be high.
        start: Place from which the search begins.
        steps: Steps (K,) of its coordinates; one of 0 stays as it is.
    """
    best_score = score(start)
    best = start
    for _ in range(_ROUNDS):
        score_before = best_score
        for axis in np.flatnonzero(steps):
            for sign in (-1, 1):
                # In one direction, as long as the score rises.
                while True:
                    tried = best.copy()
                    tried[axis] += sign * steps[axis]
                    tried_score = score(tried)
                    if tried_score <= best_score:
                        break
                    best_score = tried_score
                    best = tried
        if best_score == score_before:
            break
    return best_score, best


def _alternatives(
    judge: _Judge,
    scan: NDArray[np.floating],
    calibration: Calibration,
    others: Mapping[str, Calibration],
    size: Size,
) -> Iterator[_Alternative]:
    """Yields the alternatives to the scan as it is, with their scores.

    Args:
        judge: Scores of the scan.
        scan: (N, 3) metres in the scanner's coordinates.
        calibration: The calibration that projects the scan.
        others: Further calibrations, by the option or file that gives each.
        size: (H, W) of the image.
    """
    yield from _turned(judge)
    yield from _rolled(judge)
    yield from _of_another_time(judge)
    if judge.score_as_it_is >= _GOOD:  # its axes and its camera are right
        return
    yield from _mirrored(judge, size)
    # The scan by other axes and cameras, whose points have other jumps.
    for text, other in _other_calibrations(calibration, others).items():
        jumps = _jumps(scan, other, size)
        if jumps is not None:
            yield _Alternative("other", judge.of_pixels(*jumps.projected(other.camera)), text)
    # The calibration of an image that was resized.
    resized, factor = _resized(calibration, size)
    jumps = None if resized is None else _jumps(scan, resized, size)
    if resized is not None and jumps is not None:
        xy, weights = jumps.projected(resized.camera)
        # Pixels scale about the image's corner, which is at -0.5.
        scores = [judge.of_pixels((xy + 0.5) * near - 0.5, weights) for near in _AROUND_FACTOR]
        best = int(np.argmax(scores))
        factor *= float(_AROUND_FACTOR[best])
        text = f"with the intrinsics × {factor:.3g}, as of an image that was resized"
        yield _Alternative("size", scores[best], text)


def _turned(judge: _Judge) -> Iterator[_Alternative]:
    """Yields the best turns about the camera's x and y, which are shifts of the image at first."""
    # The angles of all shifts, whose middle is no shift: (rows, 1) down and (1, columns) right.
    focal_x_px = float(judge.camera.intrinsics[0, 0])
    focal_y_px = float(judge.camera.intrinsics[1, 1])
    rows = np.arange(judge.shifted.shape[0]) - judge.shifted.shape[0] // 2
    columns = np.arange(judge.shifted.shape[1]) - judge.shifted.shape[1] // 2
    down_deg = np.degrees(np.arctan(rows / judge.edges.scale / focal_y_px))[:, None]
    right_deg = np.degrees(np.arctan(columns / judge.edges.scale / focal_x_px))[None, :]
    # The best shifts that are no small ones, and none of them beside another.
    is_small = np.hypot(down_deg, right_deg) < _LEAST_TURN_DEG
    remaining = np.where(is_small, -np.inf, judge.shifted)
    for _ in range(_PEAKS):
        row, column = np.unravel_index(remaining.argmax(), remaining.shape)
        # With x right, y down and z ahead, a negative turn about x moves points down, and a
        # positive one about y moves them right.
        about_x = -float(down_deg[row, 0])
        about_y = float(right_deg[0, column])
        is_beside = np.hypot(down_deg + about_x, right_deg - about_y) < _LEAST_TURN_DEG
        remaining = np.where(is_beside, -np.inf, remaining)
        # From there, turns about all three axes.
        rolls = [np.array([about_x, about_y, roll, 0]) for roll in _ROLLS_DEG]
        pose = max(rolls, key=judge.of_pose_coarsely)
        _, pose = _climb(judge.of_pose_coarsely, pose, _TURN_STEPS)
        best, pose = judge.climb(pose, _FINE_TURN_STEPS)
        if np.linalg.norm(pose[:2]) >= _LEAST_TURN_DEG:
            text = (
                f"with the extrinsics turned by {pose[0]:.1f}° about the camera's x,"
                f" {pose[1]:.1f}° about y and {pose[2]:.1f}° about its axis"
            )
            yield _Alternative("turn", best, text)


def _rolled(judge: _Judge) -> Iterator[_Alternative]:
    """Yields the best turn about the camera's axis, unless it is small."""
    # Turns of the scan as it is, and of the best pose that its calibration may mean.
    angles = np.arange(_LEAST_TURN_DEG, _MOST_ROLL_DEG + 0.1, _ROLL_STEP_DEG)
    starts = [
        base + np.array([0, 0, sign * angle, 0])
        for base in (_AS_IT_IS, judge.pose_as_it_is)
        for angle in angles
        for sign in (-1, 1)
    ]
    start = max(starts, key=judge.of_pose_coarsely)
    # Around the best of these.
    best, pose = judge.climb(start, _ROLL_STEPS)
    if abs(pose[2]) >= _LEAST_TURN_DEG:
        yield _Alternative(
            "roll", best, f"with the extrinsics turned by {pose[2]:.1f}° about its axis"
        )


def _of_another_time(judge: _Judge) -> Iterator[_Alternative]:
    """Yields the best way along the camera's axis, unless it is short."""
    # Ways of the scan as it is, and of the best pose that its calibration may mean.
    ways = np.arange(_LEAST_AHEAD_M, _MOST_AHEAD_M + 0.1, _AHEAD_STEP_M)
    starts = [
        base + np.array([0, 0, 0, sign * way])
        for base in (_AS_IT_IS, judge.pose_as_it_is)
        for way in ways
        for sign in (-1, 1)
    ]
    start = max(starts, key=judge.of_pose_coarsely)
    # Around the best of these.
    best, pose = judge.climb(start, _AHEAD_STEPS)
    if abs(pose[3]) >= _LEAST_AHEAD_M:
        where = "ahead" if pose[3] > 0 else "back"
        text = f"{abs(pose[3]):.1f} m {where}, as if the scan was of another time than the image"
        yield _Alternative("late", best, text)


def _mirrored(judge: _Judge, size: Size) -> Iterator[_Alternative]:
    """Yields the image mirrored and turned, as EXIF says or as rows are stored.

    The points are put where the mirrored image has them. Their weights are x·x, y·y and x·y of the
    direction of a jump of depth: a mirror changes the sign of x·y, and an exchange of x and y
    exchanges the first two.
    """
    # Pixels from each side of the image.
    height, width = size
    xy, weights = judge.jumps.projected(judge.camera)
    x, y = xy.T
    from_right = width - 1 - x
    from_bottom = height - 1 - y
    # What keeps the image's size.
    mirrored = weights * np.array([1, 1, -1])
    mirrors = [
        ("with the image mirrored", np.column_stack([from_right, y]), mirrored),
        ("with the image's rows in reverse", np.column_stack([x, from_bottom]), mirrored),
        ("with the image turned by 180°", np.column_stack([from_right, from_bottom]), weights),
    ]
    # What exchanges its sides: of an image that is no square, the size tells.
    if height == width:
        exchanged = weights[:, [1, 0, 2]]
        turned = exchanged * np.array([1, 1, -1])
        mirrors += [
            ("with the image's rows and columns exchanged", np.column_stack([y, x]), exchanged),
            ("with the image turned by 90°", np.column_stack([y, from_right]), turned),
            ("with the image turned by -90°", np.column_stack([from_bottom, x]), turned),
            (
                "with the image mirrored and turned by 90°",
                np.column_stack([from_bottom, from_right]),
                exchanged,
            ),
        ]
    for text, pixels, pixel_weights in mirrors:
        yield _Alternative("mirror", judge.of_pixels(pixels, pixel_weights), text)


def _resized(calibration: Calibration, size: Size) -> tuple[Calibration | None, float]:
    """The calibration of a resized image (H, W), and the factor of its intrinsics.

    An image was resized if the principal point that the calibration states is not in its middle,
    but would be if both coordinates were multiplied by one factor.

    Args:
        calibration: The calibration, which may be of the image before it was resized.
        size: (H, W) of the image.

    Returns:
        None and 1 if the image was not resized.
    """
    centre_px = calibration.camera.intrinsics[:2, 2] + 0.5  # from the image's corner
    if centre_px.min() <= 0:
        return None, 1.0
    across = size[1] / (2 * centre_px[0])
    down = size[0] / (2 * centre_px[1])
    factor = math.sqrt(across * down)
    if abs(math.log(across / down)) > _SAME_RATIO or abs(math.log(factor)) < _RESIZED:
        return None, 1.0
    # The intrinsics of an image resized by the factor, about its corner.
    intrinsics = calibration.camera.intrinsics.copy()
    intrinsics[:2] *= factor
    intrinsics[:2, 2] += 0.5 * factor - 0.5
    return replace(
        calibration, camera=replace(calibration.camera, intrinsics=intrinsics, size=size)
    ), factor


def _other_calibrations(
    calibration: Calibration, others: Mapping[str, Calibration]
) -> dict[str, Calibration]:
    """Other calibrations by which the scan may have to be projected, by words for a person.

    They are those of other axes of the scan, of the inverse of the scanner's pose, and `others`.

    Args:
        calibration: The calibration that projects the scan.
        others: Further calibrations, by words for a person.
    """
    scanner = calibration.known_scanner
    calibrations = {"with the extrinsics inverted": replace(calibration, scanner=scanner.inverse())}
    for text, matrix in (
        ("with x of the scan negated", np.diag([-1.0, 1.0, 1.0])),
        (
            "with y of the scan negated, as of left-handed ones (CARLA, Unity)",
            np.diag([1.0, -1.0, 1.0]),
        ),
        ("with z of the scan negated", np.diag([1.0, 1.0, -1.0])),
        ("with x and y of the scan exchanged", np.eye(3)[[1, 0, 2]]),
        ("with the scan turned by 180° about z", np.diag([-1.0, -1.0, 1.0])),
    ):
        other_axes = Extrinsics(np.asarray(matrix, np.float64), np.zeros(3))
        calibrations[text] = replace(calibration, scanner=scanner @ other_axes)
    return calibrations | dict(others)


def points_by_alternative(
    scan: NDArray[np.floating], calibration: Calibration, size: Size
) -> dict[str, int]:
    """Returns how many points of a scan are in the image if its axes or its pose are different.

    The counts are by words for a person, such as "with z of the scan negated".

    Args:
        scan: (N, 3) metres in the scanner's coordinates.
        calibration: The calibration that projects the scan.
        size: (H, W) of the image.
    """
    counts = dict[str, int]()
    for text, other in _other_calibrations(calibration, {}).items():
        xyz = other.known_scanner.apply(scan)
        seen, _ = points_in_image(xyz, other.camera, size)
        counts[text] = len(seen)
    return counts


def _jumps(scan: NDArray[np.floating], calibration: Calibration, size: Size) -> Jumps | None:
    """The jumps of depth of a scan (N, 3) that are in the image (H, W); None if too few are."""
    return jumps_of(scan, calibration.camera, calibration.known_scanner, size)
