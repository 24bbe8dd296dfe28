"""Finds the prediction of each frame of the ground truth by its name."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from pnpdepth_cli.commands.results import ResultFrame, result_frames
from pnpdepth_cli.dataset.frame_files import (
    FrameFiles,
    ImageSource,
    RawDepth,
    find_files,
    groups_by_name,
)
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.dataset.layouts import LAYOUTS, list_frames
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES
from pnpdepth_cli.io.json_file import read_json
from pnpdepth_cli.points import METRES
from pnpdepth_cli.protocols import WHOLE, FramePart
from pnpdepth_cli.sensors import SamplePattern

_DEPTH_MARKS = ("_depth", ".depth")
_COMPANIONS = ("_sigma_preview", "_preview", "_improvement", "_sigma", "_valid")
# KITTI's selection names the kind of file in the middle.
_KITTI_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
_LISTED = 5


class DrawnPoints(NamedTuple):
    """The pattern and the random seed of points that were drawn from ground truth of (H, W)."""

    pattern: SamplePattern
    seed: int
    size: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class FramePair:
    """The files of one frame to score; parts that it does not have are None."""

    name: str
    """Name by which runs are compared."""
    prediction: Path | None
    frame: FrameFiles
    """The ground truth's frame; it has `gt`."""
    group: str = ""
    """The sequence of the frame: the data set's, the manifest's, or what its name says."""
    sparse: Path | None = None
    """The network's sparse input, of the run's record or the data set."""
    sigma: Path | None = None
    drawn: DrawnPoints | None = None
    """How the network's sparse input was drawn from the ground truth, by the run's record."""
    unit: str = METRES
    image: ImageSource | None = None

    @property
    def paths(self) -> dict[str, ImageSource | RawDepth | None]:
        """The files of the frame."""
        return {
            "prediction": self.prediction,
            "truth": self.frame.gt,
            "sparse": self.sparse,
            "image": self.image,
        }


def pair_frames(
    prediction: Path,
    ground_truth: Path,
    *,
    part: FramePart | None = None,
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
    for path in filter(None, (prediction, ground_truth)):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; check the path")
    layout, true_frames = _data_set(prediction, ground_truth)
    if layout is None and prediction.is_dir() != ground_truth.is_dir():
        raise UsageError(
            f"give two files or two folders, not one of each: {prediction}, {ground_truth}"
        )
    if layout is not None and prediction.is_file():
        raise UsageError(f"{ground_truth} is a data set but {prediction} one file; give a folder")
    # The frames with ground truth, and the predictions by name.
    notes: list[str] = []
    if prediction.is_dir():
        predictions, notes = depth_files(prediction)
        frames, more_notes = _true_frames(ground_truth, layout, true_frames, part)
        notes += more_notes
    else:
        name = frame_name(prediction.stem)
        frames, predictions = [FrameFiles(name=name, gt=ground_truth)], {name: prediction}
    # At least one name must be common to both.
    names = {frame.name for frame in frames}
    if names.isdisjoint(predictions):
        raise InputError(
            "no prediction has the name of a ground truth file: predictions are"
            f" {some_names(predictions)}; ground truth is {some_names(sorted(names))}"
        )
    if extra := sorted(set(predictions) - names):
        notes.append(
            f"warning: {len(extra):,} of {len(predictions):,} predictions have no ground truth"
            f" and are not scored: {some_names(extra)}"
        )
    # Each frame with its prediction.
    groups = groups_by_name([frame.name for frame in frames])
    return [
        _pair(frame, predictions.get(frame.name), group)
        for frame, group in zip(frames, groups, strict=True)
    ], notes


def _data_set(prediction: Path, folder: Path) -> tuple[str | None, list[FrameFiles]]:
    """The layout and the frames of a data set: as the batch read it, else recognised anew.

    None and none of files and folders of files.
    """
    summary = prediction / "summary.json"
    stated = read_json(summary).get("layout") if summary.is_file() else None
    for layout in (stated if stated in LAYOUTS else None, None):
        with contextlib.suppress(InputError, OSError):
            found, listing = list_frames(folder, layout)
            return found, listing.frames
    return None, []


def _true_frames(
    folder: Path, layout: str | None, found: Sequence[FrameFiles], part: FramePart | None
) -> tuple[list[FrameFiles], list[str]]:
    """The frames with ground truth of a folder of files or a data set, and notes."""
    if layout is None:
        files, notes = depth_files(folder)
        return [FrameFiles(name=name, gt=path) for name, path in files.items()], notes
    frames = [frame for frame in found if frame.gt is not None]
    if not frames:
        raise InputError(f"{folder} looks like {layout!r}, and no frame in it has ground truth")
    if part is not None:
        frames = [replace(frame, part=part) for frame in frames]
    cuts = ", ".join(sorted({str(frame.part) for frame in frames if frame.part != WHOLE}))
    note = f"gt: layout {layout}; frames with ground truth: {len(frames):,}"
    return frames, [note + (f", of which {cuts} is used" if cuts else "")]


def _pair(frame: FrameFiles, prediction: Path | None, group: str) -> FramePair:
    """The frame with what the record of a refinement, beside its depth, says of its inputs."""
    result: ResultFrame | None = None
    if prediction is not None:
        with contextlib.suppress(PnpDepthError):
            (result,) = result_frames(prediction)
    pair = FramePair(
        name=frame.name,
        prediction=prediction,
        frame=frame,
        group=group if frame.group is None else frame.group,
        sparse=_not_a_scan(frame.sparse),
        image=frame.image,
    )
    if result is None:
        return pair
    return replace(
        pair,
        sparse=_sparse_file(result.record) or pair.sparse,
        drawn=_drawn_points(result.record),
        sigma=result.sigma,
        image=result.image or pair.image,
        unit=result.unit,
    )


def _not_a_scan(path: Path | None) -> Path | None:
    """The path; None for a scan, of which the file does not say which points the network saw."""
    return path if path is not None and path.suffix.lower() in DEPTH_SUFFIXES else None


def _sparse_file(record: FrameRecord | None) -> Path | None:
    """The sparse depth of a record, if it exists and is no projected scan."""
    sparse = None if record is None else record.inputs.get("sparse")
    if sparse is None or sparse.sampled or sparse.calibration or not Path(sparse.path).is_file():
        return None
    return Path(sparse.path)


def _drawn_points(record: FrameRecord | None) -> DrawnPoints | None:
    """The points that a record says were drawn from the ground truth; None if it does not."""
    sparse = None if record is None else record.inputs.get("sparse")
    if record is None or sparse is None or sparse.sampled is None:
        return None
    drawn, (width, height) = sparse.sampled, record.size or (0, 0)
    with contextlib.suppress(UsageError):
        pattern = SamplePattern(kind=drawn.kind, count=drawn.count, fraction=drawn.fraction)
        return DrawnPoints(pattern, drawn.seed, (height, width))
    return None


def frame_name(stem: str) -> str:
    """Returns the frame of a file with this stem: without `_depth` and KITTI's file kind."""
    name = _KITTI_KIND.sub("_sync_", stem)
    return _base(name, _DEPTH_MARKS) or name


def depth_files(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """Returns the depth files below a folder by frame name, sorted, and notes on them.

    A frame in a subfolder has it in its name. Where `x_depth.png` exists, `x.png` is not depth, and
    `x_preview.png` and the like belong to it.

    Raises:
        InputError: If there is none, or two are one frame.
    """
    found, problems = find_files(folder, DEPTH_SUFFIXES)
    for problem in problems:
        if problem.path.is_file():
            raise InputError(str(problem))
    bases = (_base(stem, _DEPTH_MARKS) for stem in found)
    marked = {base for base in bases if base is not None}  # stems with a _depth file
    by_frame: dict[str, Path] = {}
    for stem, path in found.items():
        name = frame_name(stem)
        if stem in marked or _base(stem, _COMPANIONS) in marked:
            continue
        if name in by_frame:
            raise InputError(f"{path} and {by_frame[name].name} are one frame; keep one")
        by_frame[name] = path
    if not by_frame:
        suffixes = " ".join(DEPTH_SUFFIXES)
        raise InputError(f"{folder} holds no depth file ({suffixes}); check the path")
    notes = [f"warning: {problem}" for problem in problems]
    if ignored := [found[stem].name for stem in sorted(marked & found.keys())]:
        notes.append(f"{folder}: ignored, as there is a _depth of each: {some_names(ignored)}")
    return dict(sorted(by_frame.items())), notes


def _base(stem: str, marks: Sequence[str]) -> str | None:
    """The stem without the mark at its end; None if it has none of the marks."""
    return next((stem.removesuffix(m) for m in marks if stem.endswith(m) and stem != m), None)


def some_names(names: Iterable[str]) -> str:
    """Returns a few of the names on one line, and how many more there are."""
    listed = list(names)
    text = ", ".join(one_line(name) for name in listed[:_LISTED])
    more = len(listed) - _LISTED
    return f"{text} and {more:,} more" if more > 0 else text
