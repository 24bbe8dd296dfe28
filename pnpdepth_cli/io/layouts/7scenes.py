"""`7scenes`: frame-000000.color.png and frame-000000.depth.png, in the folder or in its seq-*/."""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.frame import IMAGE_SUFFIXES, Frame, Listing, Unmatched
from pnpdepth_cli.io.layouts import Layout

_SCALE = 1000.0


def matches(root: Path) -> bool:
    """Returns whether there is a frame-*.color.* image."""
    return bool(_images(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each colour image with depth."""
    shared = root / "camera-intrinsics.txt"
    frames, broken = [], []
    for image in _images(root):
        number = image.name.split(".")[0]
        depth = image.with_name(f"{number}.depth.png")
        if not depth.is_file():
            why = f"has no {depth.name} beside it; add or remove one"
            broken.append(Unmatched(path=image, why=why))
            continue
        frames.append(
            Frame(
                name=number if image.parent == root else f"{image.parent.name}_{number}",
                image=image,
                gt=depth,
                gt_scale=_SCALE,
                calib=shared if shared.is_file() else None,
            )
        )
    return Listing(frames=frames, broken=tuple(broken))


def _images(root: Path) -> list[Path]:
    paths = [*root.glob("frame-*.color.*"), *root.glob("seq-*/frame-*.color.*")]
    return sorted(p for p in paths if p.suffix.lower() in IMAGE_SUFFIXES)


LAYOUT = Layout(matches=matches, listing=listing, needs=("frame-*.color.*",))
