"""The frames with ground truth, each with its prediction: two files, two folders, or a data set."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.commands.shared.results import ResultFrame, result_frames
from pnpdepth_cli.commands.shared.tables import some_names
from pnpdepth_cli.dataset.frame_files import FrameFiles, find_files, groups_of, one_of_each
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES
from pnpdepth_cli.io.file_bytes import read_json
from pnpdepth_cli.protocols import WHOLE, FramePart

_MARK = re.compile(r"(?<=.)[_.]depth$", re.DOTALL)
"""The end of the stem of a depth file, as `refine` and others write it."""
_KITTI_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
"""The kind of file, which KITTI's selection names in the middle."""


def pair_frames(
    prediction: Path, ground_truth: Path, part: FramePart | None
) -> tuple[list[tuple[FrameFiles, ResultFrame | None]], list[str]]:
    """Returns the frames of the ground truth, each with its prediction or None, and notes.

    The frames are in the order of the ground truth; notes are lines for a person.

    Args:
        prediction: A depth file, or a folder of them.
        ground_truth: A depth file, a folder of them, or a data set of a known layout.
        part: Part of a data set's frames that is scored. None: the data set's own.

    Raises:
        InputError: A path is not there, or no name is common to both.
        UsageError: One is a file and the other a folder.
    """
    # One prediction goes with one file of ground truth; a folder goes with a folder or a data set.
    for path in (prediction, ground_truth):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; check the path")
    layout, frames = _data_set(prediction, ground_truth)
    has_many_truths = layout is not None or ground_truth.is_dir()
    if prediction.is_dir() != has_many_truths:
        raise UsageError(
            "give two files, two folders, or a folder and a data set, not"
            f" {prediction} and {ground_truth}"
        )
    # The predictions by name, and the frames with ground truth.
    notes = list[str]()
    predictions = _depth_files(prediction)
    if layout is not None:
        frames, note = _frames_with_truth(ground_truth, layout, frames, part)
        notes.append(note)
    elif ground_truth.is_dir():
        frames = [FrameFiles(name=name, gt=gt) for name, gt in _depth_files(ground_truth).items()]
    else:
        frames = [FrameFiles(name=name, gt=ground_truth) for name in predictions]
    # At least one name must be common to both.
    names = [frame.name for frame in frames]
    notes += _notes_on_names(predictions, names)
    # Each frame with its sequence, of which the frames are not independent.
    groups = groups_of(names, [frame.group for frame in frames])
    pairs = [
        _pair(replace(frame, group=group), predictions.get(frame.name))
        for frame, group in zip(frames, groups, strict=True)
    ]
    return pairs, notes


def _frames_with_truth(
    folder: Path, layout: str, frames: Sequence[FrameFiles], part: FramePart | None
) -> tuple[list[FrameFiles], str]:
    """The frames of a data set that have ground truth, and a line on them for a person.

    Each is cut to the part that is scored.

    Args:
        folder: The data set.
        layout: Name of its layout.
        frames: Its frames.
        part: Part of each frame that is scored. None: its own.

    Raises:
        InputError: No frame has ground truth.
    """
    with_truth = [
        replace(frame, part=part or frame.part) for frame in frames if frame.gt is not None
    ]
    if not with_truth:
        raise InputError(f"{folder} looks like {layout!r}, without ground truth; give its folder")
    parts = ", ".join(sorted({str(frame.part) for frame in with_truth if frame.part != WHOLE}))
    note = f"gt: layout {layout}; frames with ground truth: {len(with_truth):,}"
    if parts:
        note += f", of which {parts} is used"
    return with_truth, note


def _notes_on_names(predictions: Mapping[str, Path], names: Sequence[str]) -> list[str]:
    """A warning if predictions have no ground truth of their name.

    Args:
        predictions: Depth files by the name of their frame.
        names: Names of the frames with ground truth.

    Raises:
        InputError: None has.
    """
    extra = sorted(predictions.keys() - {*names})
    if len(extra) == len(predictions):
        raise InputError(
            "no prediction has the name of a ground truth file: predictions are"
            f" {some_names(predictions)}; ground truth is {some_names(sorted(names))}; name both"
            " alike"
        )
    if not extra:
        return []
    return [
        f"warning: {len(extra):,} of {len(predictions):,} predictions have no ground truth and"
        f" are not scored: {some_names(extra)}"
    ]


def _data_set(prediction: Path, folder: Path) -> tuple[str | None, list[FrameFiles]]:
    """The layout and the frames of a data set; None and no frames if the folder is none.

    Args:
        prediction: The predictions, which a batch may have refined from the data set.
        folder: What may be a data set.
    """
    # The layout that a batch used, by its summary beside the predictions; if there is none, or the
    # folder does not have it, the layout is recognised (None).
    summary = prediction / "summary.json"
    layout_of_batch = read_json(summary).get("layout") if summary.is_file() else None
    layouts = [layout_of_batch, None] if layout_of_batch in LAYOUTS else [None]
    for layout in layouts:
        try:
            listed = list_frames(folder, layout)
        # The folder is no data set of this layout. It may still be a folder of depth files.
        except (InputError, OSError):
            continue
        return listed.layout, listed.frames
    return None, []


def _pair(files: FrameFiles, prediction: Path | None) -> tuple[FrameFiles, ResultFrame | None]:
    """The frame and its prediction, with what the prediction's record says of the frame's files.

    That is the sparse depth and the image that were used. A prediction whose record is damaged is
    scored as one without a record.

    Args:
        files: The files of the frame.
        prediction: The depth file. None: there is none, and None is returned for it.
    """
    if files.sparse is not None and files.sparse.suffix.lower() not in DEPTH_SUFFIXES:
        files = replace(files, sparse=None)  # a scan, whose pixels are not known without a camera
    if prediction is None:
        return files, None
    try:
        (result,) = result_frames(prediction)
    except PnpDepthError:
        return files, ResultFrame(name=files.name, depth=prediction)
    sparse = result.record.inputs.get("sparse")
    if sparse is not None and sparse.kind == "depth":
        path = Path(sparse.path)
        files = replace(files, sparse=path if path.is_file() else files.sparse)
    return replace(files, image=result.image or files.image), result


def _frame_name(stem: str) -> str:
    """The frame of a file with this stem: without `_depth` and KITTI's file kind."""
    return _MARK.sub("", _KITTI_KIND.sub("_sync_", stem))


def _depth_files(path: Path) -> dict[str, Path]:
    """The depth files of a folder by their frame, sorted, or the one that the path is.

    In a folder with files `x_depth`, all others are no depth.

    Raises:
        InputError: There is none, two are of one frame, or a folder inside cannot be read.
    """
    if not path.is_dir():
        return {_frame_name(path.stem): path}
    by_stem, problems = find_files(path, DEPTH_SUFFIXES)
    marked = {stem: file for stem, file in by_stem.items() if _MARK.search(stem)}
    files, ambiguous = one_of_each(
        (_frame_name(stem), file) for stem, file in (marked or by_stem).items()
    )
    lost = [*problems, *ambiguous]
    if lost:
        file, why = lost[0]
        raise InputError(f"{file} {why}")
    if not files:
        raise InputError(f"{path} holds no depth file ({' '.join(DEPTH_SUFFIXES)}); check the path")
    return dict(sorted(files.items()))
