"""Finds the frames of a batch, and the request, inputs and outputs of each. Imports no torch."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.io.colmap.model import model_files
from pnpdepth_cli.io.dataset.frame import (
    SCAN_ONLY_SUFFIXES,
    Frame,
    Source,
    Unmatched,
    file_of,
)
from pnpdepth_cli.io.dataset.frame_names import name_problem
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.layouts import LAYOUTS, find_protocol, list_frames
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.batch.sequence import (
    check_warm_start,
    in_windows,
    with_neighbours,
    with_windows,
)
from pnpdepth_cli.pipeline.refinement.output_files import Outputs
from pnpdepth_cli.pipeline.refinement.request import (
    FrameFiles,
    NeighbourFiles,
    RefineRequest,
)

Item = TypeVar("Item")
REGISTERING = 16
"""Frames that decide together how images are moved into the frame of the points."""

_LISTS = (".csv", ".jsonl")
_IN_OUTPUT = "lies in the output folder, which is not searched for frames; move it"


@dataclass(frozen=True, kw_only=True)
class BatchFrames:
    """The frames of a batch."""

    layout: str
    """Name of the layout."""
    frames: Sequence[Frame]
    """All frames of the source."""
    chosen: Sequence[Frame]
    """Those within the limit and the shard."""
    unmatched: tuple[Unmatched, ...]
    """Files that are in no frame, and why."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One frame to refine."""

    name: str
    """The frame's name."""
    request: RefineRequest
    """With the frame's files."""
    inputs: dict[str, Path]
    """The files that are read for it, by their part."""
    outputs: Outputs
    """The files that are written for it."""
    written: bool = True
    """False for a frame that is refined only because another begins where it ends."""

    @property
    def record(self) -> Path:
        """The record of the results, which is the last file that is written."""
        assert self.outputs.record is not None
        return self.outputs.record


def find_frames(request: BatchRequest) -> BatchFrames:
    """Returns the frames of the source.

    Raises:
        InputError: If there is none.
        UsageError: If none has sparse depth.
        OutputError: If the output is a file, or holds the frames.
    """
    _check_stored(request.source)
    if request.output.exists() and not request.output.is_dir():
        raise OutputError(f"{request.output} is a file; name a folder")
    if request.source.is_dir() and _is_inside(request.source, request.output):
        raise _holds_the_frames(request.output)
    layout, listing = list_frames(request.source, request.layout)
    frames, unmatched = _usable(request.output, listing.frames)
    lost = [*listing.broken, *listing.spare]
    unmatched += [each for each in lost if not _is_inside(each.path, request.output)]
    if not frames:
        first = f" ({lost[0]})" if lost else ""
        raise InputError(
            f"{request.source} looks like {layout!r} but has no frame in it{first};"
            f" layouts are {', '.join(LAYOUTS)}"
        )
    if request.refine.files.sample is None and all(frame.sparse is None for frame in frames):
        raise UsageError(
            f"{request.source} looks like {layout!r}, which has no sparse depth; --sample 500"
            " draws so many points from the ground truth"
        )
    sequence = request.sequence
    if sequence.accumulate:
        frames = with_neighbours(frames, sequence.accumulate, sequence.poses)
    if sequence.warm_start:
        check_warm_start(request.refine)
        frames = with_windows(frames, sequence.warm_start)
    return BatchFrames(
        layout=layout,
        frames=frames,
        chosen=_chosen(request, frames[: request.limit]),
        unmatched=tuple(unmatched),
    )


def _check_stored(source: Path) -> None:
    """Raises an error for a source in a store that is no list of frames."""
    if not isinstance(source, RemotePath):
        return
    if source.suffix not in _LISTS:
        raise UsageError(
            f"{source}: folders in a store are not searched for frames; give a list of them"
            f" ({' or '.join(_LISTS)})"
        )
    if not source.exists():
        raise InputError(f"{source}: no such object; check the address")


def _chosen(request: BatchRequest, frames: list[Frame]) -> list[Frame]:
    """The frames of the shard: every N-th, or every N-th window."""
    number, of = request.shard or (1, 1)
    if not request.sequence.warm_start:
        return frames[number - 1 :: of]
    windows = in_windows(frames)[number - 1 :: of]
    return [frame for window in windows for frame in window]


def task_of(request: BatchRequest, frame: Frame) -> Task:
    """Returns the frame's task; options of the user go before what the data set states."""
    refine = request.refine
    if request.html_3d:
        refine = refine.with_fields(view_3d=True)
    needs_camera = refine.outputs.needs_camera or bool(frame.neighbours)
    files = _files_of(request, frame, needs_camera=needs_camera)
    neighbours = tuple(
        NeighbourFiles(
            files=_files_of(request, each.frame, needs_camera=True),
            motion=each.motion,
            poses=each.poses,
            apart=each.apart,
        )
        for each in frame.neighbours
    )
    if neighbours or frame.window:
        window = tuple(each.name for each in frame.window)
        files = replace(files, neighbours=neighbours, window=window)
    return Task(
        name=frame.name,
        request=replace(refine, files=files),
        inputs=dict(_earlier_files(frame)) | dict(_input_files(files)),
        outputs=Outputs.in_folder(request.output, frame.name, refine),
    )


def _files_of(request: BatchRequest, frame: Frame, *, needs_camera: bool) -> FrameFiles:
    """The files of a frame, without its neighbours and window."""
    base = request.refine.files
    sparse = frame.sparse if base.sample is None else None
    protocol = frame.protocol if request.protocol is None else find_protocol(request.protocol)
    gt = frame.gt
    if base.sample is not None and gt is None and _is_scan_file(frame.sparse):
        gt = frame.sparse  # points are sampled from the projected scan
    if frame.calibration is not None:
        base = replace(base, calibration=frame.calibration)
    is_scan = _reads_scan(base, sparse, gt)
    scan = base.scan
    if is_scan:
        camera = frame.camera if scan.camera is None else scan.camera
        scan = replace(scan, calib=scan.calib or frame.calib, camera=camera)
    return replace(
        base,
        image=frame.image,
        sparse=sparse,
        gt=gt,
        camera_file=frame.calib if needs_camera and not is_scan else None,
        camera_number=frame.camera if scan.camera is None else scan.camera,
        gt_masks=frame.masks,
        gt_size_ok=frame.gt_other_size,
        sparse_size_ok=base.sparse_size_ok or frame.sparse_other_size,
        sparse_scale=frame.sparse_scale if base.depth_scale is None else None,
        gt_scale=base.gt_scale or base.depth_scale or frame.gt_scale,
        scan=scan,
        protocol=protocol,
    )


def reference_frames(frames: Sequence[Item], first: int) -> list[Item]:
    """Returns the frames behind the first readable one that decide input ranges with it."""
    count = len(frames) - first - 1
    return [frames[first + 1 + i] for i in sorted({count // 2, count - 1})] if count else []


def registering(frames: Sequence[Item], first: int) -> list[Item]:
    """Returns the frames, the first readable one among them, that decide the registration."""
    count = len(frames) - first
    chosen = {first + i * (count - 1) // (REGISTERING - 1) for i in range(REGISTERING)}
    return [frames[i] for i in sorted(chosen)]


def _reads_scan(files: FrameFiles, sparse: Path | None, gt: Source | None) -> bool:
    """Whether one of them is a scan that is projected, which needs the scanner's pose."""
    return _is_scan_file(gt) or (sparse is not None and _is_scan(files, sparse))


def _is_scan(files: FrameFiles, sparse: Path) -> bool:
    suffix, known = sparse.suffix.lower(), files.calibration
    return (
        suffix in SCAN_ONLY_SUFFIXES
        or (suffix == ".npy" and files.scan.calib is not None)
        or (suffix == ".npz" and known is not None and known.has_pose)
    )


def _is_scan_file(source: Source | None) -> bool:
    return isinstance(source, Path) and source.suffix.lower() in SCAN_ONLY_SUFFIXES


def source_files(frame: Frame) -> list[Path]:
    """Returns the files of the frame's image, sparse depth and ground truth."""
    parts = [frame.image, frame.sparse, frame.gt]
    return [file_of(part) for part in parts if part is not None]


def _input_files(files: FrameFiles) -> Iterator[tuple[str, Path]]:
    parts: dict[str, Source | None] = {
        "image": files.image,
        "sparse": files.sparse,
        "gt": files.gt,
    }
    for part, source in parts.items():
        if source is None:
            continue
        path = file_of(source)
        if part == "sparse" and path.is_dir():  # a COLMAP model
            yield from ((f"sparse {file.name}", file) for file in model_files(path))
        else:
            yield part, path
    for each in files.neighbours:
        yield from _neighbour_files(each.files, estimated=each.motion is None)
    if files.gt is not None:
        yield from ((f"mask {number}", path) for number, path in enumerate(files.gt_masks))
    calib, extrinsics = files.scan.calib or files.camera_file, files.scan.extrinsics
    if _reads_scan(files, files.sparse, files.gt) and extrinsics is not None:
        yield "extrinsics", extrinsics
    if calib is not None:
        if calib.is_dir():
            yield from ((f"calib {p.name}", p) for p in sorted(calib.glob("calib_*.txt")))
        else:
            yield "calib", calib


def _neighbour_files(files: FrameFiles, *, estimated: bool) -> Iterator[tuple[str, Path]]:
    """The files of a neighbour that are read: its points and, to estimate motion, its image."""
    points = files.sparse or files.gt
    if points is not None:
        path = file_of(points)
        yield f"sparse of {path.stem}", path
        if estimated and files.image is not None:
            yield f"image of {path.stem}", file_of(files.image)


def _earlier_files(frame: Frame) -> Iterator[tuple[str, Path]]:
    """The files of the frames before in the window, on which this one's result depends."""
    for each in frame.window[:-1]:
        for other in (each, *(neighbour.frame for neighbour in each.neighbours)):
            for number, path in enumerate(source_files(other)):
                if path.is_file():
                    yield f"file {number} of {other.name}", path


def _holds_the_frames(output: Path) -> OutputError:
    return OutputError(
        f"{output} holds the frames themselves; name a folder of its own, such as {output / 'out'}"
    )


def _usable(output: Path, frames: Sequence[Frame]) -> tuple[list[Frame], list[Unmatched]]:
    """The frames outside of the output folder whose name is fit for results, and the others."""
    kept, ignored = list[Frame](), list[Unmatched]()
    inside, names, within = _finder(output), set[str](), 0
    for frame in frames:
        path = None if inside is None else inside(frame)
        within += path is not None
        why = _problem_of_name(frame.name, names) if path is None else _IN_OUTPUT
        if why is None:
            names.add(frame.name)
            kept.append(frame)
        else:
            file = file_of(frame.image or frame.sparse or Path(frame.name))
            ignored.append(Unmatched(path=path or file, why=why))
    if frames and within == len(frames):
        raise _holds_the_frames(output)
    return kept, ignored


def _finder(output: Path) -> Callable[[Frame], Path | None] | None:
    """A function of a frame that returns a file of it in the output folder; None without one."""
    if not output.exists():
        return None
    folder = output.resolve()
    is_inside = functools.cache(lambda parent: parent.resolve().is_relative_to(folder))

    def file_inside(frame: Frame) -> Path | None:
        for path in source_files(frame):
            if is_inside(path.parent) or (path.is_symlink() and is_inside(path)):
                return path
        return None

    return file_inside


def _problem_of_name(name: str, taken: Collection[str]) -> str | None:
    """Why a frame of this name cannot have results; None if it can."""
    problem = name_problem(name)
    if problem is not None:
        return f"is named {one_line(name)!r}, which {problem}; rename it"
    if name == "summary":
        return "would be recorded in summary.json, which is the batch's own; rename it"
    return f"is a second frame {name!r}; rename it" if name in taken else None


def _is_inside(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())
