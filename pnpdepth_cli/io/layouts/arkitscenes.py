"""`arkitscenes`: ARKitScenes' upsampling set, <video>/ with wide/ lowres_depth/ highres_depth/.

The images are in wide/, color/ or lowres_wide/. The low resolution depth of the phone is the sparse
depth, that of the laser scanner the ground truth; both are in millimetres.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched, by_stem, without_partner
from pnpdepth_cli.io.layouts import Layout

_PNG = (".png",)
_SCALE = 1000.0


def matches(root: Path) -> bool:
    """Returns whether there is a video with images and depth, at most two levels below."""
    return bool(_videos(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each image with low resolution depth."""
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    for video in _videos(root):
        images = by_stem(_images(video) or video, _PNG)
        sparse = by_stem(video / "lowres_depth", _PNG)
        gt = by_stem(video / "highres_depth", _PNG)
        prefix = "" if video == root else f"{video.name}/"
        frames += [
            Frame(
                name=f"{prefix}{stem}",
                image=image,
                sparse=sparse[stem],
                sparse_scale=_SCALE,
                sparse_other_size=True,
                gt=gt.get(stem),
                gt_scale=_SCALE,
                gt_other_size=True,
            )
            for stem, image in images.items()
            if stem in sparse
        ]
        broken += without_partner(images, sparse, video / "lowres_depth")
    return Listing(frames=frames, broken=tuple(broken))


def _videos(root: Path) -> list[Path]:
    videos = {p.parent for start in ("", "*/", "*/*/") for p in root.glob(f"{start}lowres_depth")}
    return sorted(video for video in videos if _images(video) is not None)


def _images(video: Path) -> Path | None:
    folders = (video / name for name in ("wide", "color", "lowres_wide"))
    return next((folder for folder in folders if folder.is_dir()), None)


LAYOUT = Layout(
    matches=matches, listing=listing, needs=("*/wide", "*/lowres_depth", "*/highres_depth")
)
