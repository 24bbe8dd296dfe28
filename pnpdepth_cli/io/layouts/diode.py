"""`diode`: DIODE, NAME.png with NAME_depth.npy and NAME_depth_mask.npy in <scene>/<scan>/.

Depth is in metres and taken as z; where the mask is 0, it is unknown.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched
from pnpdepth_cli.io.layouts import Layout

_DEPTH = "_depth.npy"
_LEVELS = ("", "*/", "*/*/", "*/*/*/", "*/*/*/*/")
"""Of the folders of scans below the root, which may also be that of a split or of all of them."""


def matches(root: Path) -> bool:
    """Returns whether there is a depth file with its mask."""
    depth = (p for start in _LEVELS for p in root.glob(f"{start}*{_DEPTH}"))
    first = next(depth, None)
    return first is not None and _mask(first).is_file()


def listing(root: Path) -> Listing:
    """Returns one frame for each depth file with an image."""
    frames, broken = [], []
    for depth in sorted(p for start in _LEVELS for p in root.glob(f"{start}*{_DEPTH}")):
        image = depth.with_name(depth.name.removesuffix(_DEPTH) + ".png")
        absent = [path for path in (image, _mask(depth)) if not path.is_file()]
        if absent:
            why = f"has no {absent[0].name} beside it; add or remove one"
            broken.append(Unmatched(path=depth, why=why))
            continue
        name = image.relative_to(root).with_suffix("").as_posix()
        frames.append(Frame(name=name, image=image, gt=depth, masks=(_mask(depth),)))
    return Listing(frames=frames, broken=tuple(broken))


def _mask(depth: Path) -> Path:
    return depth.with_name(depth.name.removesuffix(_DEPTH) + "_depth_mask.npy")


LAYOUT = Layout(matches=matches, listing=listing, needs=("*_depth.npy", "*_depth_mask.npy"))
