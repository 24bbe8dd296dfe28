"""Finds the frames of a batch, and how each is refined, from which files. Imports no torch."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.sequence import (
    ESTIMATED,
    with_neighbours,
    with_poses,
)
from pnpdepth_cli.commands.refinement.output_files import outputs_in
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.commands.requests import FramesRequest
from pnpdepth_cli.dataset.frame_files import (
    SCAN_ONLY_SUFFIXES,
    FrameFiles,
    Unmatched,
    file_of,
    name_problem,
)
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.io.bags import is_bag
from pnpdepth_cli.io.colmap_model import model_files
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.poses import POSES_FILE
from pnpdepth_cli.protocols import find_protocol

CSV, JSON = "summary.csv", "summary.json"


@dataclass(frozen=True, kw_only=True)
class BatchFrames:
    """The frames of a batch."""

    layout: str
    frames: Sequence[FrameFiles]
    """All frames of the source."""
    chosen: Sequence[FrameFiles]
    """Frames of these that the names, the limit and the shard choose."""
    unmatched: tuple[Unmatched, ...]
    poses: str | None
    """Where the poses of the frames are from, as a line; None without poses."""


def unpack(request: BatchRequest, say: Callable[[str], None]) -> BatchRequest:
    """Returns the request with the frames of its bag as source; any other request as it is.

    The frames are written to OUTPUT_frames, and stay there for the next run.
    """
    if not is_bag(request.source):
        return request
    from pnpdepth_cli.commands.sparse.bag_frames import has_frames, write_frames

    folder = request.output.with_name(f"{request.output.name}_frames")
    whole = request.limit is None or request.names is not None
    between = None if whole else (0, request.every * (request.limit or 1) - 1)
    frames = FramesRequest(bag=request.source, output=folder, between=between, overwrite=True)
    if not has_frames(frames):
        say(f"bag: wrote {write_frames(frames, say):,} frames to {folder}")
    return replace(request, source=folder)


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
    folders = {source, *(path.parent for frame in frames for path in source_files(frame))}
    if any(folder.is_dir() and _is_inside(folder, output) for folder in folders):
        raise OutputError(
            f"{output} holds the frames themselves; name a folder of its own, such as"
            f" {output / 'out'}"
        )
    # There must be some, with sparse depth and names that are fit for results.
    if not frames:
        first = f" ({lost[0]})" if lost else ""
        raise InputError(
            f"{source} looks like {layout!r} but has no frame in it{first};"
            f" layouts are {', '.join(LAYOUTS)}"
        )
    if request.reading.sample is None and all(frame.sparse is None for frame in frames):
        raise UsageError(
            f"{source} looks like {layout!r}, which has no sparse depth; --sample 500"
            " draws so many points from the ground truth"
        )
    _check_names(frames, request.refine)
    # Poses and neighbours, of all frames.
    frames, poses = _with_poses(request, frames)
    # The part of the frames that this run refines.
    number, of = request.shard or (1, 1)
    chosen = [frame for frame in frames if fnmatchcase(frame.name, request.names or "*")]
    if not chosen:
        raise UsageError(
            f"no frame of {source} has a name like {request.names!r}; the first is {frames[0].name}"
        )
    return BatchFrames(
        layout=layout,
        frames=frames,
        chosen=chosen[:: request.every][: request.limit][number - 1 :: of],
        unmatched=tuple(each for each in lost if not _is_inside(each.path, output)),
        poses=poses,
    )


def _with_poses(
    request: BatchRequest, frames: list[FrameFiles]
) -> tuple[list[FrameFiles], str | None]:
    """The frames with their poses and neighbours, and where the poses are from, as a line."""
    path, beside = request.poses, request.source / POSES_FILE  # as `pnpdepth frames` writes it
    if path is None and not any(f.pose for f in frames) and beside.is_file():
        path = beside
    try:
        frames, source = with_poses(frames, path, request.pose_kind)
    except InputError as error:
        if request.poses is not None or request.accumulate:
            raise
        return frames, f"note: {error}; records get no poses"
    if request.accumulate:
        frames = with_neighbours(frames, request.accumulate, source)
    # Poses of some frames, all, or none.
    count = sum(frame.pose is not None for frame in frames)
    if not count:
        return frames, f"poses: {ESTIMATED}" if request.accumulate else None
    some = "" if count == len(frames) else f" ({count:,} of {len(frames):,} frames)"
    return frames, f"poses: {source}{some}"


def request_of(request: BatchRequest, frame: FrameFiles) -> RefineRequest:
    """Returns how a frame is refined; options of the user go before what the data set states."""
    files = _files_to_read(request, frame)
    neighbours = (
        replace(each, files=_files_to_read(request, each.files)) for each in frame.neighbours
    )
    files = replace(files, neighbours=tuple(neighbours))
    return replace(request.refine, files=files, reading=request.reading)


def _files_to_read(request: BatchRequest, frame: FrameFiles) -> FrameFiles:
    """The files of a frame that are read for it, without its neighbours."""
    files = replace(frame, neighbours=())
    if request.protocol is not None:
        files = replace(files, part=find_protocol(request.protocol).part or files.part)
    if request.reading.sample is None:
        return files
    # points are sampled from the ground truth, else from the projected scan
    scan = frame.sparse
    is_scan = scan is not None and scan.suffix.lower() in SCAN_ONLY_SUFFIXES
    return replace(files, sparse=None, gt=scan if frame.gt is None and is_scan else frame.gt)


def source_files(frame: FrameFiles) -> list[Path]:
    """Returns the files of the frame's image, sparse depth and ground truth."""
    parts = [frame.image, frame.sparse, frame.gt]
    return [file_of(part) for part in parts if part is not None]


def input_files(request: RefineRequest) -> Iterator[tuple[str, Path]]:
    """Yields the files that are read for a frame, with their part."""
    files, scan = request.files, request.reading.scan
    # The frame's own.
    parts = [("image", files.image), ("sparse", files.sparse), ("gt", files.gt)]
    parts += [("sparse mask", files.sparse_mask)] if files.sparse is not None else []
    for part, source in parts:
        path = None if source is None else file_of(source)
        if path is not None and part == "sparse" and path.is_dir():  # a COLMAP model
            yield from ((f"sparse {file.name}", file) for file in model_files(path))
        elif path is not None:
            yield part, path
    # The points of its neighbours, and the images by which a motion is estimated.
    for each in files.neighbours:
        points, image = each.files.sparse or each.files.gt, each.files.image
        if points is not None:
            path = file_of(points)
            yield f"sparse of {path.stem}", path
            if each.motion is None and image is not None:
                yield f"image of {path.stem}", file_of(image)
    # Masks, and what calibrates the camera.
    if files.gt is not None:
        yield from ((f"mask {number}", path) for number, path in enumerate(files.masks))
    if scan.extrinsics is not None:
        yield "extrinsics", scan.extrinsics
    calib = scan.over(files).calib
    if calib is not None and calib.is_dir():
        yield from ((f"calib {path.name}", path) for path in sorted(calib.glob("calib_*.txt")))
    elif calib is not None:
        yield "calib", calib


def _check_names(frames: Sequence[FrameFiles], refine: RefineRequest) -> None:
    """Raises InputError for a frame whose results have no files of their own.

    Names that differ in Unicode normalisation only are one file on macOS.
    """
    endings = [path.name for path in outputs_in(Path(), "", refine).values()]
    owners = dict.fromkeys((CSV, JSON), "the batch")  # by the file
    names = {frame.name: unicodedata.normalize("NFC", frame.name) for frame in frames}
    for own, name in names.items():
        files = [name + ending for ending in endings]
        problem = name_problem(name)
        if name.startswith(".batch"):
            problem = "is one of the batch's own"
        elif owner := next((owners[file] for file in files if file in owners), None):
            problem = f"needs a file of {owner}"
        if problem is not None:
            raise InputError(f"the name of frame {one_line(repr(own))} {problem}; rename it")
        owners |= dict.fromkeys(files, f"frame {one_line(repr(own))}")
    for own, name in names.items():
        for folder in PurePosixPath(name).parents:
            if owner := owners.get(str(folder)):
                raise InputError(f"frame {one_line(repr(own))} needs a file of {owner}; rename it")


def _is_inside(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())
