"""KITTI: odometry, depth completion and raw drives, whose parts lie in trees of their own.

`kitti-odometry`: sequences/NN/, or one such sequence. The training sequences, 00 to 10, have the
poses of camera 0 in poses/NN.txt beside sequences/, a row of 12 numbers per frame. The scan is the
ground truth of the paper's experiments: `batch --sample 500`.

`kitti-depth`: the benchmark's selection, or the tree. Images of the tree are the raw data's, in the
same drive's folder, in <date>/, raw/<date>/ or kitti_raw/<date>/. As downloaded, scans and ground
truth lie apart in data_depth_velodyne/{train,val}/ and data_depth_annotated/{train,val}/.

`kitti-raw`: a drive, a date, or what the dates are in. Ground truth is the annotated depth, where
the drive or a folder data_depth_annotated/{train,val}/ beside the dates has it. Poses are those of
the inertial system, where the drive has oxts/ and the date calib_imu_to_velo.txt.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.camera import Extrinsics
from pnpdepth_cli.dataset.frame_files import FrameFiles, Unmatched, as_pose, file_of
from pnpdepth_cli.dataset.layouts.layout import Layout, Part, join_parts, row
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.calibration import read_calibration, read_inertial_pose
from pnpdepth_cli.io.poses import read_oxts, read_poses
from pnpdepth_cli.protocols import ODOMETRY_PART

_CAMERAS = "image_0[23]"
_SCANS = "velodyne_points/data"
_CALIBRATION = "calib_cam_to_cam.txt"
_PACKETS = "oxts/data"
_INERTIAL = "calib_imu_to_velo.txt"
_RAW = ("", "raw/", "kitti_raw/")
"""Folders of the raw data's dates."""
_STEM = r"(.*_sync|)(?:_(?:image|velodyne_raw|groundtruth_depth)(?=_))?(.+)"
"""Names of the selection, without the kind of file in the middle."""
_OF_MAPS = FrameFiles(sparse_scale=256.0, gt_scale=256.0, one_view=True)


def _of_sequence(place: Path) -> Callable[[FrameFiles], FrameFiles]:
    """The pose; poses belong to frames by number, so a part of a sequence has its own."""
    folder = place.absolute()  # the parents of "." are in its absolute path
    path = folder.parents[1] / "poses" / f"{folder.name}.txt"
    if not path.is_file():
        return replace
    poses = [as_pose(pose) for pose in read_poses(path)]

    def with_pose(frame: FrameFiles) -> FrameFiles:
        if not frame.name.isdecimal() or int(frame.name) >= len(poses):
            raise InputError(
                f"{frame.image} has no pose: its sequence's file holds {len(poses):,} poses, by"
                f" frame number; complete or remove {path}"
            )
        return replace(frame, pose=poses[int(frame.name)])

    return with_pose


ODOMETRY = row(
    {"image": "image_2/*.IMAGE", "sparse": "velodyne/*.bin"},
    below="|sequences/*/|dataset/sequences/*/",
    marks=("calib.txt",),
    name=lambda root, place, stem: f"{place.name}_{stem}",
    calib="calib.txt",
    more=_of_sequence,
    shared=FrameFiles(camera=2, part=ODOMETRY_PART),
)


def _of_drive(drive: Path, inside: Path, *beside: str) -> Path:
    """The data of a drive, in it or in its namesake in a folder beside; it may not exist."""
    drives = [drive, *(base / name / drive.name for base in drive.parents[:3] for name in beside)]
    return next((path / inside for path in drives if (path / inside).is_dir()), drives[1] / inside)


def _truth_of(drive: Path, camera: str) -> Path:
    """The folder of the annotated depth of a drive's camera; it may not exist."""
    beside = [f"data_depth_annotated/{split}" for split in ("train", "val")]
    return _of_drive(drive, Path("proj_depth/groundtruth", camera), *beside)


def _calibration_of(drive: Path) -> Path | None:
    """The folder with the calibration of a drive. None: there is none."""
    return next((p for p in (drive.parent, drive) if (p / _CALIBRATION).is_file()), None)


_SELECTION = row(
    {
        "image": f"image/{_STEM}.IMAGE",
        "sparse": f"velodyne_raw/{_STEM}.png",
        "gt": f"groundtruth_depth|groundtruth/{_STEM}.png?",
        "calib": f"intrinsics/{_STEM}.txt?",
    },
    marks=("velodyne_raw",),
    calib=_CALIBRATION,
    shared=_OF_MAPS,
)


def _folders(root: Path, starts: tuple[str, ...], inside: str) -> list[Path]:
    """The folders of cameras at one of these places."""
    found = (path for start in starts for path in root.glob(start + inside))
    return sorted(path for path in found if path.is_dir())


def _scans_of_tree(root: Path) -> list[Path]:
    """The folders of projected scans, one a camera, of the benchmark's tree."""
    starts = ("", "*/", "*/*/", "data_depth_velodyne/*/*/")
    return _folders(root, starts, f"proj_depth/velodyne_raw/{_CAMERAS}")


def _frames_of_depth(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """The frames of the benchmark's selection, or of its tree."""
    if _SELECTION.matches(root):
        yield from _SELECTION.frames(root)
        return
    for scans in _scans_of_tree(root):
        drive = scans.parents[2]
        camera = scans.name
        dates = (f"{raw}{drive.name[:10]}" for raw in _RAW)
        images = _of_drive(drive, Path(camera, "data"), *dates)
        parts = {
            "sparse": (scans, "*.png"),
            "image": (images, "*.IMAGE"),
            "gt": (_truth_of(drive, camera), "*.png?"),
        }
        shared = replace(_OF_MAPS, calib=_calibration_of(images.parents[1]))
        yield from _frames_of_camera(drive, camera, parts, shared)


DEPTH = Layout(
    matches=lambda root: _SELECTION.matches(root) or _scans_of_tree(root),
    frames=_frames_of_depth,
    needs=(f"velodyne_raw|proj_depth/velodyne_raw/{_CAMERAS}", "image|proj_depth"),
    below="|*/|*/*/|data_depth_velodyne/*/*/",
)


def _raw_cameras(root: Path) -> list[Path]:
    """The cameras of drives with scans."""
    images = _folders(root, ("", "*/", "*/*/"), f"{_CAMERAS}/data")
    return [path.parent for path in images if (path.parents[1] / _SCANS).is_dir()]


def _frames_of_raw(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """The frames of raw drives, with poses where a drive has them."""
    for camera in _raw_cameras(root):
        drive = camera.parent
        calibration = _calibration_of(camera.parent)
        if calibration is None:
            yield drive, f"has no {_CALIBRATION}; put KITTI's calibration into {drive.parent}"
            continue
        parts = {
            "image": (camera / "data", "*.IMAGE"),
            "sparse": (drive / _SCANS, "*.bin"),
            "gt": (_truth_of(drive, camera.name), "*.png?"),
        }
        shared = FrameFiles(calib=calibration, gt_scale=256.0)
        found = list(_frames_of_camera(drive, camera.name, parts, shared))
        frames = [entry for entry in found if isinstance(entry, FrameFiles)]
        poses = _poses_of_drive(drive, frames)
        for entry in found:
            yield poses.get(entry, entry) if isinstance(entry, FrameFiles) else entry


def _poses_of_drive(drive: Path, frames: Sequence[FrameFiles]) -> dict[FrameFiles, FrameFiles]:
    """The frames with poses of the inertial system; none where a file of them is missing.

    The world is the first frame's camera, rectified.
    """
    packets = [drive / _PACKETS / f"{file_of(f.image).stem}.txt" for f in frames if f.image]
    inertial = drive.parent / _INERTIAL
    if not packets or not all(path.is_file() for path in (*packets, inertial)):
        return {}
    scanner = read_calibration(drive.parent, frames[0].camera).scanner
    if scanner is None:
        return {}
    # From the camera to the inertial system, to the world, and to the first camera.
    of_camera = (scanner @ read_inertial_pose(inertial)).inverse()
    places = [Extrinsics(pose[:, :3], pose[:, 3]) @ of_camera for pose in read_oxts(packets)]
    origin = places[0].inverse()
    poses = [as_pose((origin @ place).square()[:3]) for place in places]
    return {f: replace(f, pose=pose) for f, pose in zip(frames, poses, strict=True)}


def _frames_of_camera(
    drive: Path, camera: str, parts: Mapping[str, Part], shared: FrameFiles
) -> Iterator[FrameFiles | Unmatched]:
    for found in join_parts(parts, replace(shared, camera=int(camera[-1]))):
        if isinstance(found, tuple):
            yield found
        else:
            yield replace(found, name=f"{drive.name}_{found.name}_{camera}")


RAW = Layout(
    matches=_raw_cameras,
    frames=_frames_of_raw,
    needs=(f"{_CAMERAS}/data", _SCANS),
    below="|*/|*/*/",
)
