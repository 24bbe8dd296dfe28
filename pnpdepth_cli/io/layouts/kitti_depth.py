"""`kitti-depth`: KITTI's depth completion, as its selection and as its training tree.

The selection (and the anonymous test set) has image/ velodyne_raw/ [groundtruth_depth/]
[intrinsics/]. The tree has <drive>/proj_depth/{velodyne_raw,groundtruth}/image_0{2,3}/; the images
come from the raw data, whose <drive>/image_0{2,3}/data/ is looked for in the same drive's folder,
or below <date>/ or raw/<date>/.
"""

from __future__ import annotations

import re
from pathlib import Path

from pnpdepth_cli.io.dataset.frame import (
    IMAGE_SUFFIXES,
    Frame,
    Listing,
    Unmatched,
    by_stem,
    without_partner,
)
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS
from pnpdepth_cli.io.layouts import Layout

_PNG = (".png",)
_SCALE = 256.0
_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
_RAW = "proj_depth/velodyne_raw/image_0[23]"


def matches(root: Path) -> bool:
    """True for a folder of the selection, or one with drives in it or one folder below."""
    return _is_selection(root) or bool(_cameras(root))


def listing(root: Path) -> Listing:
    """One frame for each projected scan with an image."""
    return _selection(root) if _is_selection(root) else _drives(root)


def _is_selection(root: Path) -> bool:
    return (root / "image").is_dir() and (root / "velodyne_raw").is_dir()


def _selection(root: Path) -> Listing:
    truth_folder = next(
        (p for p in (root / "groundtruth_depth", root / "groundtruth") if p.is_dir()), root / "none"
    )
    images = _by_frame(root / "image", IMAGE_SUFFIXES)
    scans = _by_frame(root / "velodyne_raw", _PNG)
    truth = _by_frame(truth_folder, _PNG)
    intrinsics = _by_frame(root / "intrinsics", (".txt",))
    raw = root if (root / "calib_cam_to_cam.txt").is_file() else None
    frames = [
        Frame(
            name=name,
            image=image,
            sparse=scans[name],
            gt=truth.get(name),
            calib=intrinsics.get(name, raw),
            sparse_scale=_SCALE,
            gt_scale=_SCALE,
            protocol=PROTOCOLS["kitti-depth"],
        )
        for name, image in images.items()
        if name in scans
    ]
    return Listing(
        frames=frames,
        broken=without_partner(images, scans, root / "velodyne_raw"),
        spare=(
            *without_partner(scans, images, root / "image"),
            *without_partner(truth, images, root / "image"),
        ),
    )


def _by_frame(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """The selection's names without the kind of file that stands in their middle."""
    return {_KIND.sub("_sync_", stem): path for stem, path in by_stem(folder, suffixes).items()}


def _cameras(root: Path) -> list[Path]:
    return sorted(p for start in ("", "*/", "*/*/") for p in root.glob(start + _RAW) if p.is_dir())


def _drives(root: Path) -> Listing:
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    spare: list[Unmatched] = []
    for folder in _cameras(root):
        camera, drive = folder.name, folder.parents[2]
        images, calib = _images_of(root, drive, camera)
        if images is None:
            broken.append(_without_images(root, drive, camera))
            continue
        truth = by_stem(drive / "proj_depth" / "groundtruth" / camera, _PNG)
        pictures, scans = by_stem(images, IMAGE_SUFFIXES), by_stem(folder, _PNG)
        frames += [
            Frame(
                name=f"{drive.name}_{stem}_{camera}",
                image=pictures[stem],
                sparse=scan,
                gt=truth.get(stem),
                calib=calib,
                camera=int(camera[-1]),
                sparse_scale=_SCALE,
                gt_scale=_SCALE,
                protocol=PROTOCOLS["kitti-depth"],
            )
            for stem, scan in scans.items()
            if stem in pictures
        ]
        broken += without_partner(scans, pictures, images)
        spare += without_partner(pictures, scans, folder)
        spare += without_partner(truth, pictures, images)
    return Listing(frames=frames, broken=tuple(broken), spare=tuple(spare))


def _images_of(root: Path, drive: Path, camera: str) -> tuple[Path | None, Path | None]:
    """The folders of a drive's images and of its calibration, each if it is there."""
    date = drive.name[:10]
    for place in (drive, root / date / drive.name, root / "raw" / date / drive.name):
        images = place / camera / "data"
        if images.is_dir():
            calib = next(
                (p for p in (place.parent, place) if (p / "calib_cam_to_cam.txt").is_file()), None
            )
            return images, calib
    return None, None


def _without_images(root: Path, drive: Path, camera: str) -> Unmatched:
    place = root / drive.name[:10]
    return Unmatched(
        path=drive,
        why=f"has no {camera}/data with images; put KITTI's raw drive {drive.name} there, or into"
        f" {place}",
    )


LAYOUT = Layout(matches=matches, listing=listing)
