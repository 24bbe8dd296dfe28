"""Sets whose index names the images and has their poses.

`tum`: TUM RGB-D, rgb.txt and depth.txt with a time and a path per line, paired by time. An
associations.txt (of TUM's associate.py, or of ICL-NUIM) pairs them itself: a time and a path twice
per line. Poses are those of groundtruth.txt beside them, at the times of the images.

`colmap`: a COLMAP project, images/ and sparse/0/, or sparse/, or a model beside images/, as that of
ETH3D's undistorted images in dslr_calibration_undistorted/, or Nerfstudio's colmap/sparse/0/. The
images of dense/, which COLMAP undistorts, are a project of their own: dense/images/ and
dense/sparse/. Of several models, sparse/0 to sparse/N, the one with the most images is used. The
folder of a model in a project is read, too.

`stray-scanner`, of phones with a LiDAR, whose depth is of the image's view but smaller: the folder
of the app Stray Scanner: rgb.mp4, depth/ in millimetres, confidence/ (0 to 2), camera_matrix.csv,
and odometry.csv with a row of time, frame, position and quaternion for each frame, in axes x right,
y down, z forward.

`record3d`, of phones, too: the folder EXR_RGBD of Record3D's export "EXR + RGB": rgb/, depth/ in
metres, and metadata.json with K and w, h of the images and a row of quaternion and position for
each frame, in ARKit's axes x right, y up, z backwards.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.dataset.frame_files import (
    IMAGE_SUFFIXES,
    FrameFiles,
    Pose,
    Unmatched,
    as_pose,
    find_files,
)
from pnpdepth_cli.dataset.layouts.layout import Layout, row
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.colmap_model import model_files, read_model
from pnpdepth_cli.io.extrinsics import rotation_of
from pnpdepth_cli.io.file_bytes import numbered_lines, one_line, read_bytes
from pnpdepth_cli.io.poses import LONGEST_GAP_S, read_trajectory
from pnpdepth_cli.io.text_files import read_json

_OF_ETH3D = "dslr_calibration_undistorted"
_ASSOCIATIONS = "associations.txt"
_ODOMETRY, _METADATA = "odometry.csv", "metadata.json"
_LONGEST_POSE_GAP_S = 0.1
"""Longest gap between poses that are interpolated; motion capture takes them at 100 Hz."""

Timed = tuple[float, Path]


def _is_tum(root: Path) -> bool:
    names = ("rgb.txt", "depth.txt")
    return (root / _ASSOCIATIONS).is_file() or all((root / name).is_file() for name in names)


def _frames_of_tum(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """One frame for each image with a depth image within 0.02 s; each is used once."""
    poses = root / "groundtruth.txt"
    trajectory = read_trajectory(poses) if poses.is_file() else None
    # A file of pairs, if there is one; else each image has the depth image closest in time.
    if (root / _ASSOCIATIONS).is_file():
        pairs = _timed_files(root / _ASSOCIATIONS, 2)
    else:
        images, depths = (
            sorted(timed for (timed,) in _timed_files(root / name, 1))
            for name in ("rgb.txt", "depth.txt")
        )
        partner_of: dict[int, int] = {}
        taken: set[int] = set()
        for image, depth in _close_pairs(images, depths):
            if image not in partner_of and depth not in taken:
                partner_of[image] = depth
                taken.add(depth)
        pairs = [[images[i], depths[partner_of[i]]] for i in sorted(partner_of)]
        # Files without a partner are spare.
        for timed, used, other in ((images, partner_of, "depth"), (depths, taken, "image")):
            why = f"has no {other} within {LONGEST_GAP_S} s that is not another's"
            for number, (_, path) in enumerate(timed):
                if number not in used:
                    yield Unmatched(path=path, why=why)
    # The frames, with poses where motion capture has them.
    for (time_s, image_path), (_, depth_path) in pairs:
        pose = None if trajectory is None else trajectory.at(time_s, _LONGEST_POSE_GAP_S)
        yield FrameFiles(
            name=image_path.stem,
            image=image_path,
            gt=depth_path,
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
            row = [(float(words[2 * i]), path.parent / words[2 * i + 1]) for i in range(count)]
        except (ValueError, IndexError):
            row = []
        known = row and all(math.isfinite(time_s) for time_s, _ in row)
        if not known or (count == 2 and (len(words) != 4 or sum(map(_is_depth, row)) != 1)):
            both = " of rgb, and a time and a path of depth" if count == 2 else ""
            raise FileFormatError(
                f"{path}, line {number}: {one_line(line)[:60]!r} is not a time and a path{both}"
            )
        rows.append(sorted(row, key=_is_depth) if count == 2 else row)
    return rows


def _is_depth(timed: Timed) -> bool:
    return "depth" in timed[1].parts[-2:][0].lower()


def _close_pairs(images: list[Timed], depths: list[Timed]) -> list[tuple[int, int]]:
    """Indices of images and depths at most 0.02 s apart, the closest first; times are sorted."""
    times, reach = [time for time, _ in depths], 2 * LONGEST_GAP_S
    pairs = [
        (abs(times[depth] - time), image, depth)
        for image, (time, _) in enumerate(images)
        for depth in range(bisect_left(times, time - reach), bisect_right(times, time + reach))
    ]
    return [(image, depth) for gap, image, depth in sorted(pairs) if gap <= LONGEST_GAP_S]


TUM = Layout(matches=_is_tum, frames=_frames_of_tum, needs=("rgb.txt", "depth.txt"))


def _colmap_models(root: Path) -> list[Path]:
    """The folders of models, sparse/0 first; none without images."""
    parents = [path for path in (root / "sparse", root / "colmap/sparse") if path.is_dir()]
    inside = [p for sparse in parents for p in sparse.iterdir() if p.name.isdigit()]
    numbered = sorted(inside, key=lambda p: int(p.name))
    folders = (*numbered, *parents, root, root / _OF_ETH3D)
    found = [folder for folder in folders if model_files(folder)]
    return found if _photos(root) else []


def _photos(root: Path) -> Path | None:
    """The folder images/ of a project, or of that whose sparse/0, say, this is."""
    above = root.absolute().parents[:3] if model_files(root) else ()
    return next((p / "images" for p in (root, *above) if (p / "images").is_dir()), None)


def _of_colmap(root: Path) -> Iterator[FrameFiles | Unmatched]:
    """One frame for each registered image that exists."""
    models = [read_model(folder) for folder in _colmap_models(root)]
    model, photos = max(models, key=lambda other: len(other.images)), _photos(root)
    assert photos is not None
    files, unreadable = find_files(photos, IMAGE_SUFFIXES)
    yield from unreadable
    for path in files.values():
        if path.relative_to(photos).as_posix() not in model.images:
            why = f"is not registered in {model.folder}"
            yield Unmatched(path=path, why=why)
    for other in models:
        if other is not model:
            why = f"is another model, of {len(other.images):,} images, in a unit of its own"
            yield Unmatched(path=other.folder, why=why)
    for name, image in sorted(model.images.items()):
        path = photos / name
        if not path.is_file():
            why = f"is missing, but registered in {model.folder}; add it"
            yield Unmatched(path=path, why=why)
            continue
        pose = as_pose(np.column_stack(image.pose.inverse()))  # COLMAP's is of the world
        stem = Path(name).with_suffix("").as_posix()
        yield FrameFiles(name=stem, image=path, sparse=model.folder, pose=pose)


COLMAP = Layout(matches=_colmap_models, frames=_of_colmap, needs=("images", "sparse/*/cameras.*"))


def _of_stray_scanner(place: Path) -> Callable[[FrameFiles], FrameFiles]:
    path, poses = place / _ODOMETRY, dict[int, Pose]()
    lines = read_bytes(path).decode("utf-8", "replace").splitlines()
    for number, line in enumerate(lines[1:], start=2):
        try:
            _, frame, *values = map(float, line.split(",")[:9])
            poses[int(frame)] = _pose(values[:3], values[3:])
        except (ValueError, OverflowError):
            raise FileFormatError(
                f"{path}, line {number}: not timestamp, frame, x, y, z, qx, qy, qz, qw"
            ) from None
    return lambda frame: replace(frame, pose=poses.get(int(frame.name)))


def _of_record3d(place: Path) -> Callable[[FrameFiles], FrameFiles]:
    path = place / _METADATA
    try:
        rows = [[float(value) for value in row] for row in read_json(path).get("poses", [])]
        poses = {n: _pose(row[4:], row[:4], y_up=True) for n, row in enumerate(rows)}
    except (TypeError, ValueError):
        raise FileFormatError(f"{path}: poses are not rows of qx qy qz qw x y z") from None
    return lambda frame: replace(frame, pose=poses.get(int(frame.name)))


def _pose(position: list[float], xyzw: list[float], y_up: bool = False) -> Pose:
    """The pose with the axes x right, y down, z forward. ValueError for none."""
    x, y, z, w = xyzw
    turn = rotation_of(np.array([w, x, y, z]))
    pose = np.column_stack([turn * (1, -1, -1) if y_up else turn, position])
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
    sparse_scale=1000.0,
    one_view=True,
)
RECORD3D = row(
    {"image": r"rgb/(\d+).IMAGE", "sparse": r"depth/(\d+).exr"},
    marks=(_METADATA,),
    calib=_METADATA,
    more=_of_record3d,
    one_view=True,
)
