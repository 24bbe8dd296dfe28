"""`kitti-odometry`: sequences/NN/ with image_2/, velodyne/ and calib.txt, or one such sequence.

The ground truth of the paper's experiments is the scan itself: `batch --sample 500` projects it and
draws 500 of its points. The training sequences, 00 to 10, have the
poses of camera 0 in poses/NN.txt beside sequences/, a row of 12 numbers per frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.dataset.frame import (
    IMAGE_SUFFIXES,
    Frame,
    Listing,
    Pose,
    Unmatched,
    by_stem,
    without_partner,
)
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts import Layout


def matches(root: Path) -> bool:
    """Returns whether the folder holds sequences with scans, or is one."""
    return bool(_sequences(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each image of the left colour camera with a scan, by sequence.

    Poses belong to frames by number, so that a part of a sequence keeps its own.

    Raises:
        InputError: A frame has no row in an existing file of poses.
    """
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    spare: list[Unmatched] = []
    for sequence in _sequences(root):
        scans = by_stem(sequence / "velodyne", (".bin",))
        images = by_stem(sequence / "image_2", IMAGE_SUFFIXES)
        poses = _poses(sequence)
        frames += [
            Frame(
                name=f"{sequence.name}_{stem}",
                image=image,
                sparse=scans[stem],
                calib=sequence / "calib.txt",
                camera=2,
                protocol=PROTOCOLS["kitti-odometry"],
                pose=None if poses is None else _pose_of(poses, image),
            )
            for stem, image in images.items()
            if stem in scans
        ]
        broken += without_partner(images, scans, sequence / "velodyne")
        spare += without_partner(scans, images, sequence / "image_2")
    return Listing(frames=frames, broken=tuple(broken), spare=tuple(spare))


def _sequences(root: Path) -> list[Path]:
    inside = (root / "sequences", root / "dataset" / "sequences")
    candidates = [root, *(p for folder in inside if folder.is_dir() for p in folder.iterdir())]
    return sorted(
        p
        for p in candidates
        if (p / "calib.txt").is_file() and (p / "image_2").is_dir() and (p / "velodyne").is_dir()
    )


def _poses(sequence: Path) -> list[Pose] | None:
    """The poses of the sequence by frame number; None without a file."""
    # the parents of "." are only in its absolute path
    folder = sequence.absolute()
    path = folder.parents[1] / "poses" / f"{folder.name}.txt"
    if not path.is_file():
        return None
    lines = read_bytes(path).decode("utf-8", "replace").splitlines()
    return [_pose(path, number, line) for number, line in enumerate(lines, 1) if line.strip()]


def _pose_of(poses: list[Pose], image: Path) -> Pose:
    if not image.stem.isdigit() or int(image.stem) >= len(poses):
        raise InputError(
            f"{image} has no pose: its sequence's file holds {len(poses):,} poses, by frame number"
        )
    return poses[int(image.stem)]


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


LAYOUT = Layout(
    matches=matches,
    listing=listing,
    needs=("sequences/*/image_2", "sequences/*/velodyne", "sequences/*/calib.txt"),
)
