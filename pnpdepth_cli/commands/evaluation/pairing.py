"""Finds the prediction of each frame of the ground truth by its name."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.commands.results import ResultFrame, result_frames
from pnpdepth_cli.dataset.frame_files import FrameFiles, find_files, groups_by_name
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES
from pnpdepth_cli.io.file_bytes import one_line, read_json
from pnpdepth_cli.protocols import WHOLE, FramePart

_MARK = re.compile(r"(?<=.)[_.]depth$", re.DOTALL)
# KITTI's selection names the kind of file in the middle.
_KITTI_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
_LISTED = 5


FramePair = tuple[FrameFiles, ResultFrame | None]
"""The files of one frame to score: the ground truth's frame, and the prediction, if there is one.

Sparse depth and image are those of the record of the prediction. Sparse depth is None where its
file does not say which points the network saw."""


def pair_frames(
    prediction: Path, ground_truth: Path, part: FramePart | None = None
) -> tuple[list[FramePair], list[str]]:
    """Returns the frames of the ground truth in its order, and notes.

    Args:
        prediction: A depth file, or a folder of them.
        ground_truth: The same, or a data set of a known layout, or a manifest.
        part: Part of each frame of a data set that is used; None for the layout's own.

    Raises:
        UsageError: For a file and a folder.
        InputError: For a missing path, or folders without a common name.
    """
    # Two files, two folders, or a folder and a data set.
    for path in (prediction, ground_truth):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; check the path")
    layout, frames = _data_set(prediction, ground_truth)
    if prediction.is_dir() != (layout is not None or ground_truth.is_dir()):
        raise UsageError(
            f"give two files, two folders, or a folder and a data set: {prediction}, {ground_truth}"
        )
    # The predictions by name, and the frames with ground truth.
    notes: list[str] = []
    predictions = depth_files(prediction)
    if layout is not None:
        frames = [replace(f, part=part or f.part) for f in frames if f.gt is not None]
        if not frames:
            raise InputError(
                f"{ground_truth} looks like {layout!r}, and no frame in it has ground truth"
            )
        cuts = ", ".join(sorted({str(frame.part) for frame in frames if frame.part != WHOLE}))
        note = f"gt: layout {layout}; frames with ground truth: {len(frames):,}"
        notes.append(note + (f", of which {cuts} is used" if cuts else ""))
    else:
        truths = dict.fromkeys(predictions, ground_truth)
        if ground_truth.is_dir():
            truths = depth_files(ground_truth)
        frames = [FrameFiles(name=name, gt=path) for name, path in truths.items()]
    # At least one name must be common to both.
    names = {frame.name: None for frame in frames}
    extra = [name for name in sorted(predictions) if name not in names]
    if len(extra) == len(predictions):
        raise InputError(
            "no prediction has the name of a ground truth file: predictions are"
            f" {some_names(predictions)}; ground truth is {some_names(sorted(names))}"
        )
    if extra:
        notes.append(
            f"warning: {len(extra):,} of {len(predictions):,} predictions have no ground truth"
            f" and are not scored: {some_names(extra)}"
        )
    grouped = zip(frames, groups_by_name([*names]), strict=True)
    return [
        _pair(replace(frame, group=frame.group or group), predictions.get(frame.name))
        for frame, group in grouped
    ], notes


def _data_set(prediction: Path, folder: Path) -> tuple[str | None, list[FrameFiles]]:
    """The layout and the frames of a data set: as the batch read it, else recognised anew."""
    summary = prediction / "summary.json"
    stated = read_json(summary).get("layout") if summary.is_file() else None
    for layout in (stated if stated in LAYOUTS else None, None):
        with contextlib.suppress(InputError, OSError):
            return list_frames(folder, layout)[:2]
    return None, []


def _pair(files: FrameFiles, prediction: Path | None) -> FramePair:
    """The frame with what the record of a refinement, beside its depth, says of its inputs."""
    if files.sparse is not None and files.sparse.suffix.lower() not in DEPTH_SUFFIXES:
        files = replace(files, sparse=None)  # a scan
    if prediction is None:
        return files, None
    try:
        (result,) = result_frames(prediction)
    except PnpDepthError:  # the record is damaged
        return files, ResultFrame(name=files.name, depth=prediction)
    sparse = result.record.inputs.get("sparse")
    if sparse is not None and not (sparse.sampled or sparse.calibration):
        path = Path(sparse.path)
        files = replace(files, sparse=path if path.is_file() else files.sparse)
    return replace(files, image=result.image or files.image), result


def frame_name(stem: str) -> str:
    """Returns the frame of a file with this stem: without `_depth` and KITTI's file kind."""
    return _MARK.sub("", _KITTI_KIND.sub("_sync_", stem))


def depth_files(folder: Path) -> dict[str, Path]:
    """Returns the depth files below a folder, or a single one, by frame name, sorted.

    A frame in a subfolder has it in its name. Where files `x_depth` are, all others are no depth.

    Raises:
        InputError: If there is none, or two are one frame, or a folder cannot be read.
    """
    if not folder.is_dir():
        return {frame_name(folder.stem): folder}
    found, problems = find_files(folder, DEPTH_SUFFIXES)
    if problems:
        raise InputError(str(problems[0]))
    marked = {stem: path for stem, path in found.items() if _MARK.search(stem)}
    by_frame: dict[str, Path] = {}
    for stem, path in (marked or found).items():
        first = by_frame.setdefault(frame_name(stem), path)
        if first != path:
            raise InputError(f"{path} and {first.name} are one frame; keep one")
    if not by_frame:
        suffixes = " ".join(DEPTH_SUFFIXES)
        raise InputError(f"{folder} holds no depth file ({suffixes}); check the path")
    return dict(sorted(by_frame.items()))


def some_names(names: Iterable[str]) -> str:
    """Returns a few of the names on one line, and how many more there are."""
    listed = list(names)
    text = ", ".join(one_line(name) for name in listed[:_LISTED])
    more = len(listed) - _LISTED
    return f"{text} and {more:,} more" if more > 0 else text
