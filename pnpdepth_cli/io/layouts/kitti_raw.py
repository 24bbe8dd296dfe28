"""`kitti-raw`: KITTI's raw data, <date>/<drive>/ with image_0{2,3}/data/ and velodyne_points/data/.

The folder may be one drive, one date, or what the dates are in. The calibration is the date's, or
lies in the drive. Ground truth is KITTI's annotated depth, where the drive or a folder
data_depth_annotated/{train,val}/ beside the dates has it.
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
from pnpdepth_cli.io.oxts import PACKETS

_SCANS = "velodyne_points/data"
_CAMERAS = ("image_02", "image_03")
_SCALE = 256.0


def matches(root: Path) -> bool:
    """Returns whether there is a drive with scans, at most two levels below."""
    return bool(_drives(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each scan and colour camera with an image."""
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    spare: list[Unmatched] = []
    for drive in _drives(root):
        calib = next(
            (p for p in (drive.parent, drive) if (p / "calib_cam_to_cam.txt").is_file()), None
        )
        if calib is None:
            why = f"has no calib_cam_to_cam.txt; put KITTI's calibration into {drive.parent}"
            broken.append(Unmatched(path=drive, why=why))
            continue
        scans = by_stem(drive / _SCANS, (".bin",))
        packets = by_stem(drive / PACKETS, (".txt",))
        for camera in _CAMERAS:
            images = by_stem(drive / camera / "data", IMAGE_SUFFIXES)
            annotated = _annotated(root, drive, camera)
            frames += [
                Frame(
                    name=f"{drive.name}_{stem}_{camera}",
                    image=image,
                    sparse=scans[stem],
                    gt=annotated.get(stem),
                    gt_scale=_SCALE,
                    calib=calib,
                    camera=int(camera[-1]),
                    oxts=packets.get(stem),
                )
                for stem, image in images.items()
                if stem in scans
            ]
            # some drives lack scans of a few frames, which is no fault of the copy
            spare += without_partner(images, scans, drive / _SCANS)
    return Listing(frames=frames, broken=tuple(broken), spare=tuple(spare))


def _drives(root: Path) -> list[Path]:
    scans = (p for start in ("", "*/", "*/*/") for p in root.glob(start + _SCANS))
    drives = (p.parents[1] for p in scans if p.is_dir())
    return sorted(p for p in drives if any((p / c / "data").is_dir() for c in _CAMERAS))


def _annotated(root: Path, drive: Path, camera: str) -> dict[str, Path]:
    """KITTI's annotated depth of a drive, by frame number."""
    inside = Path("proj_depth", "groundtruth", camera)
    folders = [drive / inside]
    for base in (root, root.parent, root.parent.parent):
        for part in ("train", "val"):
            folders.append(base / "data_depth_annotated" / part / drive.name / inside)
    return next((by_stem(p, (".png",)) for p in folders if p.is_dir()), {})


LAYOUT = Layout(
    matches=matches,
    listing=listing,
    needs=("*_sync/velodyne_points/data", "*_sync/image_02/data", "calib_cam_to_cam.txt"),
)
