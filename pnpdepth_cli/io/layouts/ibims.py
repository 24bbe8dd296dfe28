"""`ibims`: iBims-1 as images (ibims1_core_raw): rgb/ depth/ mask_invalid/ mask_transp/ calib/.

16-bit depth of 65535 is 50 m. Where one of the masks is 0 (invalid or transparent), it is unknown.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Frame, Listing, by_stem, without_partner
from pnpdepth_cli.io.layouts import Layout

_SCALE = 65535 / 50
_PNG = (".png",)
_MASKS = ("mask_invalid", "mask_transp")


def matches(root: Path) -> bool:
    """Returns whether the folder has rgb/, depth/ and both masks."""
    return all((root / name).is_dir() for name in ("rgb", "depth", *_MASKS))


def listing(root: Path) -> Listing:
    """Returns one frame for each image with depth."""
    images, depths = by_stem(root / "rgb", _PNG), by_stem(root / "depth", _PNG)
    masks = [by_stem(root / name, _PNG) for name in _MASKS]
    frames = [
        Frame(
            name=stem,
            image=image,
            gt=depths[stem],
            gt_scale=_SCALE,
            masks=tuple(mask[stem] for mask in masks if stem in mask),
        )
        for stem, image in images.items()
        if stem in depths
    ]
    return Listing(frames=frames, broken=without_partner(images, depths, root / "depth"))


LAYOUT = Layout(
    matches=matches, listing=listing, needs=("rgb", "depth", "mask_invalid", "mask_transp")
)
