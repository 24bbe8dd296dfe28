"""The sequences that the frames of a data set are of: their poses and neighbours."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset.frame_files import FrameFiles, Neighbour, groups_by_name
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.poses import poses_of_frames

KnownPose = tuple[NDArray[np.float64], str]
"""(3, 4) from the camera's coordinates to the world's in metres, and where it is from."""
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


def known_poses(
    frames: Sequence[FrameFiles], path: Path | None = None, kind: str | None = None
) -> list[KnownPose | None]:
    """Returns the pose of each frame; None where it is unknown.

    Args:
        frames: All frames of the data set.
        path: A file of `poses_of_frames`. None: the frames' own poses.
        kind: What the poses of the file are, as `poses_of_frames` takes it.

    Raises:
        InputError: The file has another number of poses, or cannot be read.
        UsageError: The frames have the poses of a COLMAP model, and a file is given.
    """
    if path is not None:
        if any(frame.sparse is not None and frame.sparse.is_dir() for frame in frames):
            raise UsageError("--poses: the COLMAP model has those of its images; leave it out")
        rows, how = poses_of_frames(path, [frame.name for frame in frames], kind)
        return [(row, f"{path}, {how}") for row in rows]
    return [None if f.pose is None else (np.array(f.pose), "the layout's") for f in frames]


def with_neighbours(
    frames: Sequence[FrameFiles], reach: int, known: Sequence[KnownPose | None]
) -> list[FrameFiles]:
    """Returns the frames, each with those at most `reach` before and after it in its sequence.

    Args:
        frames: All frames of the data set.
        reach: Number of frames to each side.
        known: The pose of each frame. None: the motion is to be estimated.

    Raises:
        UsageError: A frame has no points, or its points are those of all images already;
            or neither its pose nor its image is known.
    """
    result = list(frames)
    for sequence in sequences_of(frames).values():
        for number, index in enumerate(sequence):
            near = range(max(0, number - reach), min(len(sequence), number + reach + 1))
            neighbours = (
                _neighbour(frames[sequence[other]], known[sequence[other]], known[index], apart)
                for other in near
                if (apart := abs(other - number))
            )
            result[index] = replace(frames[index], neighbours=tuple(neighbours))
    return result


def note_of_poses(known: Sequence[KnownPose | None], otherwise: str) -> str:
    """Returns where the poses of the frames are from, as a line."""
    counts = Counter(otherwise if pose is None else pose[1] for pose in known)
    if len(counts) == 1:
        return f"poses: {next(iter(counts))}"
    kinds = ", ".join(f"{poses} ({count:,} of {len(known):,})" for poses, count in counts.items())
    return f"poses: {kinds}"


def _neighbour(
    other: FrameFiles, other_pose: KnownPose | None, pose: KnownPose | None, apart: int
) -> Neighbour:
    if (other.sparse or other.gt) is None or (other.sparse is not None and other.sparse.is_dir()):
        raise UsageError(
            f"{other.name}: --accumulate takes depth maps or scans of single frames, not"
            f" {'images alone' if other.sparse is None else 'a COLMAP model'}"
        )
    if pose is None or other_pose is None:
        if other.image is None:
            raise UsageError(
                f"{other.name}: --accumulate needs the poses of frames without images; give --poses"
            )
        return Neighbour(files=other, motion=None, poses=ESTIMATED, apart=apart)
    (matrix, source), (other_matrix, _) = pose, other_pose
    turn = matrix[:, :3].T @ other_matrix[:, :3]
    shift = matrix[:, :3].T @ (other_matrix[:, 3] - matrix[:, 3])
    motion = tuple(map(tuple, np.column_stack([turn, shift]).tolist()))
    return Neighbour(files=other, motion=motion, poses=source, apart=apart)
