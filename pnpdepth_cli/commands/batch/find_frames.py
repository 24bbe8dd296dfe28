"""Finds the frames of a batch, and how each is refined, from which files. Imports no torch."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

import numpy as np

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.commands.requests import FramesRequest
from pnpdepth_cli.dataset import frame_files
from pnpdepth_cli.dataset.frame_files import FrameFiles, Neighbour, as_pose, groups_of
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.file_record import file_and_part
from pnpdepth_cli.io.bags import is_bag
from pnpdepth_cli.io.colmap_model import model_files
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.poses import POSES_FILE, poses_of_frames
from pnpdepth_cli.protocols import find_protocol

CSV, JSON = "summary.csv", "summary.json"
_SEARCHED = 3  # frames of a sequence, of which it is searched how image and points belong together
ESTIMATED = "estimated from the images"
"""Where the motion of frames without poses is from."""


@dataclass(frozen=True, kw_only=True)
class BatchFrames:
    """The frames of a batch."""

    layout: str
    frames: Sequence[FrameFiles]
    """All frames of the source."""
    chosen: Sequence[FrameFiles]
    """Frames of these that the names, the limit and the shard choose."""
    unmatched: Sequence[str]
    poses: str | None
    """Where the poses of the frames are from, as a line; None without poses."""


def unpack(request: BatchRequest, say: Callable[[str], None]) -> BatchRequest:
    """Returns the request with the frames of its bag as source; any other request as it is.

    The frames are written to OUTPUT_frames, and stay there for the next run.
    """
    if not is_bag(request.source):
        return request
    from pnpdepth_cli.commands.bag_frames import has_frames, write_frames

    folder = request.output.with_name(f"{request.output.name}_frames")
    whole = request.limit is None or request.names is not None
    between = None if whole else (0, request.every * (request.limit or 1) - 1)
    # The points are metres in these files, so a scale that the user states is of the bag.
    frames = FramesRequest(
        bag=request.source,
        output=folder,
        between=between,
        depth_scale=request.reading.depth_scale,
        overwrite=True,
    )
    if not has_frames(frames):
        say(f"bag: wrote {write_frames(frames, say):,} frames to {folder}")
    refine = request.refine.with_fields(depth_scale=None)
    return replace(request, source=folder, refine=refine)


def find_frames(request: BatchRequest) -> BatchFrames:
    """Returns the frames of the source.

    Raises:
        InputError: If there is none, or a result would have no files of its own.
        UsageError: If none has sparse depth.
        OutputError: If the output is a file, or holds the frames.
    """
    # The frames of the layout; the output must be a folder beside them.
    source, output = request.source, request.output
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; name a folder")
    layout, frames, lost = list_frames(source, request.layout)
    parts = (part for frame in frames for part in (frame.image, frame.sparse, frame.gt))
    folders = {source, *(frame_files.file_of(part).parent for part in parts if part is not None)}
    if any(folder.is_dir() and _is_inside(folder, output) for folder in folders):
        own = output / "out"
        raise OutputError(f"{output} holds the frames; name a folder of its own, such as {own}")
    # There must be some, with sparse depth and names that are fit for results.
    if not frames:
        first = " ({} {})".format(*lost[0]) if lost else ""
        known = ", ".join(LAYOUTS)
        raise InputError(f"{source} looks like {layout!r} but has no frame{first}; known: {known}")
    if request.reading.sample is None and all(frame.sparse is None for frame in frames):
        way_out = "--sample 500 draws so many points from the ground truth"
        if all(frame.gt is None for frame in frames):
            way_out = "nor has it ground truth to draw points from; add one of them"
        raise UsageError(f"{source} looks like {layout!r}, which has no sparse depth; {way_out}")
    masked = any(frame.sparse_mask is not None for frame in frames)
    if request.refine.files.min_confidence is not None and not masked:
        raise UsageError(f"no frame of {source} has a confidence mask; leave out --min-confidence")
    _check_names(frames, request.refine)
    # What is read of each; poses and neighbours, of all frames.
    frames, poses = _with_poses(request, [_as_requested(request, frame) for frame in frames])
    for sequence in sequences_of(frames).values():
        for index in sequence[_SEARCHED:]:
            frames[index] = replace(frames[index], is_first=False)
    # The part of the frames that this run refines.
    number, of = request.shard or (1, 1)
    chosen = [frame for frame in frames if fnmatchcase(frame.name, request.names or "*")]
    if not chosen:
        fact = f"no frame of {source} has a name like {request.names!r}"
        raise UsageError(f"{fact}; the first is {frames[0].name}")
    chosen = chosen[:: request.every][: request.limit][number - 1 :: of]
    if request.depth is not None:
        with_depths = _with_depths(request.depth, chosen)
        by_name = {frame.name: frame for frame in with_depths}
        chosen = with_depths
        frames = [by_name.get(frame.name, frame) for frame in frames]
    return BatchFrames(
        layout=layout,
        frames=frames,
        chosen=chosen,
        unmatched=[f"{path} {why}" for path, why in lost if not _is_inside(path, output)],
        poses=poses,
    )


def _with_depths(folder: Path, frames: Sequence[FrameFiles]) -> list[FrameFiles]:
    """The frames with their depth maps of a folder, by the name of the frame or of its image.

    Raises:
        InputError: A frame has none.
    """
    maps, _ = frame_files.find_files(folder, (*DEPTH_SUFFIXES, *frame_files.IMAGE_SUFFIXES, ".bin"))
    found = list[FrameFiles]()
    for frame in frames:
        image = frame.image_file
        names = [frame.name] if image is None else [frame.name, image.stem]
        path = next((maps[name] for name in names if name in maps), None)
        if path is None:
            raise InputError(
                f"--depth {folder} has no depth map named {' or '.join(dict.fromkeys(names))};"
                " name each as its frame or its image"
            )
        found.append(replace(frame, depths=(path,)))
    return found


def _with_poses(
    request: BatchRequest, frames: list[FrameFiles]
) -> tuple[list[FrameFiles], str | None]:
    """The frames with their poses and neighbours, and where the poses are from, as a line."""
    # Poses of a file, or the frames' own.
    path, beside = request.poses, request.source / POSES_FILE  # as `pnpdepth frames` writes it
    if path is None and not any(f.pose for f in frames) and beside.is_file():
        path = beside
    source = "the layout's"
    if path is not None:
        if any(frame.sparse is not None and frame.sparse.is_dir() for frame in frames):
            raise UsageError("--poses: the COLMAP model has those of its images; leave it out")
        try:
            rows, how = poses_of_frames(path, [frame.name for frame in frames], request.pose_kind)
        except InputError as error:
            if request.poses is not None or request.accumulate:
                raise
            return frames, f"note: {error}; records get no poses"
        frames = [replace(f, pose=as_pose(row)) for f, row in zip(frames, rows, strict=True)]
        source = f"{path}, {how}"
    if request.accumulate:
        frames = _with_neighbours(frames, request.accumulate, source)
    # Poses of some frames, all, or none.
    count = sum(frame.pose is not None for frame in frames)
    if not count:
        return frames, f"poses: {ESTIMATED}" if request.accumulate else None
    some = "" if count == len(frames) else f" ({count:,} of {len(frames):,} frames)"
    return frames, f"poses: {source}{some}"


def sequences_of(frames: Sequence[FrameFiles]) -> dict[str, list[int]]:
    """Returns the indices of the frames of each sequence, which one camera took, in order."""
    groups = groups_of([frame.name for frame in frames], [frame.group for frame in frames])
    sequences: dict[str, list[int]] = {}
    for index, (frame, group) in enumerate(zip(frames, groups, strict=True)):
        name = group if frame.camera is None else f"{group}_{frame.camera}"
        sequences.setdefault(name, []).append(index)
    return sequences


def _with_neighbours(frames: list[FrameFiles], reach: int, source: str) -> list[FrameFiles]:
    """The frames, each with those at most `reach` before and after it in its sequence."""
    result = [*frames]
    for sequence in sequences_of(frames).values():
        for number, index in enumerate(sequence):
            near = range(max(0, number - reach), min(number + reach + 1, len(sequence)))
            neighbours = [
                _neighbour(frames[index], frames[sequence[other]], abs(other - number), source)
                for other in near
                if other != number
            ]
            result[index] = replace(frames[index], neighbours=tuple(neighbours))
    return result


def _neighbour(frame: FrameFiles, other: FrameFiles, apart: int, source: str) -> Neighbour:
    """The other frame as a neighbour, with the motion that poses from the source give."""
    if (other.sparse or other.gt) is None or (other.sparse is not None and other.sparse.is_dir()):
        given = "images alone" if other.sparse is None else "a COLMAP model"
        raise UsageError(f"{other.name}: --accumulate takes depth maps or scans, not {given}")
    if frame.pose is None or other.pose is None:
        if other.image is None:
            raise UsageError(f"{other.name}: --accumulate of frames without images needs --poses")
        return Neighbour(files=other, motion=None, poses=ESTIMATED, apart=apart)
    pose, other_pose = np.array(frame.pose), np.array(other.pose)
    other_pose[:, 3] -= pose[:, 3]
    motion = as_pose(pose[:, :3].T @ other_pose)
    return Neighbour(files=other, motion=motion, poses=source, apart=apart)


def request_of(request: BatchRequest, frame: FrameFiles) -> RefineRequest:
    """Returns how a frame of `find_frames` is refined."""
    return replace(request.refine, files=frame, reading=request.reading)


def _as_requested(request: BatchRequest, frame: FrameFiles) -> FrameFiles:
    """The frame; options of the user go before what the data set states of all its frames."""
    least = request.refine.files.min_confidence
    if frame.sparse_mask is not None and frame.min_confidence is None:
        frame = replace(frame, min_confidence=least)
    if request.protocol is not None:
        frame = replace(frame, part=find_protocol(request.protocol).part or frame.part)
    if request.reading.sample is None:
        return frame
    # points are sampled from the ground truth, else from the projected scan
    scan = frame.sparse
    is_scan = scan is not None and scan.suffix.lower() in frame_files.SCAN_ONLY_SUFFIXES
    return replace(frame, sparse=None, gt=scan if frame.gt is None and is_scan else frame.gt)


def input_files(request: RefineRequest) -> Iterator[tuple[str, Path]]:
    """Yields the files that are read for a frame, with their part."""
    files, scan = request.files, request.reading.scan
    sources = {"image": files.image, "sparse": files.sparse, "gt": files.gt}
    for number, depth in enumerate(files.depths, 1):
        sources[f"depth {number}"], _ = file_and_part(depth)
    if files.sparse is not None:
        sources["sparse mask"] = files.sparse_mask
    # The points of its neighbours, and the images by which a motion is estimated.
    for each in files.neighbours:
        if (points := each.files.sparse or each.files.gt) is not None:
            sources[f"sparse of {points.stem}"] = points
            sources[f"image of {points.stem}"] = each.files.image if each.motion is None else None
    # Masks, and what calibrates the camera.
    if files.gt is not None:
        sources |= {f"mask {number}": path for number, path in enumerate(files.masks)}
    sources |= {"extrinsics": scan.extrinsics, "calib": scan.over(files).calib}
    # Of a folder, a COLMAP model or KITTI's calibrations, each file.
    for part, source in sources.items():
        path = None if source is None else frame_files.file_of(source)
        if path is not None and path.is_dir():
            inside = model_files(path) if part == "sparse" else sorted(path.glob("calib_*.txt"))
            yield from ((f"{part} {file.name}", file) for file in inside)
        elif path is not None:
            yield part, path


def _check_names(frames: Sequence[FrameFiles], refine: RefineRequest) -> None:
    """Raises InputError for a frame whose results have no files of their own."""
    endings = [path.name for path in refine.outputs_in(Path(), "").values()]
    owners = dict.fromkeys((CSV, JSON), "the batch")  # by the file
    for frame in frames:
        # Names that differ in Unicode normalisation only are one file on macOS.
        name, shown = unicodedata.normalize("NFC", frame.name), one_line(repr(frame.name))
        files = [name + ending for ending in endings]
        problem = frame_files.name_problem(frame.name)
        if name.startswith(".batch"):
            problem = "is one of the batch's own"
        for path in (*files, *map(str, PurePosixPath(name).parents)):
            if path in owners:
                problem = f"needs a file of {owners[path]}"
        if problem is not None:
            raise InputError(f"the name of frame {shown} {problem}; rename it")
        owners |= dict.fromkeys(files, f"frame {shown}")


def _is_inside(path: Path, folder: Path) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
