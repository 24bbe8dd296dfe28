"""`hypersim`: Hypersim, ai_*/images/scene_cam_*_final_preview/ and scene_cam_*_geometry_hdf5/.

The images are the tone-mapped previews. depth_meters is the distance from the camera's centre; z is
computed with the focal length of a field of view of 60 degrees, 886.81 pixels for a width of 1024.
The cameras of some scenes differ slightly from it.
"""

from __future__ import annotations

import re
from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Frame, Hdf5Array, Listing, Unmatched
from pnpdepth_cli.io.layouts import Layout

_IMAGES = "scene_cam_*_final_preview"
_FOCAL_PX = 886.81
_FRAME = re.compile(r"(frame\.\d+)\.tonemap\.jpg")


def matches(root: Path) -> bool:
    """Returns whether there are previews at most two levels below."""
    return bool(_cameras(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each tone-mapped preview with depth."""
    frames, broken = [], []
    for folder in _cameras(root):
        camera = folder.name.removesuffix("_final_preview")
        scene = folder.parents[1].name
        for image in sorted(folder.iterdir()):
            match = _FRAME.fullmatch(image.name)
            if match is None:
                continue
            depth = folder.with_name(f"{camera}_geometry_hdf5") / f"{match[1]}.depth_meters.hdf5"
            if not depth.is_file():
                why = f"has no {depth.parent.name}/{depth.name}; add or remove one"
                broken.append(Unmatched(path=image, why=why))
                continue
            array = Hdf5Array(path=depth, name="dataset", axes=(0, 1), focal_px=_FOCAL_PX)
            name = f"{scene}/{camera.removeprefix('scene_')}_{match[1]}"
            frames.append(Frame(name=name, image=image, gt=array, group=f"{scene}/{camera}"))
    return Listing(frames=frames, broken=tuple(broken))


def _cameras(root: Path) -> list[Path]:
    starts = ("", "images/", "*/images/", "*/*/images/")
    return sorted(p for start in starts for p in root.glob(start + _IMAGES) if p.is_dir())


LAYOUT = Layout(
    matches=matches,
    listing=listing,
    needs=(
        "*/images/scene_cam_*_final_preview",
        "*/images/scene_cam_*_geometry_hdf5",
    ),
)
