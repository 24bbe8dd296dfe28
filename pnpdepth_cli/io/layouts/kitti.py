"""KITTI: odometry, depth completion and raw drives, whose parts lie in trees of their own.

`kitti-odometry`: sequences/NN/ with image_2/, velodyne/ and calib.txt, or one such sequence. The
training sequences, 00 to 10, have the poses of camera 0 in poses/NN.txt beside sequences/, a row of
12 numbers per frame. The scan is the ground truth of the paper's experiments: `batch --sample 500`.

`kitti-depth`: the benchmark's selection, image/ velodyne_raw/ [groundtruth_depth/] [intrinsics/],
or the tree <drive>/proj_depth/{velodyne_raw,groundtruth}/image_0{2,3}/. Images of the tree are the
raw data's, <drive>/image_0{2,3}/data/ in the same drive's folder, in <date>/, raw/<date>/ or
kitti_raw/<date>/. As downloaded, scans and ground truth lie apart in
data_depth_velodyne/{train,val}/ and data_depth_annotated/{train,val}/.

`kitti-raw`: <date>/<drive>/ with image_0{2,3}/data/ and velodyne_points/data/; the folder may be a
drive, a date, or what the dates are in. Ground truth is the annotated depth, where the drive or a
folder data_depth_annotated/{train,val}/ beside the dates has it.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Pose, Unmatched
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts.layout import (
    BIN,
    IMAGE,
    PNG,
    TXT,
    Files,
    Layout,
    Part,
    Parts,
    files_in,
    joined,
    merged,
    of_folders,
)
from pnpdepth_cli.io.poses import PACKETS

_SCALE = 256.0
_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
_RAW = "proj_depth/velodyne_raw/image_0[23]"
_SCANS = "velodyne_points/data"
_CAMERAS = ("image_02", "image_03")
_CALIBRATION = "calib_cam_to_cam.txt"


def _of_sequence(root: Path, place: Path, files: Parts) -> Mapping[str, Any]:
    """Calibration and pose; poses belong to frames by number, so a part of a sequence has its own.

    Raises:
        InputError: The frame has no row in an existing file of poses.
    """
    fields: dict[str, Any] = {"calib": place / "calib.txt"}
    folder, image = place.absolute(), files["image"]  # the parents of "." are in its absolute path
    path = folder.parents[1] / "poses" / f"{folder.name}.txt"
    if not path.is_file():
        return fields
    poses = _poses(path, path.stat().st_mtime_ns)
    if not image.stem.isdecimal() or int(image.stem) >= len(poses):
        raise InputError(
            f"{image} has no pose: its sequence's file holds {len(poses):,} poses, by frame number"
        )
    return {**fields, "pose": poses[int(image.stem)]}


@functools.lru_cache(maxsize=1)
def _poses(path: Path, changed_ns: int) -> list[Pose]:
    """The poses of a sequence by frame number; kept for its other frames."""
    lines = read_bytes(path).decode("utf-8", "replace").splitlines()
    return [_pose(path, number, line) for number, line in enumerate(lines, 1) if line.strip()]


def _pose(path: Path, number: int, line: str) -> Pose:
    try:
        values = [float(word) for word in line.split()]
    except ValueError:
        values = []
    if len(values) != 12 or not np.isfinite(values).all():
        raise FileFormatError(
            f"{path}, line {number}: {one_line(line)[:60]!r} is not 12 finite numbers"
        )
    return tuple(tuple(values[start : start + 4]) for start in (0, 4, 8))


ODOMETRY = of_folders(
    {"image": Part("image_2", IMAGE), "sparse": Part("velodyne", BIN)},
    below=("", "sequences/*/", "dataset/sequences/*/"),
    probe="calib.txt",
    needs=("sequences/*/image_2", "sequences/*/velodyne", "sequences/*/calib.txt"),
    name=lambda root, place, stem: f"{place.name}_{stem}",
    spare=("sparse",),
    more=_of_sequence,
    camera=2,
    protocol=PROTOCOLS["kitti-odometry"],
)


_SELECTION = {
    "image": Part("image", IMAGE),
    "sparse": Part("velodyne_raw"),
    "gt": Part("groundtruth_depth|groundtruth"),
    "calib": Part("intrinsics", TXT),
}


def _is_selection(root: Path) -> bool:
    return (root / "image").is_dir() and (root / "velodyne_raw").is_dir()


def _selection(root: Path) -> Listing:
    folders = {part: kind.path(root) for part, kind in _SELECTION.items()}
    files = {  # without the kind of file in the middle of the name
        part: {
            _KIND.sub("_sync_", stem): path
            for stem, path in files_in(kind.path(root), kind.pattern).items()
        }
        for part, kind in _SELECTION.items()
    }
    shared = {"calib": root} if (root / _CALIBRATION).is_file() else {}
    return joined(
        folders,
        files,
        lambda stem, found: _depth_frame(stem, {**shared, **found}),
        optional=("gt", "calib"),
        spare=("sparse", "gt"),
    )


def _depth_frame(name: str, fields: Mapping[str, Any]) -> Frame:
    protocol = PROTOCOLS["kitti-depth"]
    return Frame(name=name, sparse_scale=_SCALE, gt_scale=_SCALE, protocol=protocol, **fields)


def _scan_folders(root: Path) -> list[Path]:
    starts = ("", "*/", "*/*/", "data_depth_velodyne/*/*/")
    return sorted({p for start in starts for p in root.glob(start + _RAW) if p.is_dir()})


def _of_scans(root: Path, scans: Path) -> Listing:
    """The frames of one drive and camera."""
    camera, drive = scans.name, scans.parents[2]
    images, calib = _images_of(root, drive, camera)
    if images is None:
        why = (
            f"has no {camera}/data with images; put KITTI's raw drive {drive.name} there, or into"
            f" {root / drive.name[:10]}"
        )
        return Listing(frames=[], broken=(Unmatched(path=drive, why=why),))
    base, annotated = drive.parents[1], drive
    if base.name == "data_depth_velodyne":
        annotated = base.with_name("data_depth_annotated") / drive.parent.name / drive.name
    truth = annotated / "proj_depth" / "groundtruth" / camera
    fields = {"calib": calib, "camera": int(camera[-1])}
    return joined(
        {"sparse": scans, "image": images, "gt": truth},
        {
            "sparse": files_in(scans, PNG),
            "image": files_in(images, IMAGE),
            "gt": files_in(truth, PNG),
        },
        lambda stem, files: _depth_frame(f"{drive.name}_{stem}_{camera}", {**files, **fields}),
        optional=("gt",),
        spare=("image", "gt"),
    )


def _images_of(root: Path, drive: Path, camera: str) -> tuple[Path | None, Path | None]:
    """The folders of a drive's images and of its calibration; None for one that is missing."""
    above = [drive.parents[2]] if drive.parents[1].name == "data_depth_velodyne" else []
    folders = [base / raw for base in (root, *above) for raw in ("", "raw", "kitti_raw")]
    for parent in (drive, *(folder / drive.name[:10] / drive.name for folder in folders)):
        images = parent / camera / "data"
        if images.is_dir():
            return images, _calibration_of(parent)
    return None, None


def _calibration_of(drive: Path) -> Path | None:
    return next((p for p in (drive.parent, drive) if (p / _CALIBRATION).is_file()), None)


DEPTH = Layout(
    matches=lambda root: _is_selection(root) or bool(_scan_folders(root)),
    listing=lambda root: (
        _selection(root)
        if _is_selection(root)
        else merged(_of_scans(root, scans) for scans in _scan_folders(root))
    ),
    needs=("*/proj_depth/velodyne_raw/image_0[23]", "*/image_0[23]/data"),
)


def _drives(root: Path) -> list[Path]:
    scans = (p for start in ("", "*/", "*/*/") for p in root.glob(start + _SCANS))
    drives = (p.parents[1] for p in scans if p.is_dir())
    return sorted(p for p in drives if any((p / c / "data").is_dir() for c in _CAMERAS))


def _of_drive(root: Path, drive: Path) -> Listing:
    calib = _calibration_of(drive)
    if calib is None:
        why = f"has no {_CALIBRATION}; put KITTI's calibration into {drive.parent}"
        return Listing(frames=[], broken=(Unmatched(path=drive, why=why),))
    scans, packets = files_in(drive / _SCANS, BIN), files_in(drive / PACKETS, TXT)
    listings = []
    for camera in _CAMERAS:
        folders = {"image": drive / camera / "data", "sparse": drive / _SCANS,
                   "gt": drive, "oxts": drive / PACKETS}  # fmt: skip
        files = {"image": files_in(folders["image"], IMAGE), "sparse": scans,
                 "gt": _annotated(root, drive, camera), "oxts": packets}  # fmt: skip
        listing = joined(
            folders, files, functools.partial(_raw_frame, drive, camera, calib),
            optional=("gt", "oxts"),
        )  # fmt: skip
        # some drives lack scans of a few frames, which is no fault of the copy
        listings.append(replace(listing, broken=(), spare=listing.broken))
    return merged(listings)


def _raw_frame(drive: Path, camera: str, calib: Path, stem: str, files: Parts) -> Frame:
    number = int(camera[-1])
    name = f"{drive.name}_{stem}_{camera}"
    return Frame(name=name, gt_scale=_SCALE, calib=calib, camera=number, **files)


def _annotated(root: Path, drive: Path, camera: str) -> Files:
    """KITTI's annotated depth of a drive, by frame number."""
    inside = Path("proj_depth", "groundtruth", camera)
    bases = (root, root.parent, root.parent.parent)
    folders = [b / "data_depth_annotated" / p / drive.name for b in bases for p in ("train", "val")]
    paths = (folder / inside for folder in (drive, *folders))
    return next((files_in(path, PNG) for path in paths if path.is_dir()), {})


RAW = Layout(
    matches=lambda root: bool(_drives(root)),
    listing=lambda root: merged(_of_drive(root, drive) for drive in _drives(root)),
    needs=("*_sync/velodyne_points/data", "*_sync/image_02/data", "calib_cam_to_cam.txt"),
)
