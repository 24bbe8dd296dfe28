"""Sets whose index names the images and has their poses.

`tum`: rgb.txt and depth.txt with a time and a path per line, paired by time. An associations.txt
(of TUM's associate.py, or of ICL-NUIM) pairs them itself: a time and a path twice per line. Poses
are those of groundtruth.txt beside them, at the times of the images.

`colmap`: of several models, sparse/0 to sparse/N, the one with the most images is used. The images
of dense/, which COLMAP undistorts, are a project of their own: dense/images/ and dense/sparse/. The
folder of a model in a project is read, too.

Of phones with a LiDAR, whose depth is of the image's view but smaller: `stray-scanner`, with a row
of time, frame, position and quaternion for each frame in odometry.csv, in axes x right, y down, z
forward; and `record3d`, with K and w, h of the images and a row of quaternion and position for each
frame in metadata.json, in ARKit's axes x right, y up, z backwards.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from pnpdepth_cli.camera import Floats
from pnpdepth_cli.dataset.frame_files import (
    IMAGE_SUFFIXES,
    FrameFiles,
    Pose,
    Unmatched,
    as_pose,
    find_files,
)
from pnpdepth_cli.dataset.layouts.layout import Finish, Layout, lacking, layout_of_folders
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.colmap_model import model_files, read_model
from pnpdepth_cli.io.file_bytes import numbered_lines, one_line, read_bytes, read_json
from pnpdepth_cli.io.poses import LONGEST_GAP_S, read_trajectory, rotation_of

_OF_ETH3D = "dslr_calibration_undistorted"
"""Folder of the COLMAP model that ETH3D gives."""
_ASSOCIATIONS = "associations.txt"
_ODOMETRY = "odometry.csv"
_METADATA = "metadata.json"
_LONGEST_POSE_GAP_S = 0.1
"""Time between poses that a pose is interpolated over; motion capture takes them at 100 Hz."""

Timed = tuple[float, Path]
"""A time in s, and the file that was taken then."""


def _frames_of_tum(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """Yields a frame for each image with a depth image of its own within 0.02 s; and the others."""
    # A file of pairs, if there is one; else images and depth images that are nearest to each other.
    if (root / _ASSOCIATIONS).is_file():
        # The image comes first, in whatever order a line has the two.
        pairs = [sorted(line, key=_is_depth) for line in _timed_files(root / _ASSOCIATIONS, 2)]
    else:
        images = sorted(timed for (timed,) in _timed_files(root / "rgb.txt", 1))
        depths = sorted(timed for (timed,) in _timed_files(root / "depth.txt", 1))
        pairs = _nearest_pairs(images, depths)
        used = {timed for pair in pairs for timed in pair}
        why = f"has no partner within {LONGEST_GAP_S} s that is not another's"
        for timed in (*images, *depths):
            if timed not in used:
                yield timed[1], why
    # The frames, with poses where motion capture has them.
    poses = root / "groundtruth.txt"
    trajectory = read_trajectory(poses) if poses.is_file() else None
    for (time_s, image), (_, depth) in pairs:
        pose = None if trajectory is None else trajectory.at(time_s, _LONGEST_POSE_GAP_S)
        yield FrameFiles(
            name=image.stem,
            image=image,
            gt=depth,
            gt_scale=5000.0,
            one_view=True,
            pose=None if pose is None else as_pose(pose),
        )


def _timed_files(path: Path, count: int) -> list[list[Timed]]:
    """The files that each line of an index names, with their times.

    Args:
        path: The index: a time in s and a path, once or twice a line.
        count: How many files a line names: 1, or 2 of an image and its depth.

    Raises:
        InputError: A line has another number of them, or no time.
    """
    lines = list[list[Timed]]()
    for number, line in numbered_lines(read_bytes(path)):
        words = line.split()
        try:
            times_s = [float(word) for word in words[::2]]
            files = [path.parent / word for word in words[1::2]]
            timed_files = list(zip(times_s, files, strict=True))
        except ValueError:  # of a word that is no number, or of a time without a path
            timed_files = []
        is_complete = len(timed_files) == count
        is_finite = all(math.isfinite(time_s) for time_s, _ in timed_files)
        is_pair = count == 1 or sum(map(_is_depth, timed_files)) == 1
        if not is_complete or not is_finite or not is_pair:
            raise InputError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path for each"
                " image and depth; correct it"
            )
        lines.append(timed_files)
    return lines


def _is_depth(timed: Timed) -> bool:
    """Whether a file is depth, by the name of its folder, or by its own if it has no folder."""
    _, path = timed
    folder_and_name = path.parts[-2:]
    return "depth" in folder_and_name[0].lower()


def _nearest_pairs(images: list[Timed], depths: list[Timed]) -> list[list[Timed]]:
    """The pairs of an image and a depth image at most 0.02 s apart, each nearest to the other."""
    if not images or not depths:
        return []
    image_times = np.array([[time_s] for time_s, _ in images])
    depth_times = np.array([[time_s] for time_s, _ in depths])
    gaps_s, depth_of_image = cKDTree(depth_times).query(image_times)
    _, image_of_depth = cKDTree(image_times).query(depth_times)
    pairs = list[list[Timed]]()
    for image, depth in enumerate(depth_of_image):
        if gaps_s[image] <= LONGEST_GAP_S and image_of_depth[depth] == image:
            pairs.append([images[image], depths[depth]])
    return pairs


_OF_TUM = (f"rgb.txt|{_ASSOCIATIONS}", f"depth.txt|{_ASSOCIATIONS}")
"""What an index of TUM is: images and depth images, or a file of pairs."""


def _is_tum(root: Path) -> bool:
    """Whether a folder has the index files of TUM."""
    return not lacking(root, _OF_TUM)


TUM = Layout(matches=_is_tum, frames=_frames_of_tum, needs=_OF_TUM)


def _colmap_models(root: Path) -> list[Path]:
    """The folders of COLMAP models in a project, sparse/0 first; none without the photos."""
    if _photos_of(root) is None:
        return []
    numbered = [*sorted(root.glob("sparse/[0-9]*")), *sorted(root.glob("colmap/sparse/[0-9]*"))]
    folders = [*numbered, root / "sparse", root, root / _OF_ETH3D]
    return [folder for folder in folders if model_files(folder)]


def _photos_of(root: Path) -> Path | None:
    """The folder images/ of a COLMAP project, or of the project that a model is in; None if none.

    Args:
        root: Folder of the project, or of a model in it, such as sparse/0.
    """
    above = root.absolute().parents[:3] if model_files(root) else ()
    folders = [folder / "images" for folder in (root, *above)]
    return next((folder for folder in folders if folder.is_dir()), None)


def _frames_of_colmap(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """Yields a frame for each registered image that exists; and files of no frame."""
    # The model with the most images, and the photos.
    models = [read_model(folder) for folder in _colmap_models(root)]
    model = max(models, key=lambda model: len(model.images))
    photos = _photos_of(root)
    if photos is None:
        raise InputError(f"{root} has no folder images with the photos of its model; add it")
    files, left_out = find_files(photos, IMAGE_SUFFIXES)
    yield from left_out
    # Photos and models that are not used.
    for path in files.values():
        if path.relative_to(photos).as_posix() not in model.images:
            yield path, f"is not registered in {model.folder}"
    for smaller in models:
        if smaller is not model:
            why = f"is another model, of {len(smaller.images):,} images, in a unit of its own"
            yield smaller.folder, why
    # The frames.
    for name, image in sorted(model.images.items()):
        path = photos / name
        if not path.is_file():
            yield path, f"is missing, but registered in {model.folder}; add it"
            continue
        pose = as_pose(np.column_stack(image.pose.inverse()))  # COLMAP's is from the world
        stem = Path(name).with_suffix("").as_posix()
        yield FrameFiles(name=stem, image=path, sparse=model.folder, pose=pose)


COLMAP = Layout(
    matches=_colmap_models,
    frames=_frames_of_colmap,
    needs=("images", "sparse/0|sparse|colmap/sparse/0"),
)


def _add_pose(poses: Mapping[int, Pose]) -> Finish:
    """The function that gives a frame, whose name is its number, the pose of this number if any."""

    def add_pose(frame: FrameFiles) -> FrameFiles:
        """The frame with the pose of its number, or without one."""
        return replace(frame, pose=poses.get(int(frame.name)))

    return add_pose


def _poses_of_stray_scanner(place: Path) -> Finish:
    """The function that gives frames the poses of Stray Scanner, by their number."""
    path = place / _ODOMETRY
    # Rows of time, frame, x, y, z, qx, qy, qz, qw. NumPy raises ValueError for others.
    try:
        rows = np.loadtxt(io.BytesIO(read_bytes(path)), delimiter=",", skiprows=1, usecols=range(9))
        poses = {int(row[1]): _pose_of(row[2:5], row[5:]) for row in np.atleast_2d(rows)}
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: a row is not timestamp, frame, x, y, z, qx, qy, qz, qw ({one_line(error)});"
            " export the recording again"
        ) from error
    return _add_pose(poses)


def _poses_of_record3d(place: Path) -> Finish:
    """The function that gives frames the poses of Record3D, by their number."""
    path = place / _METADATA
    # Rows of qx, qy, qz, qw, x, y, z, one a frame; NumPy raises these errors for other contents.
    try:
        rows = [np.array(row, np.float64) for row in read_json(path).get("poses", [])]
        poses = {number: _pose_of(row[4:], row[:4], y_up=True) for number, row in enumerate(rows)}
    except (TypeError, ValueError):
        raise InputError(
            f"{path}: poses are not rows of qx qy qz qw x y z; export the recording again"
        ) from None
    return _add_pose(poses)


def _pose_of(position: Floats, xyzw: Floats, *, y_up: bool = False) -> Pose:
    """The pose of a camera whose axes are x right, y down, z forward.

    Args:
        position: (3,) of the camera in the world.
        xyzw: (4,) quaternion of the camera in the world.
        y_up: Whether the quaternion is of axes x right, y up, z backwards.

    Raises:
        ValueError: The numbers are no pose.
    """
    rotation = rotation_of(np.roll(xyzw, 1))  # which takes w first
    if y_up:  # y and z of the camera have the other direction
        rotation = rotation * np.array([1, -1, -1])
    pose = np.column_stack([rotation, position])
    if pose.shape != (3, 4) or not np.isfinite(pose).all():
        raise ValueError
    return as_pose(pose)


STRAY_SCANNER = layout_of_folders(
    {
        "sparse": r"depth/(\d+).DEPTH",
        "image": "rgb/*.IMAGE",
        "sparse_mask": r"confidence/(\d+).png?",
    },
    marks=("camera_matrix.csv", _ODOMETRY),
    calib="camera_matrix.csv",
    finish_of=_poses_of_stray_scanner,
    shared=FrameFiles(sparse_scale=1000.0, one_view=True),
)
RECORD3D = layout_of_folders(
    {"image": r"rgb/(\d+).IMAGE", "sparse": r"depth/(\d+).exr"},
    marks=(_METADATA,),
    calib=_METADATA,
    finish_of=_poses_of_record3d,
    shared=FrameFiles(one_view=True),
)
