"""`kitti-depth`: KITTI's depth completion, as its selection and as its training tree.

The selection (and the anonymous test set) has image/ velodyne_raw/ [groundtruth_depth/]
[intrinsics/]. The tree has <drive>/proj_depth/{velodyne_raw,groundtruth}/image_0{2,3}/; the images
come from the raw data, whose <drive>/image_0{2,3}/data/ is looked for in the same drive's folder,
or below <date>/ or raw/<date>/.
"""

from __future__ import annotations

import re
from pathlib import Path

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.layouts.frame import PICTURES, Frame, by_stem, partner
from pnpdepth_cli.io.layouts.protocols import PROTOCOLS

_PNG = (".png",)
_SCALE = 256.0
_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
_RAW = "proj_depth/velodyne_raw/image_0[23]"


def matches(root: Path) -> bool:
    """True for a folder of the selection, or one with drives in it or one folder below."""
    return _is_selection(root) or bool(_cameras(root))


def frames(root: Path) -> list[Frame]:
    """One frame for each projected scan; InputError for one without image."""
    return _selection(root) if _is_selection(root) else _drives(root)


def _is_selection(root: Path) -> bool:
    return (root / "image").is_dir() and (root / "velodyne_raw").is_dir()


def _selection(root: Path) -> list[Frame]:
    truth_folder = next(
        (p for p in (root / "groundtruth_depth", root / "groundtruth") if p.is_dir()), root / "none"
    )
    scans = _by_frame(root / "velodyne_raw", _PNG)
    truth = _by_frame(truth_folder, _PNG)
    intrinsics = _by_frame(root / "intrinsics", (".txt",))
    raw = root if (root / "calib_cam_to_cam.txt").is_file() else None
    return [
        Frame(
            name=name,
            image=image,
            sparse=partner(scans, name, image, root / "velodyne_raw"),
            gt=truth.get(name),
            calib=intrinsics.get(name, raw),
            sparse_scale=_SCALE,
            gt_scale=_SCALE,
            protocol=PROTOCOLS["kitti-depth"],
        )
        for name, image in _by_frame(root / "image", PICTURES).items()
    ]


def _by_frame(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """The selection's names without the kind of file that stands in their middle."""
    return {_KIND.sub("_sync_", stem): path for stem, path in by_stem(folder, suffixes).items()}


def _cameras(root: Path) -> list[Path]:
    return sorted(p for start in ("", "*/", "*/*/") for p in root.glob(start + _RAW) if p.is_dir())


def _drives(root: Path) -> list[Frame]:
    found = []
    for scans in _cameras(root):
        camera, drive = scans.name, scans.parents[2]
        images, calib = _images_of(root, drive, camera)
        truth = by_stem(drive / "proj_depth" / "groundtruth" / camera, _PNG)
        pictures = by_stem(images, PICTURES)
        found += [
            Frame(
                name=f"{drive.name}_{stem}_{camera}",
                image=partner(pictures, stem, scan, images),
                sparse=scan,
                gt=truth.get(stem),
                calib=calib,
                camera=int(camera[-1]),
                sparse_scale=_SCALE,
                gt_scale=_SCALE,
                protocol=PROTOCOLS["kitti-depth"],
            )
            for stem, scan in by_stem(scans, _PNG).items()
        ]
    return found


def _images_of(root: Path, drive: Path, camera: str) -> tuple[Path, Path | None]:
    """The folder of a drive's images, and that of its calibration if it is there."""
    date = drive.name[:10]
    for place in (drive, root / date / drive.name, root / "raw" / date / drive.name):
        images = place / camera / "data"
        if images.is_dir():
            calib = next(
                (p for p in (place.parent, place) if (p / "calib_cam_to_cam.txt").is_file()), None
            )
            return images, calib
    raise InputError(
        f"{drive} has no {camera}/data with images; put KITTI's raw drive {drive.name} there, or"
        f" into {root / date}"
    )
