"""`kitti-depth`: KITTI's depth completion, as its selection and as its training tree.

The selection (and the anonymous test set) has image/ velodyne_raw/ [groundtruth_depth/]
[intrinsics/]. The tree has <drive>/proj_depth/{velodyne_raw,groundtruth}/image_0{2,3}/; the images
come from the raw data, whose <drive>/image_0{2,3}/data/ is searched in the same drive's folder, in
<date>/, in raw/<date>/ and in kitti_raw/<date>/. As downloaded, scans and ground truth lie apart in
data_depth_velodyne/{train,val}/ and data_depth_annotated/{train,val}/.
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
    """Returns whether this is the selection, or a folder with drives at most two levels below."""
    return _is_selection(root) or bool(_cameras(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each projected scan with an image."""
    return _selection(root) if _is_selection(root) else _drives(root)


def _is_selection(root: Path) -> bool:
    return (root / "image").is_dir() and (root / "velodyne_raw").is_dir()


def _selection(root: Path) -> Listing:
    gt_folder = next(
        (p for p in (root / "groundtruth_depth", root / "groundtruth") if p.is_dir()), root / "none"
    )
    images = _by_frame(root / "image", IMAGE_SUFFIXES)
    scans = _by_frame(root / "velodyne_raw", _PNG)
    ground_truth = _by_frame(gt_folder, _PNG)
    intrinsics = _by_frame(root / "intrinsics", (".txt",))
    raw = root if (root / "calib_cam_to_cam.txt").is_file() else None
    frames = [
        Frame(
            name=name,
            image=image,
            sparse=scans[name],
            gt=ground_truth.get(name),
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
            *without_partner(ground_truth, images, root / "image"),
        ),
    )


def _by_frame(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """The selection's files by name, without the kind of file in the middle of the name."""
    return {_KIND.sub("_sync_", stem): path for stem, path in by_stem(folder, suffixes).items()}


def _cameras(root: Path) -> list[Path]:
    starts = ("", "*/", "*/*/", "data_depth_velodyne/*/*/")
    return sorted({p for start in starts for p in root.glob(start + _RAW) if p.is_dir()})


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
        ground_truth = by_stem(_annotated(drive) / "proj_depth" / "groundtruth" / camera, _PNG)
        rgb, scans = by_stem(images, IMAGE_SUFFIXES), by_stem(folder, _PNG)
        frames += [
            Frame(
                name=f"{drive.name}_{stem}_{camera}",
                image=rgb[stem],
                sparse=scan,
                gt=ground_truth.get(stem),
                calib=calib,
                camera=int(camera[-1]),
                sparse_scale=_SCALE,
                gt_scale=_SCALE,
                protocol=PROTOCOLS["kitti-depth"],
            )
            for stem, scan in scans.items()
            if stem in rgb
        ]
        broken += without_partner(scans, rgb, images)
        spare += without_partner(rgb, scans, folder)
        spare += without_partner(ground_truth, rgb, images)
    return Listing(frames=frames, broken=tuple(broken), spare=tuple(spare))


def _annotated(drive: Path) -> Path:
    """The drive with ground truth: the same, or that in data_depth_annotated/, as downloaded."""
    base = drive.parents[1]
    if base.name == "data_depth_velodyne":
        return base.with_name("data_depth_annotated") / drive.parent.name / drive.name
    return drive


def _images_of(root: Path, drive: Path, camera: str) -> tuple[Path | None, Path | None]:
    """The folders of a drive's images and of its calibration; None for one that is missing."""
    date = drive.name[:10]
    above = [drive.parents[2]] if drive.parents[1].name == "data_depth_velodyne" else []
    folders = [base / raw for base in (root, *above) for raw in ("", "raw", "kitti_raw")]
    for parent in (drive, *(folder / date / drive.name for folder in folders)):
        images = parent / camera / "data"
        if images.is_dir():
            calib = next(
                (p for p in (parent.parent, parent) if (p / "calib_cam_to_cam.txt").is_file()), None
            )
            return images, calib
    return None, None


def _without_images(root: Path, drive: Path, camera: str) -> Unmatched:
    date_folder = root / drive.name[:10]
    return Unmatched(
        path=drive,
        why=f"has no {camera}/data with images; put KITTI's raw drive {drive.name} there, or into"
        f" {date_folder}",
    )


LAYOUT = Layout(
    matches=matches,
    listing=listing,
    needs=("*/proj_depth/velodyne_raw/image_0[23]", "*/image_0[23]/data"),
)
