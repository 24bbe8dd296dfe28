"""Finds the frames of a batch, and how each is refined, from which files. Imports no torch."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

import numpy as np

from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset import frame_files
from pnpdepth_cli.dataset.frame_files import (
    FrameFiles,
    Neighbour,
    Unmatched,
    as_pose,
    groups_of,
)
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.file_record import file_and_part
from pnpdepth_cli.io.colmap_model import model_files
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.poses import POSES_FILE, poses_of_frames
from pnpdepth_cli.protocols import find_protocol

CSV = "summary.csv"
JSON = "summary.json"
_PREDICTED_SUFFIXES = (*DEPTH_SUFFIXES, *frame_files.IMAGE_SUFFIXES, ".bin")
"""Suffixes of depth maps of networks: formats of depth, images, and COLMAP's dense maps."""
_SEARCHED = 3
"""Frames at the start of a sequence for which it is searched how image and points belong together;
the others are of the same sensors."""
ESTIMATED = "estimated from the images"
"""Where the motion of frames without poses is from."""


@dataclass(frozen=True, kw_only=True)
class BatchFrames:
    """The frames of a batch."""

    layout: str
    """Name of the layout of the source."""
    frames: Sequence[FrameFiles]
    """All frames of the source."""
    chosen: Sequence[FrameFiles]
    """Those of `frames` that the names, the limit and the shard choose."""
    unmatched: Sequence[str]
    """Files that are in no frame, and why, a line each."""
    poses: str | None
    """Where the poses of the frames are from, as a line; None without poses."""


def find_frames(request: BatchRequest) -> BatchFrames:
    """Returns the frames of the source, and those of them that this run refines.

    Raises:
        InputError: If there is none, or a result would have no files of its own.
        UsageError: If none has sparse depth.
        OutputError: If the output is a file, or holds the frames.
    """
    # The frames of the layout, which have what a refinement needs; the output is a folder beside.
    source, output = request.source, request.output
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; name a folder")
    layout, frames, lost = list_frames(source, request.layout)
    _check_folder(source, output, frames)
    _check_usable(request, layout, frames, lost)
    _check_names(frames, request.refine)
    # What is read of each; poses and neighbours, of all frames.
    frames, poses = _with_poses(request, [_as_requested(request, frame) for frame in frames])
    for sequence in sequences_of(frames).values():
        for index in sequence[_SEARCHED:]:
            frames[index] = replace(frames[index], is_first=False)
    # The frames that this run refines: those of the names, every n-th, the first, of a shard.
    chosen = [frame for frame in frames if fnmatchcase(frame.name, request.names or "*")]
    if not chosen:
        raise UsageError(
            f"no frame of {source} has a name like {request.names!r}; the first is {frames[0].name}"
        )
    shard, shards = request.shard or (1, 1)
    chosen = chosen[:: request.every][: request.limit][shard - 1 :: shards]
    # Only these need a depth map of the user's network.
    if request.depth is not None:
        chosen = _with_depths(request.depth, chosen)
        by_name = {frame.name: frame for frame in chosen}
        frames = [by_name.get(frame.name, frame) for frame in frames]
    return BatchFrames(
        layout=layout,
        frames=frames,
        chosen=chosen,
        unmatched=[f"{path} {why}" for path, why in lost if not _is_inside(path, output)],
        poses=poses,
    )


def _check_folder(source: Path, output: Path, frames: Sequence[FrameFiles]) -> None:
    """Raises OutputError if the output folder holds the frames or their files.

    Args:
        source: The folder or the list of the frames.
        output: The output folder.
        frames: The frames.
    """
    files = [file for frame in frames for file in (frame.image, frame.sparse, frame.gt)]
    folders = {source}
    folders |= {frame_files.file_of(file).parent for file in files if file is not None}
    if any(folder.is_dir() and _is_inside(folder, output) for folder in folders):
        raise OutputError(
            f"{output} holds the frames; name a folder of its own, such as {output / 'out'}"
        )


def _check_usable(
    request: BatchRequest, layout: str, frames: Sequence[FrameFiles], lost: Sequence[Unmatched]
) -> None:
    """Raises an error if there is no frame, or none has what is asked for.

    Args:
        request: The batch.
        layout: Name of the layout of the source.
        frames: Its frames.
        lost: Files that are in no frame, and why.

    Raises:
        InputError: There is no frame.
        UsageError: None has sparse depth, or ground truth to draw it from, or a confidence mask.
    """
    source = request.source
    if not frames:
        first = ""
        if lost:
            path, why = lost[0]
            first = f" ({path} {why})"
        raise InputError(
            f"{source} looks like {layout!r} but has no frame{first}; known: {', '.join(LAYOUTS)}"
        )
    if request.reading.sample is None and all(frame.sparse is None for frame in frames):
        if all(frame.gt is None for frame in frames):
            raise UsageError(
                f"{source} looks like {layout!r}, which has no sparse depth; nor has it ground"
                " truth to draw points from; add one of them"
            )
        raise UsageError(
            f"{source} looks like {layout!r}, which has no sparse depth; --sample 500 draws so many"
            " points from the ground truth"
        )
    has_masks = any(frame.sparse_mask is not None for frame in frames)
    if request.refine.files.min_confidence is not None and not has_masks:
        raise UsageError(f"no frame of {source} has a confidence mask; leave out --min-confidence")


def _with_depths(folder: Path, frames: Sequence[FrameFiles]) -> list[FrameFiles]:
    """The frames with their depth maps of a folder, by the name of the frame or of its image.

    Args:
        folder: The depth maps that a network predicted.
        frames: The frames, all of which need one.

    Raises:
        InputError: A frame has none.
    """
    maps, _ = frame_files.find_files(folder, _PREDICTED_SUFFIXES)
    with_depths = list[FrameFiles]()
    for frame in frames:
        image = frame.image_file
        names = [frame.name] if image is None else [frame.name, image.stem]
        path = next((maps[name] for name in names if name in maps), None)
        if path is None:
            raise InputError(
                f"--depth {folder} has no depth map named {' or '.join(dict.fromkeys(names))};"
                " name each as its frame or its image"
            )
        with_depths.append(replace(frame, depths=(path,)))
    return with_depths


def _with_poses(
    request: BatchRequest, frames: list[FrameFiles]
) -> tuple[list[FrameFiles], str | None]:
    """The frames with their poses and neighbours, and where the poses are from, as a line.

    The line is None if there are no poses and no neighbours.

    Args:
        request: The batch, which may name a file of poses, and asks for neighbours.
        frames: All frames, some with poses of their layout.

    Raises:
        InputError: The poses cannot be read or are of other frames, and are needed.
        UsageError: Poses or neighbours are asked for of frames that cannot have them.
    """
    # Poses of a file, or the frames' own.
    path = request.poses
    beside = request.source / POSES_FILE  # as `pnpdepth frames` writes it
    if path is None and not any(frame.pose for frame in frames) and beside.is_file():
        path = beside
    source = "the layout's"
    if path is not None:
        if any(frame.sparse is not None and frame.sparse.is_dir() for frame in frames):
            raise UsageError("--poses: the COLMAP model has those of its images; leave it out")
        # A file that nobody named, for records alone, is left out if it does not fit.
        try:
            poses, how = poses_of_frames(path, [frame.name for frame in frames], request.pose_kind)
        except InputError as error:
            if request.poses is not None or request.accumulate:
                raise
            return frames, f"note: {error}; records get no poses"
        frames = [
            replace(frame, pose=as_pose(pose)) for frame, pose in zip(frames, poses, strict=True)
        ]
        source = f"{path}, {how}"
    if request.accumulate:
        frames = _with_neighbours(frames, request.accumulate, source)
    # Poses of some frames, all, or none.
    count = sum(frame.pose is not None for frame in frames)
    if not count:
        return frames, f"poses: {ESTIMATED}" if request.accumulate else None
    which_frames = "" if count == len(frames) else f" ({count:,} of {len(frames):,} frames)"
    return frames, f"poses: {source}{which_frames}"


def sequences_of(frames: Sequence[FrameFiles]) -> dict[str, list[int]]:
    """Returns the indices of the frames of each sequence, in order, by the sequence's name.

    A sequence is what one camera took in one go: the cameras of a drive are sequences of their own.
    """
    groups = groups_of([frame.name for frame in frames], [frame.group for frame in frames])
    sequences: dict[str, list[int]] = {}
    for index, (frame, group) in enumerate(zip(frames, groups, strict=True)):
        name = group if frame.camera is None else f"{group}_{frame.camera}"
        sequences.setdefault(name, []).append(index)
    return sequences


def _with_neighbours(frames: list[FrameFiles], reach: int, source: str) -> list[FrameFiles]:
    """The frames, each with those at most `reach` before and after it in its sequence.

    Args:
        frames: All frames, in order.
        reach: How many frames before, and as many after, are neighbours of one.
        source: Where poses are from, for a person.

    Raises:
        UsageError: A neighbour has no points, or neither image nor pose.
    """
    with_neighbours = [*frames]
    for indices in sequences_of(frames).values():
        # A place counts the frames of the sequence, an index all frames.
        for place, index in enumerate(indices):
            first = max(0, place - reach)
            last = min(place + reach, len(indices) - 1)
            neighbours = []
            for near_place in range(first, last + 1):
                if near_place != place:
                    near = frames[indices[near_place]]
                    apart = abs(near_place - place)
                    neighbours.append(_neighbour(frames[index], near, apart, source))
            with_neighbours[index] = replace(frames[index], neighbours=tuple(neighbours))
    return with_neighbours


def _neighbour(frame: FrameFiles, near: FrameFiles, apart: int, source: str) -> Neighbour:
    """A near frame as a neighbour of a frame, with the motion that their poses give.

    Args:
        frame: The frame that gets the points of the other.
        near: The other one.
        apart: How many frames it is before or after.
        source: Where poses are from, for a person.

    Raises:
        UsageError: The neighbour has no points that can be moved, or neither image nor pose.
    """
    if near.sparse is not None and near.sparse.is_dir():
        raise UsageError(
            f"{near.name}: --accumulate takes depth maps or scans, not a COLMAP model; leave it out"
        )
    if near.sparse is None and near.gt is None:
        raise UsageError(
            f"{near.name}: --accumulate takes depth maps or scans, not images alone; leave it out"
        )
    if frame.pose is None or near.pose is None:
        if near.image is None:
            raise UsageError(f"{near.name}: --accumulate of frames without images needs --poses")
        return Neighbour(files=near, motion=None, poses=ESTIMATED, apart=apart)
    # Both poses (R, t) lead to the world, so (Rᵀ R_near, Rᵀ (t_near − t)) leads from the
    # neighbour's coordinates to the frame's.
    pose = np.array(frame.pose)
    motion = np.array(near.pose)
    motion[:, 3] -= pose[:, 3]
    motion = pose[:, :3].T @ motion
    return Neighbour(files=near, motion=as_pose(motion), poses=source, apart=apart)


def request_of(request: BatchRequest, frame: FrameFiles) -> RefineRequest:
    """Returns the request by which one frame of a batch is read and refined.

    Args:
        request: The batch.
        frame: A frame of `find_frames`.
    """
    return replace(request.refine, files=frame, reading=request.reading)


def _as_requested(request: BatchRequest, frame: FrameFiles) -> FrameFiles:
    """The frame with the user's least confidence, the protocol's part, and where points are from.

    A least confidence that the data set has for this one frame goes before the user's.

    Args:
        request: The batch, which may have a least confidence, a protocol, and points to sample.
        frame: The frame as the data set has it.
    """
    if frame.sparse_mask is not None and frame.min_confidence is None:
        frame = replace(frame, min_confidence=request.refine.files.min_confidence)
    if request.protocol is not None:
        frame = replace(frame, part=find_protocol(request.protocol).part or frame.part)
    if request.reading.sample is None:
        return frame
    # Points are sampled from the ground truth, else from the projected scan.
    truth = frame.gt
    scan = frame.sparse
    if truth is None and scan is not None:
        truth = scan if scan.suffix.lower() in frame_files.SCAN_ONLY_SUFFIXES else None
    return replace(frame, sparse=None, gt=truth)


def input_files(request: RefineRequest) -> Iterator[tuple[str, Path]]:
    """Yields the files that are read for a frame: what each is, such as "image", and its path."""
    files = request.files
    scan = request.reading.scan
    # None where the frame has no such file.
    sources = {"image": files.image, "sparse": files.sparse, "gt": files.gt}
    for number, depth in enumerate(files.depths, 1):
        sources[f"depth {number}"], _ = file_and_part(depth)
    if files.sparse is not None:
        sources["sparse mask"] = files.sparse_mask
    # The points of its neighbours, which may be sampled from their ground truth, and the images by
    # which a motion is estimated.
    for neighbour in files.neighbours:
        points = neighbour.files.sparse or neighbour.files.gt
        if points is not None:
            sources[f"sparse of {points.stem}"] = points
            if neighbour.motion is None:
                sources[f"image of {points.stem}"] = neighbour.files.image
    # Masks, and what calibrates the camera, by the user or else by the data set.
    if files.gt is not None:
        sources |= {f"mask {number}": path for number, path in enumerate(files.masks)}
    sources |= {"extrinsics": scan.extrinsics, "calib": scan.over(files).calib}
    # A folder, of a COLMAP model or of KITTI's calibrations, stands for the files in it.
    for name, source in sources.items():
        path = None if source is None else frame_files.file_of(source)
        if path is not None and path.is_dir():
            inside = model_files(path) if name == "sparse" else sorted(path.glob("calib_*.txt"))
            yield from ((f"{name} {file.name}", file) for file in inside)
        elif path is not None:
            yield name, path


def _check_names(frames: Sequence[FrameFiles], refine: RefineRequest) -> None:
    """Raises InputError for a frame whose results would need a file of another or no valid name.

    Args:
        frames: All frames of the batch.
        refine: How a frame is refined, which says which files a result has.
    """
    endings = [path.name for path in refine.outputs_in(Path(), "").values()]
    owners = dict.fromkeys((CSV, JSON), "the batch")  # who writes a file or folder, by its path
    for frame in frames:
        # Names that differ in Unicode normalisation only are one file on macOS.
        name = unicodedata.normalize("NFC", frame.name)
        shown = one_line(repr(frame.name))
        files = [name + ending for ending in endings]
        folders = [str(folder) for folder in PurePosixPath(name).parents]
        problem = frame_files.name_problem(frame.name)
        if name.startswith(".batch"):
            problem = "is one of the batch's own"
        for path in (*files, *folders):
            if path in owners:
                problem = f"needs a file of {owners[path]}"
        if problem is not None:
            raise InputError(f"the name of frame {shown} {problem}; rename it")
        owners |= dict.fromkeys(files, f"frame {shown}")


def _is_inside(path: Path, folder: Path) -> bool:
    """Whether a path is the folder or lies in it, links followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
