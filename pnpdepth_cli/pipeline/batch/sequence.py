"""The sequences that the frames of a data set are of: their poses, neighbours and windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.dataset.frame import Frame, Neighbour
from pnpdepth_cli.io.oxts import read_oxts_poses
from pnpdepth_cli.io.poses import read_poses
from pnpdepth_cli.pipeline.evaluation.dependence import groups_by_name
from pnpdepth_cli.pipeline.refinement.method import needs_folds
from pnpdepth_cli.pipeline.refinement.request import RefineRequest

Floats = NDArray[np.float64]


def sequences_of(frames: Sequence[Frame]) -> list[list[int]]:
    """Returns the indices of the frames of each sequence, which one camera took, in order."""
    by_name = groups_by_name([frame.name for frame in frames])
    sequences: dict[tuple[str, int | None], list[int]] = {}
    for index, (frame, name) in enumerate(zip(frames, by_name, strict=True)):
        group = name if frame.group is None else frame.group
        sequences.setdefault((group, frame.camera), []).append(index)
    return list(sequences.values())


def with_windows(frames: Sequence[Frame], length: int) -> list[Frame]:
    """Returns the frames, each with its window: so many frames of its sequence in a row."""
    result = list(frames)
    for sequence in sequences_of(frames) if length else ():
        for place, index in enumerate(sequence):
            first = place - place % length
            window = tuple(frames[other] for other in sequence[first : place + 1])
            result[index] = replace(frames[index], window=window)
    return result


def in_windows(frames: Sequence[Frame]) -> list[list[Frame]]:
    """Returns the frames by window, in the order of the first frame of each."""
    windows: dict[str, list[Frame]] = {}
    for frame in frames:
        windows.setdefault((*frame.window, frame)[0].name, []).append(frame)
    return list(windows.values())


def check_warm_start(request: RefineRequest) -> None:
    """Raises UsageError if the method cannot begin where the frame before ended."""
    if needs_folds(request):
        raise UsageError(
            "--warm-start goes with a fixed method, not with the choice by held-out points; give"
            " --preset fast, or another option of the method"
        )
    if request.network.tile is not None:
        raise UsageError("--warm-start does not go with --tile")


def with_neighbours(frames: Sequence[Frame], reach: int, poses: Path | None) -> list[Frame]:
    """Returns the frames, each with those at most `reach` before and after it in its sequence.

    Args:
        frames: All frames of the data set.
        reach: Number of frames to each side; 0 returns the frames as they are.
        poses: A file with a row for each frame. None: the frames' own poses.

    Raises:
        InputError: A frame has no pose, or the file has another number of them.
        UsageError: The frames' points are those of all images already.
    """
    if not reach:
        return list(frames)
    known = _poses(frames, poses)
    result = list(frames)
    for sequence in sequences_of(frames):
        for place, index in enumerate(sequence):
            near = range(max(0, place - reach), min(len(sequence), place + reach + 1))
            neighbours = (
                _neighbour(frames[sequence[other]], known[sequence[other]], known[index], apart)
                for other in near
                if (apart := abs(other - place))
            )
            result[index] = replace(frames[index], neighbours=tuple(neighbours))
    return result


def _neighbour(other: Frame, other_pose: Floats, pose: Floats, apart: int) -> Neighbour:
    if other.sparse is None or other.sparse.is_dir():
        raise UsageError(
            f"{other.name}: --accumulate takes depth maps or scans of single frames, not"
            f" {'sampled points' if other.sparse is None else 'a COLMAP model'}"
        )
    rotation = pose[:, :3].T
    turn = rotation @ other_pose[:, :3]
    shift = rotation @ (other_pose[:, 3] - pose[:, 3])
    rows = np.column_stack([turn, shift])
    motion = tuple(tuple(float(value) for value in row) for row in rows)
    return Neighbour(sparse=other.sparse, motion=motion, apart=apart)


def _poses(frames: Sequence[Frame], path: Path | None) -> list[Floats]:
    """(3, 4) of each frame, from the camera's frame to the world's."""
    if path is not None:
        rows = read_poses(path)
        if len(rows) != len(frames):
            raise InputError(
                f"{path} has {len(rows)} poses for {len(frames)} frames; it needs one row for each,"
                " in the order of the frames"
            )
        return list(rows)
    poses = [None if frame.pose is None else np.array(frame.pose) for frame in frames]
    for sequence in sequences_of(frames):
        packets = [frames[index].oxts for index in sequence]
        first = frames[sequence[0]]
        if first.calib is not None and None not in packets:
            read = read_oxts_poses([p for p in packets if p], first.calib, first.camera)
            for index, pose in zip(sequence, read, strict=True):
                poses[index] = pose
    for frame, known in zip(frames, poses, strict=True):
        if known is None:
            raise InputError(
                f"{frame.name} has no camera pose, which --accumulate needs; give --poses"
            )
    return [pose for pose in poses if pose is not None]
