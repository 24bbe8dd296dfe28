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
from collections.abc import Callable, Iterator
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
from pnpdepth_cli.dataset.layouts.layout import Layout, lacking, row
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.colmap_model import model_files, read_model
from pnpdepth_cli.io.file_bytes import numbered_lines, one_line, read_bytes, read_json
from pnpdepth_cli.io.poses import LONGEST_GAP_S, read_trajectory, rotation_of

_OF_ETH3D = "dslr_calibration_undistorted"
_ASSOCIATIONS = "associations.txt"
_ODOMETRY = "odometry.csv"
_METADATA = "metadata.json"
_LONGEST_POSE_GAP_S = 0.1
"""Between poses; motion capture takes them at 100 Hz."""

Timed = tuple[float, Path]


def _frames_of_tum(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """One frame for each image with a depth image of its own within 0.02 s."""
    # A file of pairs, if there is one; else images and depth images that are nearest to each other.
    if (root / _ASSOCIATIONS).is_file():
        pairs = [sorted(row, key=_is_depth) for row in _timed_files(root / _ASSOCIATIONS, 2)]
    else:
        images, depths = (
            sorted(timed for (timed,) in _timed_files(root / name, 1))
            for name in ("rgb.txt", "depth.txt")
        )
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
    """The times and paths of each line: one pair, or those of an image and of its depth."""
    rows = []
    for number, line in numbered_lines(read_bytes(path)):
        words = line.split()
        try:
            times = [float(time_s) for time_s in words[::2]]
            row = list(zip(times, [path.parent / name for name in words[1::2]], strict=True))
        except ValueError:
            row = []
        finite = all(math.isfinite(time_s) for time_s, _ in row)
        if len(row) != count or not finite or (count == 2 and sum(map(_is_depth, row)) != 1):
            raise InputError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path for each"
                " image and depth; correct it"
            )
        rows.append(row)
    return rows


def _is_depth(timed: Timed) -> bool:
    return "depth" in timed[1].parts[-2:][0].lower()


def _nearest_pairs(images: list[Timed], depths: list[Timed]) -> list[list[Timed]]:
    """Images and depth images at most 0.02 s apart, each the nearest of the other."""
    if not images or not depths:
        return []
    times = [np.array([[time_s] for time_s, _ in timed]) for timed in (images, depths)]
    gaps, partners = cKDTree(times[1]).query(times[0])
    _, back = cKDTree(times[0]).query(times[1])
    return [
        [images[number], depths[partner]]
        for number, (gap, partner) in enumerate(zip(gaps, partners, strict=True))
        if gap <= LONGEST_GAP_S and back[partner] == number
    ]


_OF_TUM = (f"rgb.txt|{_ASSOCIATIONS}", f"depth.txt|{_ASSOCIATIONS}")
TUM = Layout(matches=lambda root: not lacking(root, _OF_TUM), frames=_frames_of_tum, needs=_OF_TUM)


def _colmap_models(root: Path) -> list[Path]:
    """The folders of models, sparse/0 first; none without images."""
    numbered = [*sorted(root.glob("sparse/[0-9]*")), *sorted(root.glob("colmap/sparse/[0-9]*"))]
    found = [p for p in (*numbered, root / "sparse", root, root / _OF_ETH3D) if model_files(p)]
    return found if _photos(root) else []


def _photos(root: Path) -> Path | None:
    """The folder images/ of a project, or of that whose sparse/0, say, this is."""
    above = root.absolute().parents[:3] if model_files(root) else ()
    return next((p / "images" for p in (root, *above) if (p / "images").is_dir()), None)


def _of_colmap(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """One frame for each registered image that exists."""
    models = [read_model(folder) for folder in _colmap_models(root)]
    model = max(models, key=lambda model: len(model.images))
    photos = _photos(root)
    if photos is None:
        raise InputError(f"{root} has no folder images with the photos of its model; add it")
    files, unreadable = find_files(photos, IMAGE_SUFFIXES)
    yield from unreadable
    for path in files.values():
        if path.relative_to(photos).as_posix() not in model.images:
            yield path, f"is not registered in {model.folder}"
    for smaller in models:
        if smaller is not model:
            why = f"is another model, of {len(smaller.images):,} images, in a unit of its own"
            yield smaller.folder, why
    for name, image in sorted(model.images.items()):
        path = photos / name
        if not path.is_file():
            yield path, f"is missing, but registered in {model.folder}; add it"
            continue
        pose = as_pose(np.column_stack(image.pose.inverse()))  # COLMAP's is of the world
        stem = Path(name).with_suffix("").as_posix()
        yield FrameFiles(name=stem, image=path, sparse=model.folder, pose=pose)


COLMAP = Layout(
    matches=_colmap_models, frames=_of_colmap, needs=("images", "sparse/0|sparse|colmap/sparse/0")
)


def _of_stray_scanner(place: Path) -> Callable[[FrameFiles], FrameFiles]:
    """Gives frames the poses of Stray Scanner, by their number."""
    path = place / _ODOMETRY
    try:
        rows = np.loadtxt(io.BytesIO(read_bytes(path)), delimiter=",", skiprows=1, usecols=range(9))
        poses = {int(row[1]): _pose(row[2:5], row[5:]) for row in np.atleast_2d(rows)}
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: a row is not timestamp, frame, x, y, z, qx, qy, qz, qw ({one_line(error)});"
            " export the recording again"
        ) from error
    return lambda frame: replace(frame, pose=poses.get(int(frame.name)))


def _of_record3d(place: Path) -> Callable[[FrameFiles], FrameFiles]:
    """Gives frames the poses of Record3D, by their number."""
    path = place / _METADATA
    try:
        rows = [np.array(row, np.float64) for row in read_json(path).get("poses", [])]
        poses = {n: _pose(row[4:], row[:4], y_up=True) for n, row in enumerate(rows)}
    except (TypeError, ValueError):
        raise InputError(
            f"{path}: poses are not rows of qx qy qz qw x y z; export the recording again"
        ) from None
    return lambda frame: replace(frame, pose=poses.get(int(frame.name)))


def _pose(position: Floats, xyzw: Floats, y_up: bool = False) -> Pose:
    """The pose with the axes x right, y down, z forward. ValueError for none."""
    turn = rotation_of(np.roll(xyzw, 1))
    if y_up:  # y and z of the camera have the other direction
        turn = turn * np.array([1, -1, -1])
    pose = np.column_stack([turn, position])
    if pose.shape != (3, 4) or not np.isfinite(pose).all():
        raise ValueError
    return as_pose(pose)


STRAY_SCANNER = row(
    {
        "sparse": r"depth/(\d+).DEPTH",
        "image": "rgb/*.IMAGE",
        "sparse_mask": r"confidence/(\d+).png?",
    },
    marks=("camera_matrix.csv", _ODOMETRY),
    calib="camera_matrix.csv",
    more=_of_stray_scanner,
    shared=FrameFiles(sparse_scale=1000.0, one_view=True),
)
RECORD3D = row(
    {"image": r"rgb/(\d+).IMAGE", "sparse": r"depth/(\d+).exr"},
    marks=(_METADATA,),
    calib=_METADATA,
    more=_of_record3d,
    shared=FrameFiles(one_view=True),
)
