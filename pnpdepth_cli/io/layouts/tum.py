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

_SCALE = 5000.0
_ASSOCIATIONS = "associations.txt"
_LONGEST_GAP_S = 0.02
"""As the data set's own tool associates them."""
_TRAJECTORY = "groundtruth.txt"
_LONGEST_POSE_GAP_S = 0.1
"""Between poses, which motion capture takes at 100 Hz."""


def matches(root: Path) -> bool:
    """Returns whether the folder has rgb.txt and depth.txt, or associations.txt."""
    names = ("rgb.txt", "depth.txt")
    return (root / _ASSOCIATIONS).is_file() or all((root / name).is_file() for name in names)


def listing(root: Path) -> Listing:
    """Returns one frame for each image with a depth image within 0.02 s; each is used once."""
    if (root / _ASSOCIATIONS).is_file():
        return Listing(frames=_associated(root / _ASSOCIATIONS))
    pose_at = _poses_of(root)
    images, depths = _listed(root / "rgb.txt"), _listed(root / "depth.txt")
    partner_of: dict[int, int] = {}
    taken: set[int] = set()
    for image, depth in _close_pairs(root, [t for t, _ in images], [t for t, _ in depths]):
        if image not in partner_of and depth not in taken:
            partner_of[image] = depth
            taken.add(depth)
    frames = [
        Frame(
            name=images[i][1].stem,
            image=images[i][1],
            gt=depths[partner_of[i]][1],
            gt_scale=_SCALE,
            pose=pose_at(images[i][0]),
        )
        for i in sorted(partner_of)
    ]
    why = f"has no {{}} within {_LONGEST_GAP_S} s that is not another's"
    spare = [
        *(
            Unmatched(path=p, why=why.format("depth"))
            for i, (_, p) in enumerate(images)
            if i not in partner_of
        ),
        *(
            Unmatched(path=p, why=why.format("image"))
            for i, (_, p) in enumerate(depths)
            if i not in taken
        ),
    ]
    return Listing(frames=frames, spare=tuple(spare))


def _associated(path: Path) -> list[Frame]:
    """The frames of a file of pairs, whichever of the two comes first."""
    frames, pose_at = [], _poses_of(path.parent)
    for number, line in enumerate(read_bytes(path).decode("utf-8", "replace").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        files = [path.parent / word for word in words[1::2]]
        depths = [file for file in files if "depth" in file.parts[-2:][0].lower()]
        times = [_time(word) for word in words[::2]]
        if len(words) != 4 or len(depths) != 1 or None in times:
            raise FileFormatError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path of rgb,"
                " and a time and a path of depth"
            )
        ((time_s, image),) = (
            each for each in zip(times, files, strict=True) if each[1] not in depths
        )
        frames.append(
            Frame(
                name=image.stem,
                image=image,
                gt=depths[0],
                gt_scale=_SCALE,
                pose=None if time_s is None else pose_at(time_s),
            )
        )
    return frames


def _time(word: str) -> float | None:
    """The time in a word; None if it is no finite number."""
    try:
        return float(word) if math.isfinite(float(word)) else None
    except ValueError:
        return None


def _poses_of(root: Path) -> Callable[[float], Pose | None]:
    """A function from a time to the camera's pose at it; None where there is none."""
    if not (root / _TRAJECTORY).is_file():
        return lambda time_s: None
    trajectory = read_trajectory(root / _TRAJECTORY)

    def pose_at(time_s: float) -> Pose | None:
        pose = trajectory.at(time_s, _LONGEST_POSE_GAP_S)
        return None if pose is None else tuple(map(tuple, pose.tolist()))

    return pose_at


def _close_pairs(
    root: Path, image_times: list[float], depth_times: list[float]
) -> list[tuple[int, int]]:
    """Indices of images and depths at most 0.02 s apart, the closest first; times are sorted."""
    images, depths = np.array(image_times), np.array(depth_times)
    first = np.searchsorted(depths, images - 2 * _LONGEST_GAP_S)
    count = np.searchsorted(depths, images + 2 * _LONGEST_GAP_S, side="right") - first
    check_value_count(root, int(count.sum()))
    image = np.repeat(np.arange(len(images)), count)
    depth = np.arange(len(image)) + np.repeat(first - np.cumsum(count) + count, count)
    gap = np.abs(images[image] - depths[depth])
    pairs = np.column_stack([image, depth])[gap <= _LONGEST_GAP_S]
    order = np.argsort(gap[gap <= _LONGEST_GAP_S], kind="stable")
    return [(int(i), int(j)) for i, j in pairs[order]]


def _listed(path: Path) -> list[tuple[float, Path]]:
    entries = []
    for number, line in enumerate(read_bytes(path).decode("utf-8", "replace").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        time_s = _time(words[0])
        if time_s is None or len(words) < 2:
            raise FileFormatError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path"
            )
        entries.append((time_s, path.parent / words[1]))
    return sorted(entries)


TUM = Layout(matches=matches, listing=listing, needs=("rgb.txt", "depth.txt"))
