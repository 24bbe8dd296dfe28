"""`tum`: TUM RGB-D, rgb.txt and depth.txt with a time and a path per line, paired by time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts import Layout

_SCALE = 5000.0
_LONGEST_GAP_S = 0.02
"""As the data set's own tool associates them."""


def matches(root: Path) -> bool:
    """Returns whether the folder has rgb.txt and depth.txt."""
    return (root / "rgb.txt").is_file() and (root / "depth.txt").is_file()


def listing(root: Path) -> Listing:
    """Returns one frame for each image with a depth image within 0.02 s; each is used once."""
    images, depths = _listed(root / "rgb.txt"), _listed(root / "depth.txt")
    gap = np.abs(np.subtract.outer([t for t, _ in images], [t for t, _ in depths]))
    close = np.argwhere(gap <= _LONGEST_GAP_S)
    partner_of: dict[int, int] = {}
    taken: set[int] = set()
    for image, depth in close[np.argsort(gap[tuple(close.T)], kind="stable")].tolist():
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


def _listed(path: Path) -> list[tuple[float, Path]]:
    entries = []
    for number, line in enumerate(read_bytes(path).decode("utf-8", "replace").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            entries.append((float(words[0]), path.parent / words[1]))
        except (ValueError, IndexError) as error:
            raise FileFormatError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path"
            ) from error
    return sorted(entries)


LAYOUT = Layout(matches=matches, listing=listing)
