"""`scannet`: ScanNet's exported scans: color/ depth/ intrinsic/ and pose/, in one or more scene*/.

Depth is in millimetres and smaller than the images; its pixels are moved to them.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.frame import (
    IMAGE_SUFFIXES,
    Frame,
    Listing,
    Unmatched,
    by_stem,
    without_partner,
)
from pnpdepth_cli.io.layouts import Layout

_SCALE = 1000.0


def matches(root: Path) -> bool:
    """Returns whether the folder, or one at most two levels below, is an exported scan."""
    return bool(_scenes(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each colour image with depth, in the order of their numbers."""
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    for scene in _scenes(root):
        images = by_stem(scene / "color", IMAGE_SUFFIXES)
        depths = by_stem(scene / "depth", (".png",))
        frames += [
            Frame(
                name=stem if scene == root else f"{scene.name}/{stem}",
                image=images[stem],
                gt=depths[stem],
                gt_scale=_SCALE,
                gt_other_size=True,
            )
            for stem in sorted(images, key=lambda stem: (len(stem), stem))
            if stem in depths
        ]
        broken += without_partner(images, depths, scene / "depth")
    return Listing(frames=frames, broken=tuple(broken))


def _scenes(root: Path) -> list[Path]:
    scenes = {p.parent for start in ("", "*/", "*/*/") for p in root.glob(f"{start}intrinsic")}
    return sorted(p for p in scenes if all((p / name).is_dir() for name in ("color", "depth")))


LAYOUT = Layout(matches=matches, listing=listing, needs=("color", "depth", "intrinsic"))
