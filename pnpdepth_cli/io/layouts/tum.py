"""`tum`: TUM RGB-D, rgb.txt and depth.txt with a time and a path per line, paired by time.

An associations.txt (of TUM's associate.py, or of ICL-NUIM) pairs them itself: a time and a path
twice per line. Poses are those of groundtruth.txt beside them, at the times of the images.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Pose, Unmatched
from pnpdepth_cli.io.file_bytes import check_value_count, one_line, read_bytes
from pnpdepth_cli.io.layouts.layout import Layout
from pnpdepth_cli.io.poses import read_trajectory

_ASSOCIATIONS = "associations.txt"
_LONGEST_GAP_S = 0.02
"""As the data set's own tool associates them."""
_LONGEST_POSE_GAP_S = 0.1
"""Between poses, which motion capture takes at 100 Hz."""

Timed = tuple[float, Path]


def _matches(root: Path) -> bool:
    names = ("rgb.txt", "depth.txt")
    return (root / _ASSOCIATIONS).is_file() or all((root / name).is_file() for name in names)


def _listing(root: Path) -> Listing:
    """One frame for each image with a depth image within 0.02 s; each is used once."""
    pose_at = _poses_of(root)

    def frame(image: Timed, depth: Timed) -> Frame:
        return Frame(
            name=image[1].stem, image=image[1], gt=depth[1], gt_scale=5000.0, pose=pose_at(image[0])
        )

    if (root / _ASSOCIATIONS).is_file():
        return Listing(frames=[frame(*pair) for pair in _read(root / _ASSOCIATIONS, 2)])
    images, depths = (
        sorted(timed for (timed,) in _read(root / name, 1)) for name in ("rgb.txt", "depth.txt")
    )
    partner_of: dict[int, int] = {}
    taken: set[int] = set()
    for image, depth in _close_pairs(root, images, depths):
        if image not in partner_of and depth not in taken:
            partner_of[image] = depth
            taken.add(depth)
    why = f"has no {{}} within {_LONGEST_GAP_S} s that is not another's"
    return Listing(
        frames=[frame(images[i], depths[partner_of[i]]) for i in sorted(partner_of)],
        spare=tuple(
            Unmatched(path=path, why=why.format(other))
            for timed, used, other in ((images, partner_of, "depth"), (depths, taken, "image"))
            for number, (_, path) in enumerate(timed)
            if number not in used
        ),
    )


def _read(path: Path, count: int) -> list[list[Timed]]:
    """The times and paths of each line: one pair, or those of an image and of its depth."""
    rows = []
    for number, line in enumerate(read_bytes(path).decode("utf-8", "replace").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        pairs = zip(words[::2], words[1::2], strict=False)
        row = [(_time(time), path.parent / file) for time, file in pairs][:count]
        known = [(time, file) for time, file in row if time is not None]
        if len(known) < count or (
            count == 2 and (len(words) != 4 or sum(map(_is_depth, known)) != 1)
        ):
            both = " of rgb, and a time and a path of depth" if count == 2 else ""
            raise FileFormatError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path{both}"
            )
        rows.append(sorted(known, key=_is_depth) if count == 2 else known)
    return rows


def _time(word: str) -> float | None:
    """The time in a word; None if it is no finite number."""
    try:
        return float(word) if math.isfinite(float(word)) else None
    except ValueError:
        return None


def _is_depth(timed: Timed) -> bool:
    return "depth" in timed[1].parts[-2:][0].lower()


def _poses_of(root: Path) -> Callable[[float], Pose | None]:
    """A function from a time to the camera's pose at it; None where there is none."""
    if not (root / "groundtruth.txt").is_file():
        return lambda time_s: None
    trajectory = read_trajectory(root / "groundtruth.txt")

    def pose_at(time_s: float) -> Pose | None:
        pose = trajectory.at(time_s, _LONGEST_POSE_GAP_S)
        return None if pose is None else tuple(map(tuple, pose.tolist()))

    return pose_at


def _close_pairs(root: Path, images: list[Timed], depths: list[Timed]) -> list[list[int]]:
    """Indices of images and depths at most 0.02 s apart, the closest first; times are sorted."""
    image_times, depth_times = (np.array([time for time, _ in each]) for each in (images, depths))
    first = np.searchsorted(depth_times, image_times - 2 * _LONGEST_GAP_S)
    last = np.searchsorted(depth_times, image_times + 2 * _LONGEST_GAP_S, side="right")
    count = last - first
    check_value_count(root, int(count.sum()))
    image = np.repeat(np.arange(len(images)), count)
    depth = np.arange(len(image)) + np.repeat(last - np.cumsum(count), count)
    gap = np.abs(image_times[image] - depth_times[depth])
    pairs = np.column_stack([image, depth])[gap <= _LONGEST_GAP_S]
    order = np.argsort(gap[gap <= _LONGEST_GAP_S], kind="stable")
    closest: list[list[int]] = pairs[order].tolist()
    return closest


TUM = Layout(matches=_matches, listing=_listing, needs=("rgb.txt", "depth.txt"))
