"""`tum`: TUM RGB-D, rgb.txt and depth.txt with a time and a path per line, paired by time.

An associations.txt (of TUM's associate.py, or of ICL-NUIM) pairs them itself: a time and a path
twice per line.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched
from pnpdepth_cli.io.file_bytes import check_value_count, one_line, read_bytes
from pnpdepth_cli.io.layouts import Layout

_SCALE = 5000.0
_ASSOCIATIONS = "associations.txt"
_LONGEST_GAP_S = 0.02
"""As the data set's own tool associates them."""


def matches(root: Path) -> bool:
    """Returns whether the folder has rgb.txt and depth.txt, or associations.txt."""
    names = ("rgb.txt", "depth.txt")
    return (root / _ASSOCIATIONS).is_file() or all((root / name).is_file() for name in names)


def listing(root: Path) -> Listing:
    """Returns one frame for each image with a depth image within 0.02 s; each is used once."""
    if (root / _ASSOCIATIONS).is_file():
        return Listing(frames=_associated(root / _ASSOCIATIONS))
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
    frames = []
    for number, line in enumerate(read_bytes(path).decode("utf-8", "replace").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        files = [path.parent / word for word in words[1::2]]
        depths = [file for file in files if "depth" in file.parts[-2:][0].lower()]
        if len(words) != 4 or len(depths) != 1:
            raise FileFormatError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path of rgb,"
                " and a time and a path of depth"
            )
        (image,) = (file for file in files if file not in depths)
        frames.append(Frame(name=image.stem, image=image, gt=depths[0], gt_scale=_SCALE))
    return frames


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
        try:
            if not math.isfinite(float(words[0])):
                raise ValueError("not finite")
            entries.append((float(words[0]), path.parent / words[1]))
        except (ValueError, IndexError) as error:
            raise FileFormatError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path"
            ) from error
    return sorted(entries)


LAYOUT = Layout(matches=matches, listing=listing, needs=("rgb.txt", "depth.txt"))
