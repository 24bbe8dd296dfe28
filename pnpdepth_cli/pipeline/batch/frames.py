"""Finds the frames of a batch, and the request, inputs and outputs of each. Imports no torch."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.io.colmap.model import model_files
from pnpdepth_cli.io.dataset.frame import SCAN_ONLY_SUFFIXES, Frame, Source, Unmatched
from pnpdepth_cli.io.dataset.frame_names import name_problem
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.layouts import LAYOUTS, find_protocol, list_frames
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.batch.sequence import (
    check_warm_start,
    in_windows,
    with_neighbours,
    with_windows,
)
from pnpdepth_cli.pipeline.refinement.output_files import Outputs
from pnpdepth_cli.pipeline.refinement.request import FrameFiles, RefineRequest


@dataclass(frozen=True, kw_only=True)
class BatchFrames:
    """The frames of a batch."""

    layout: str
    """Name of the layout."""
    frames: list[Frame]
    """All frames of the source."""
    chosen: list[Frame]
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


def find_frames(request: BatchRequest) -> BatchFrames:
    """Returns the frames of the source.

    Raises:
        InputError: If there is none.
        UsageError: If none has sparse depth.
        OutputError: If the output is a file, or holds the frames.
    """
    if request.output.exists() and not request.output.is_dir():
        raise OutputError(f"{request.output} is a file; name a folder")
    if request.source.is_dir() and _is_inside(request.source, request.output):
        raise _holds_the_frames(request.output)
    layout, listing = list_frames(request.source, request.layout)
    frames, unmatched = _own_names(_outside(request.output, listing.frames))
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


def _chosen(request: BatchRequest, frames: list[Frame]) -> list[Frame]:
    """The frames of the shard: every N-th, or every N-th window."""
    number, of = request.shard or (1, 1)
    if not request.sequence.warm_start:
        return frames[number - 1 :: of]
    return [frame for window in in_windows(frames)[number - 1 :: of] for frame in window]


def task_of(request: BatchRequest, frame: Frame) -> Task:
    """Returns the frame's task; options of the user go before what the data set states."""
    refine = request.refine
    if request.html_3d:
        refine = refine.with_fields(view_3d=True)
    base = refine.files
    sparse = frame.sparse if base.sample is None else None
    protocol = frame.protocol if request.protocol is None else find_protocol(request.protocol)
    gt = frame.gt
    if base.sample is not None and gt is None and _is_scan_file(frame.sparse):
        gt = frame.sparse  # points are sampled from the projected scan
    is_scan = _is_scan_file(gt) or (sparse is not None and _is_scan(base, sparse))
    scan, needs_camera = base.scan, refine.outputs.needs_camera or frame.neighbours
    if is_scan:
        camera = frame.camera if scan.camera is None else scan.camera
        scan = replace(scan, calib=scan.calib or frame.calib, camera=camera)
    files = replace(
        base,
        image=frame.image,
        sparse=sparse,
        gt=gt,
        calibration=frame.calibration,
        camera_file=frame.calib if needs_camera and not is_scan else None,
        camera_number=frame.camera if scan.camera is None else scan.camera,
        neighbours=frame.neighbours,
        window=tuple(each.name for each in frame.window),
        gt_masks=frame.masks,
        gt_size_ok=frame.gt_other_size,
        sparse_size_ok=base.sparse_size_ok or frame.sparse_other_size,
        sparse_scale=frame.sparse_scale if base.depth_scale is None else None,
        gt_scale=base.gt_scale or base.depth_scale or frame.gt_scale,
        scan=scan,
        protocol=protocol,
    )
    return Task(
        name=frame.name,
        request=replace(refine, files=files),
        inputs=dict(_earlier_files(frame)) | dict(_input_files(files, is_scan=is_scan)),
        outputs=Outputs.in_folder(request.output, frame.name, refine),
    )


def compared(count: int) -> list[int]:
    """Returns which of the frames behind the first candidates are compared on."""
    return sorted({count // 2, count - 1}) if count else []


def _is_scan(base: FrameFiles, sparse: Path) -> bool:
    suffix = sparse.suffix.lower()
    return suffix in SCAN_ONLY_SUFFIXES or (suffix == ".npy" and base.scan.calib is not None)


def _is_scan_file(source: Source | None) -> bool:
    return isinstance(source, Path) and source.suffix.lower() in SCAN_ONLY_SUFFIXES


def source_files(frame: Frame) -> list[Path]:
    """Returns the files of the frame's image, sparse depth and ground truth."""
    parts = [frame.image, frame.sparse, frame.gt]
    return [part if isinstance(part, Path) else part.path for part in parts if part is not None]


def _input_files(files: FrameFiles, *, is_scan: bool) -> Iterator[tuple[str, Path]]:
    parts: dict[str, Source | None] = {
        "image": files.image,
        "sparse": files.sparse,
        "gt": files.gt,
    }
    for part, source in parts.items():
        if source is None:
            continue
        path = source if isinstance(source, Path) else source.path
        if part == "sparse" and path.is_dir():  # a COLMAP model
            yield from ((f"sparse {file.name}", file) for file in model_files(path))
        else:
            yield part, path
    yield from ((f"sparse of {each.sparse.stem}", each.sparse) for each in files.neighbours)
    if files.gt is not None:
        yield from ((f"mask {number}", path) for number, path in enumerate(files.gt_masks))
    calib, extrinsics = files.scan.calib or files.camera_file, files.scan.extrinsics
    if is_scan and extrinsics is not None:
        yield "extrinsics", extrinsics
    if calib is not None:
        if calib.is_dir():
            yield from ((f"calib {p.name}", p) for p in sorted(calib.glob("calib_*.txt")))
        else:
            yield "calib", calib


def _earlier_files(frame: Frame) -> Iterator[tuple[str, Path]]:
    """The files of the frames before in the window, on which this one's result depends."""
    for each in frame.window[:-1]:
        for number, path in enumerate(source_files(each)):
            if path.is_file():
                yield f"file {number} of {each.name}", path
        yield from ((f"sparse of {other.sparse.stem}", other.sparse) for other in each.neighbours)


def _holds_the_frames(output: Path) -> OutputError:
    return OutputError(
        f"{output} holds the frames themselves; name a folder of its own, such as {output / 'out'}"
    )


def _outside(output: Path, frames: list[Frame]) -> tuple[list[Frame], list[Unmatched]]:
    """The frames without a file in the output folder, and the others as unmatched files."""
    if not output.exists():
        return frames, []
    folder = output.resolve()
    kept, ignored = [], []
    is_inside = functools.cache(lambda parent: parent.resolve().is_relative_to(folder))
    for frame in frames:
        inside = [
            path
            for path in source_files(frame)
            if is_inside(path.parent) or (path.is_symlink() and is_inside(path))
        ]
        if inside:
            why = "lies in the output folder, which is not searched for frames; move it"
            ignored.append(Unmatched(path=inside[0], why=why))
        else:
            kept.append(frame)
    if frames and not kept:
        raise _holds_the_frames(output)
    return kept, ignored


def _own_names(listed: tuple[list[Frame], list[Unmatched]]) -> tuple[list[Frame], list[Unmatched]]:
    """The frames with a unique name that is fit for their results, and the others as unmatched."""
    frames, ignored = listed
    kept: dict[str, Frame] = {}
    for frame in frames:
        why = f"is a second frame {frame.name!r}; rename it" if frame.name in kept else None
        if frame.name == "summary":
            why = "would be recorded in summary.json, which is the batch's own; rename it"
        problem = name_problem(frame.name)
        if problem is not None:
            why = f"is named {one_line(frame.name)!r}, which {problem}; rename it"
        if why is None:
            kept[frame.name] = frame
        else:
            source = frame.image or frame.sparse
            path = source if isinstance(source, Path) else Path(str(source))
            ignored.append(Unmatched(path=path, why=why))
    return list(kept.values()), ignored


def _is_inside(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())
