"""The sequences that the frames of a data set are of: their poses and neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.dataset.frame_files import FrameFiles, Neighbour, as_pose, groups_by_name
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.poses import poses_of_frames

ESTIMATED = "estimated from the images"
"""Where the motion of frames without poses is from."""


def sequences_of(frames: Sequence[FrameFiles]) -> dict[str, list[int]]:
    """Returns the indices of the frames of each sequence, which one camera took, in order."""
    by_name = groups_by_name([frame.name for frame in frames])
    sequences: dict[tuple[str, int | None], list[int]] = {}
    for index, (frame, name) in enumerate(zip(frames, by_name, strict=True)):
        group = name if frame.group is None else frame.group
        sequences.setdefault((group, frame.camera), []).append(index)
    return {
        group if camera is None else f"{group}_{camera}": indices
        for (group, camera), indices in sequences.items()
    }


def with_poses(
    frames: Sequence[FrameFiles], path: Path | None, kind: str | None = None
) -> tuple[list[FrameFiles], str]:
    """Returns the frames with the poses of a file, and where their poses are from.

    Args:
        frames: All frames of the data set.
        path: A file of `poses_of_frames`. None: the frames' own poses.
        kind: What the poses of the file are, as `poses_of_frames` takes it.

    Raises:
        InputError: The file has another number of poses, or cannot be read.
        UsageError: The frames have the poses of a COLMAP model, and a file is given.
    """
    if path is None:
        return list(frames), "the layout's"
    if any(frame.sparse is not None and frame.sparse.is_dir() for frame in frames):
        raise UsageError("--poses: the COLMAP model has those of its images; leave it out")
    rows, how = poses_of_frames(path, [frame.name for frame in frames], kind)
    posed = [replace(frame, pose=as_pose(row)) for frame, row in zip(frames, rows, strict=True)]
    return posed, f"{path}, {how}"


def with_neighbours(
    frames: Sequence[FrameFiles], reach: int, source: str = "the layout's"
) -> list[FrameFiles]:
    """Returns the frames, each with those at most `reach` before and after it in its sequence.

    Args:
        frames: All frames of the data set. The motion of those without pose is to be estimated.
        reach: Number of frames to each side.
        source: Where the poses are from, for a person.

    Raises:
        UsageError: A frame has no points, or its points are those of all images already;
            or neither its pose nor its image is known.
    """
    result = list(frames)
    for sequence in sequences_of(frames).values():
        for number, index in enumerate(sequence):
            near = range(max(0, number - reach), min(len(sequence), number + reach + 1))
            neighbours = (
                _neighbour(frames[index], frames[sequence[other]], abs(other - number), source)
                for other in near
                if other != number
            )
            result[index] = replace(frames[index], neighbours=tuple(neighbours))
    return result


def _neighbour(frame: FrameFiles, other: FrameFiles, apart: int, source: str) -> Neighbour:
    if (other.sparse or other.gt) is None or (other.sparse is not None and other.sparse.is_dir()):
        raise UsageError(
            f"{other.name}: --accumulate takes depth maps or scans of single frames, not"
            f" {'images alone' if other.sparse is None else 'a COLMAP model'}"
        )
    if frame.pose is None or other.pose is None:
        if other.image is None:
            raise UsageError(
                f"{other.name}: --accumulate needs the poses of frames without images; give --poses"
            )
        return Neighbour(files=other, motion=None, poses=ESTIMATED, apart=apart)
    pose, other_pose = np.array(frame.pose), np.array(other.pose)
    turn = pose[:, :3].T @ other_pose[:, :3]
    shift = pose[:, :3].T @ (other_pose[:, 3] - pose[:, 3])
    motion = as_pose(np.column_stack([turn, shift]))
    return Neighbour(files=other, motion=motion, poses=source, apart=apart)
