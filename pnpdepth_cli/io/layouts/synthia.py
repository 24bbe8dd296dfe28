"""`synthia`: SYNTHIA's video sequences and SYNTHIA-RAND-CITYSCAPES, one of them or several.

A video sequence has RGB/ and Depth/ with <Stereo_Left|Stereo_Right>/<Omni_F|Omni_B|Omni_L|Omni_R>/
NNNNNN.png in both. SYNTHIA-RAND-CITYSCAPES has RGB/NNNNNNN.png and Depth/Depth/NNNNNNN.png, or
Depth/NNNNNNN.png. Depth is in centimetres, in 16-bit PNGs of one channel or three equal ones; the
sky's 65535 is unknown.

The data set has no calibration that `read_calibration` reads, so frames have none. All images have
1280×760 pixels and fx = fy = 532.740352, cx = 640, cy = 380. As a plain file:

    K: [532.740352, 0, 640,  0, 532.740352, 380,  0, 0, 1]
    size: [1280, 760]
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Frame, Listing
from pnpdepth_cli.io.layouts.layout import PNG, Layout, files_in, joined, merged

_SCALE = 100.0
_SIZE = (1280, 760)
_CAMERAS = "Stereo_*/Omni_*"
_RANDOM_STEM = re.compile(r"\d{7}")


def _of_camera(prefix: list[str], rgb: Path, depth: Path) -> Listing:
    """One frame for each image with depth."""
    folders = {"image": rgb, "gt": depth}
    return joined(
        folders,
        {part: files_in(folder, PNG) for part, folder in folders.items()},
        lambda stem, files: Frame(name="_".join([*prefix, stem]), gt_scale=_SCALE, **files),
        spare=("gt",),
    )


def _has_synthias_size(image: Path) -> bool:
    """False for a PNG of another size; a file that is no PNG is reported when it is read."""
    with image.open("rb") as file:
        header = file.read(24)
    if len(header) < 24 or not header.startswith(b"\x89PNG"):
        return True
    return struct.unpack_from(">II", header, 16) == _SIZE


def _cameras(root: Path) -> Iterator[tuple[list[str], Path, Path]]:
    """For each camera: the parts its frames' names start with, its image and its depth folder."""
    for rgb in sorted(p for pattern in ("RGB", "*/RGB") for p in root.glob(pattern)):
        part, depth = rgb.parent, rgb.with_name("Depth")
        if not depth.is_dir():
            continue
        prefix = [] if part == root else [part.name]
        for camera in sorted(p for p in rgb.glob(_CAMERAS) if p.is_dir()):
            name = camera.relative_to(rgb)
            yield [*prefix, *name.parts], camera, depth / name
        # SYNTHIA-RAND keeps its images directly in RGB. RGB and Depth are common names: numbers and
        # size distinguish it from other data.
        images = (p for p in sorted(rgb.glob("*.png")) if _RANDOM_STEM.fullmatch(p.stem))
        first = next(images, None)
        if first is not None and _has_synthias_size(first):
            nested = depth / "Depth"
            yield prefix, rgb, nested if nested.is_dir() else depth


SYNTHIA = Layout(
    matches=lambda root: any(True for _ in _cameras(root)),
    listing=lambda root: merged(_of_camera(*each) for each in _cameras(root)),
    needs=("RGB", "Depth"),
)
