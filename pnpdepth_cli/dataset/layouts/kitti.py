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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.camera import Extrinsics
from pnpdepth_cli.dataset.frame_files import FrameFiles, Unmatched, as_pose, file_of
from pnpdepth_cli.dataset.layouts.layout import (
    Finish,
    Layout,
    Part,
    as_it_is,
    join_parts,
    layout_of_folders,
)
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.calibration import read_calibration, read_inertial_pose
from pnpdepth_cli.io.poses import read_oxts, read_poses
from pnpdepth_cli.protocols import ODOMETRY_PART

_CAMERAS = "image_0[23]"
"""Folders of the two colour cameras."""
_SCANS = "velodyne_points/data"
"""Folder of a drive's scans."""
_CALIBRATION = "calib_cam_to_cam.txt"
"""File of the cameras' calibration, by which its folder is known."""
_PACKETS = "oxts/data"
"""Folder of the inertial system's packets, one a frame."""
_INERTIAL = "calib_imu_to_velo.txt"
"""File with the pose of the inertial system."""
_RAW = ("", "raw/", "kitti_raw/")
"""Folders of the raw data's dates."""
_STEM = r"(.*_sync|)(?:_(?:image|velodyne_raw|groundtruth_depth)(?=_))?(.+)"
"""Names of the selection, without the kind of file in the middle."""
_OF_MAPS = FrameFiles(sparse_scale=256.0, gt_scale=256.0, one_view=True)
"""What all frames of depth completion have: codes per metre, and maps of the image's view."""


def _poses_of_sequence(place: Path) -> Finish:
    """The function that gives frames of a sequence the poses of its file, if there is one.

    Poses belong to frames by number, so frames of a part of a sequence have the right ones.
    """
    folder = place.absolute()  # the parents of "." are in its absolute path
    path = folder.parents[1] / "poses" / f"{folder.name}.txt"
    if not path.is_file():
        return as_it_is
    poses = [as_pose(pose) for pose in read_poses(path)]

    def with_pose(frame: FrameFiles) -> FrameFiles:
        """The frame with the pose of its number. Raises InputError if there is none."""
        if not frame.name.isdecimal() or int(frame.name) >= len(poses):
            raise InputError(
                f"{frame.image} has no pose: its sequence's file holds {len(poses):,} poses, by"
                f" frame number; complete or remove {path}"
            )
        return replace(frame, pose=poses[int(frame.name)])

    return with_pose


def _name_of_sequence(_root: Path, place: Path, stem: str) -> str:
    """The name of a frame, such as 07_000123."""
    return f"{place.name}_{stem}"


ODOMETRY = layout_of_folders(
    {"image": "image_2/*.IMAGE", "sparse": "velodyne/*.bin"},
    below="|sequences/*/|dataset/sequences/*/",
    marks=("calib.txt",),
    name=_name_of_sequence,
    calib="calib.txt",
    finish_of=_poses_of_sequence,
    shared=FrameFiles(camera=2, part=ODOMETRY_PART),
)


def _of_drive(drive: Path, inside: Path, *beside: str) -> Path:
    """The folder of some data of a drive: in it, or in its namesake in another folder.

    Args:
        drive: The folder of the drive.
        inside: Path of the data below a drive.
        beside: Folders with drives of the same names, below one of the three folders above.

    Returns:
        A folder that does not exist if there are no such data.
    """
    namesakes = [base / name / drive.name for base in drive.parents[:3] for name in beside]
    folders = [place / inside for place in (drive, *namesakes)]
    return next((folder for folder in folders if folder.is_dir()), namesakes[0] / inside)


def _truth_of(drive: Path, camera: str) -> Path:
    """The folder of the annotated depth of a drive's camera; it may not exist.

    Args:
        drive: The folder of the drive.
        camera: Folder of the camera in it, such as image_02.
    """
    beside = [f"data_depth_annotated/{split}" for split in ("train", "val")]
    return _of_drive(drive, Path("proj_depth/groundtruth", camera), *beside)


def _calibration_of(drive: Path) -> Path | None:
    """The folder with the calibration of a drive. None: there is none."""
    folders = (drive.parent, drive)
    return next((folder for folder in folders if (folder / _CALIBRATION).is_file()), None)


_SELECTION = layout_of_folders(
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
    """The folders below a root that have a path, behind one of these starts.

    Args:
        root: The folder.
        starts: Patterns of where the path may begin.
        inside: Pattern of the path.
    """
    paths = [path for start in starts for path in root.glob(start + inside)]
    return sorted(path for path in paths if path.is_dir())


def _scans_of_tree(root: Path) -> list[Path]:
    """The folders of projected scans, one a camera, of the benchmark's tree."""
    starts = ("", "*/", "*/*/", "data_depth_velodyne/*/*/")
    return _folders(root, starts, f"proj_depth/velodyne_raw/{_CAMERAS}")


def _frames_of_depth(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """Yields the frames of the benchmark's selection, or of its tree; and files of no frame."""
    if _SELECTION.matches(root):
        yield from _SELECTION.frames(root)
        return
    # Of a tree, scans are in DRIVE/proj_depth/velodyne_raw/CAMERA, images with the raw data.
    for scans in _scans_of_tree(root):
        drive = scans.parents[2]
        camera = scans.name
        dates = (f"{raw}{drive.name[:10]}" for raw in _RAW)  # a drive's name begins with its date
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
    """The folders of cameras, in drives that have scans."""
    images = _folders(root, ("", "*/", "*/*/"), f"{_CAMERAS}/data")
    return [path.parent for path in images if (path.parents[1] / _SCANS).is_dir()]


def _frames_of_raw(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """Yields the frames of raw drives, with poses where a drive has them; and files of no frame."""
    for camera in _raw_cameras(root):
        drive = camera.parent
        calibration = _calibration_of(drive)
        if calibration is None:
            yield drive, f"has no {_CALIBRATION}; put KITTI's calibration into {drive.parent}"
            continue
        parts = {
            "image": (camera / "data", "*.IMAGE"),
            "sparse": (drive / _SCANS, "*.bin"),
            "gt": (_truth_of(drive, camera.name), "*.png?"),
        }
        shared = FrameFiles(calib=calibration, gt_scale=256.0)
        entries = list(_frames_of_camera(drive, camera.name, parts, shared))
        frames = [entry for entry in entries if isinstance(entry, FrameFiles)]
        with_pose = _with_poses_of_drive(drive, frames)
        for entry in entries:
            if isinstance(entry, FrameFiles):
                yield with_pose.get(entry, entry)
            else:
                yield entry  # a file of no frame, and why


def _with_poses_of_drive(drive: Path, frames: Sequence[FrameFiles]) -> dict[FrameFiles, FrameFiles]:
    """The frames with poses of the inertial system, by the frames without.

    The world is the first frame's camera, rectified. Empty where a file of poses is missing.

    Args:
        drive: The folder of the drive.
        frames: Frames of one camera of it, in their order.
    """
    packets = [
        drive / _PACKETS / f"{file_of(frame.image).stem}.txt" for frame in frames if frame.image
    ]
    inertial = drive.parent / _INERTIAL
    if not packets or not all(path.is_file() for path in (*packets, inertial)):
        return {}
    scanner = read_calibration(drive.parent, frames[0].camera).scanner
    if scanner is None:
        return {}
    # From the camera to the inertial system, to the world, and to the first camera.
    camera_to_inertial = (scanner @ read_inertial_pose(inertial)).inverse()
    camera_to_world = [
        Extrinsics(pose[:, :3], pose[:, 3]) @ camera_to_inertial for pose in read_oxts(packets)
    ]
    world_to_first = camera_to_world[0].inverse()
    poses = [as_pose((world_to_first @ pose).square()[:3]) for pose in camera_to_world]
    return {frame: replace(frame, pose=pose) for frame, pose in zip(frames, poses, strict=True)}


def _frames_of_camera(
    drive: Path, camera: str, parts: Mapping[str, Part], shared: FrameFiles
) -> Iterator[FrameFiles | Unmatched]:
    """Yields the frames of one camera of a drive, named by the two; and files of no frame.

    Args:
        drive: The folder of the drive.
        camera: Folder of the camera, such as image_02, which ends with its number.
        parts: Where the files of each part are, by its field of `FrameFiles`.
        shared: A frame whose fields all frames have.
    """
    for entry in join_parts(parts, replace(shared, camera=int(camera[-1]))):
        if isinstance(entry, tuple):  # a file of no frame, and why
            yield entry
        else:
            yield replace(entry, name=f"{drive.name}_{entry.name}_{camera}")


RAW = Layout(
    matches=_raw_cameras,
    frames=_frames_of_raw,
    needs=(f"{_CAMERAS}/data", _SCANS),
    below="|*/|*/*/",
)
