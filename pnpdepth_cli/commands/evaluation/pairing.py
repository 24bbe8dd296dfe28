"""Finds the prediction of each frame of the ground truth: files and folders matched by name."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.commands.evaluation.dependence import groups_by_name
from pnpdepth_cli.commands.evaluation.stacks import stack_size
from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.dataset import IMAGE_SUFFIXES, Frame, Source, file_of, find_protocol
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES
from pnpdepth_cli.io.layouts import find_layout, list_frames
from pnpdepth_cli.io.record import read_json
from pnpdepth_cli.io.remote import RemotePath

_POINTS = (*DEPTH_SUFFIXES, ".csv", ".txt")
_DEPTH_MARKS = ("_depth", ".depth")
_COMPANIONS = ("_preview", "_improvement", "_sigma", "_valid")
_SIGMA_SUFFIXES = (".exr", ".npy")
# KITTI's selection names the kind of file in the middle.
_KITTI_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
_LISTED = 5


@dataclass(frozen=True, kw_only=True)
class FramePair:
    """The files of one frame to score; parts that it does not have are None."""

    name: str
    """By which runs are compared."""
    prediction: Path | None
    frame: Frame
    """The ground truth's frame; it has `gt`."""
    group: str = ""
    """The sequence of the frame: the data set's, the manifest's, or what its name says."""
    sparse: Path | None = None
    """The network's sparse input: the user's, the run's record's or the data set's."""
    sparse_named: bool = False
    """Whether the user named the sparse input."""
    sigma: Path | None = None
    """The standard deviation that a refinement wrote beside its depth."""
    index: int | None = None
    """Of the frame, in files of several frames."""
    previous: FramePair | None = None
    """The frame before in the same sequence."""
    sampling: dict[str, Any] | None = None
    """How the sparse input was sampled from the ground truth, by the run's record."""
    sampled: int = 0
    """Points of the ground truth that were the sparse input, by the run's record."""
    image: Source | None = None
    """The image, if the record or the data set names it."""
    mask: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """All frames of the ground truth, in its order."""

    frames: tuple[FramePair, ...]
    notes: tuple[str, ...]
    single: bool = False
    """True for two files rather than two folders."""


def pair_frames(
    prediction: Path,
    ground_truth: Path,
    *,
    sparse: Path | None = None,
    mask: Path | None = None,
    layout_protocol: str | None = None,
    calib: Path | None = None,
) -> Pairs:
    """Returns the frames of two files, or of two folders by name, each with the one before.

    Args:
        prediction: A depth file, or a folder of them.
        ground_truth: The same, or a data set of a known layout, or a manifest.
        sparse: A file, or a folder with the same names.
        mask: A file, or a folder with the same names.
        layout_protocol: One of choices.FRAME_PROTOCOLS, by which the frames of a data set are cut;
            None for the layout's own.
        calib: Calibration of all frames; None for the data set's own.

    Raises:
        UsageError: For a file and a folder, or a layout protocol without a data set.
        InputError: For a missing path, or folders without a common name.
    """
    for path in (prediction, ground_truth, *(p for p in (sparse, mask, calib) if p)):
        _check_local(path)
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; check the path")
    layout = _layout_of(ground_truth)
    if layout is None:
        if layout_protocol is not None:
            raise UsageError(
                f"--layout-protocol {layout_protocol} is for data sets, and {ground_truth} is in no"
                " known layout; leave it out"
            )
        if prediction.is_dir() != ground_truth.is_dir():
            raise UsageError(
                f"give two files or two folders, not one of each: {prediction}, {ground_truth}"
            )
    elif prediction.is_file():
        raise UsageError(f"{ground_truth} is a data set but {prediction} one file; give a folder")
    notes: list[str] = []
    if prediction.is_file():
        if (count := stack_size(prediction)) is not None:
            return _stacked_pairs(prediction, ground_truth, count)
        name = frame_name(prediction.stem)
        frames, predictions = [Frame(name=name, gt=ground_truth)], {name: prediction}
    else:
        predictions, notes = depth_files(prediction)
        frames, more_notes = _true_frames(ground_truth, layout, layout_protocol)
        notes += more_notes
    for frame in frames:
        for part in (frame.image, frame.sparse, frame.gt):
            if part is not None:
                _check_local(file_of(part))
    if calib is not None:
        frames = [replace(frame, calib=calib) for frame in frames]
    return _pairs(frames, predictions, sparse, mask, notes, single=prediction.is_file())


def _check_local(path: Path) -> None:
    if isinstance(path, RemotePath):
        raise UsageError(f"{path}: eval reads local files; copy the frames from the store first")


def _layout_of(ground_truth: Path) -> str | None:
    """The layout that the ground truth is a data set of; None for files and folders of files."""
    try:
        return find_layout(ground_truth)
    except (InputError, OSError):
        return None


def _true_frames(
    folder: Path, layout: str | None, layout_protocol: str | None
) -> tuple[list[Frame], list[str]]:
    """The frames with ground truth of a folder of files or a data set, and notes."""
    if layout is None:
        files, notes = depth_files(folder)
        return [Frame(name=name, gt=path) for name, path in files.items()], notes
    frames = [frame for frame in list_frames(folder, layout)[1].frames if frame.gt is not None]
    if not frames:
        raise InputError(f"{folder} looks like {layout!r}, and no frame in it has ground truth")
    if layout_protocol is not None:
        cut = find_protocol(layout_protocol)
        frames = [replace(frame, protocol=cut) for frame in frames]
    cuts = ", ".join(sorted({frame.protocol.name for frame in frames} - {"whole"}))
    note = f"gt: layout {layout}; frames with ground truth: {len(frames):,}"
    return frames, [
        note + (f", cut by layout protocol {cuts}; --layout-protocol to change" if cuts else "")
    ]


def _stacked_pairs(prediction: Path, ground_truth: Path, count: int) -> Pairs:
    """A frame for each map of two files of several frames."""
    others = stack_size(ground_truth)
    if others != count:
        stored = "a single map" if others is None else f"{others:,} frames"
        raise InputError(f"{prediction} holds {count:,} frames but {ground_truth} {stored}")
    frames = (Frame(name=f"{index:04}", gt=ground_truth) for index in range(count))
    return Pairs(
        frames=tuple(
            FramePair(name=frame.name, prediction=prediction, frame=frame, index=index)
            for index, frame in enumerate(frames)
        ),
        notes=(f"{count:,} frames in each of the two files",),
    )


def _pairs(
    frames: Sequence[Frame],
    predictions: Mapping[str, Path],
    sparse: Path | None,
    mask: Path | None,
    notes: list[str],
    *,
    single: bool,
) -> Pairs:
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
    points = _by_frame(sparse, _POINTS, names)
    masks = _by_frame(mask, (*DEPTH_SUFFIXES, *IMAGE_SUFFIXES), names)
    pairs: list[FramePair] = []
    last: dict[str, FramePair] = {}
    for frame, group in zip(frames, groups_by_name([f.name for f in frames]), strict=True):
        pair = replace(
            _pair(frame, predictions.get(frame.name), points.get(frame.name)),
            group=group if frame.group is None else frame.group,
            mask=masks.get(frame.name),
        )
        pairs.append(replace(pair, previous=last.get(pair.group)))
        last[pair.group] = pair
    return Pairs(frames=tuple(pairs), notes=tuple(notes), single=single)


def _by_frame(path: Path | None, suffixes: Sequence[str], names: Iterable[str]) -> dict[str, Path]:
    """The file of each frame: the one for all, or those of the folder."""
    if path is None:
        return {}
    return _depth_files(path, suffixes)[0] if path.is_dir() else dict.fromkeys(names, path)


def _pair(frame: Frame, prediction: Path | None, sparse: Path | None) -> FramePair:
    """The frame with what the record of a refinement, beside its depth, says of its inputs."""
    record, sigma = {}, None
    if prediction is not None:
        name = _base(prediction.stem, _DEPTH_MARKS) or prediction.stem
        record = _record(prediction.with_name(f"{name}.json"))
        sigmas = (prediction.with_name(f"{name}_sigma{suffix}") for suffix in _SIGMA_SUFFIXES)
        sigma = next((file for file in sigmas if file.is_file()), None)
    inputs = _dict(record.get("inputs"))
    used = _dict(record.get("points")).get("used")
    sampling = _dict(inputs.get("sparse"))
    is_sampled = "sampled_from" in sampling
    known = frame.sparse
    if known is not None and known.suffix.lower() not in DEPTH_SUFFIXES:
        known = None
    return FramePair(
        name=frame.name,
        prediction=prediction,
        frame=frame,
        sparse=sparse or _input(inputs, "sparse") or known,
        sparse_named=sparse is not None,
        sigma=sigma,
        sampling=sampling if is_sampled else None,
        sampled=used if is_sampled and isinstance(used, int) else 0,
        image=_input(inputs, "image") or frame.image,
    )


def _record(path: Path) -> dict[str, Any]:
    try:
        return read_json(path) if path.is_file() else {}
    except PnpDepthError:
        return {}


def _input(inputs: Mapping[str, Any], part: str) -> Path | None:
    """A file of a record's inputs, if it still exists.

    None for a scan, as the file does not say which of its points the network saw.
    """
    entry = _dict(inputs.get(part))
    path = entry.get("path")
    if not isinstance(path, str) or "calibration" in entry or not Path(path).is_file():
        return None
    return Path(path)


def _dict(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def frame_name(stem: str) -> str:
    """Returns the frame of a file with this stem: without `_depth` and KITTI's file kind."""
    name = _KITTI_KIND.sub("_sync_", stem)
    return _base(name, _DEPTH_MARKS) or name


def depth_files(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """Returns the depth files below a folder by frame name, sorted, and notes on them.

    A frame in a subfolder has it in its name.

    Raises:
        InputError: If there is none.
    """
    files, notes = _depth_files(folder, DEPTH_SUFFIXES)
    if not files:
        suffixes = " ".join(DEPTH_SUFFIXES)
        raise InputError(f"{folder} holds no depth file ({suffixes}); check the path")
    return files, notes


def _depth_files(folder: Path, suffixes: Sequence[str]) -> tuple[dict[str, Path], list[str]]:
    """(one depth file per frame name, warnings) of all depth files below the folder.

    Where `x_depth.png` exists, `x.png` is not depth, and `x_preview.png` and the like belong to it.
    """
    unreadable: list[OSError] = []
    by_frame: dict[str, Path] = {}
    ignored: list[str] = []
    for top, folders, files in os.walk(folder, onerror=unreadable.append):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        paths = [Path(top, name) for name in sorted(files) if not name.startswith(".")]
        depths = [p for p in paths if p.suffix.lower() in suffixes and p.is_file()]
        marked = {_base(p.stem, _DEPTH_MARKS) for p in depths} - {None}  # stems with a _depth file
        inside = Path(top).relative_to(folder)
        for path in depths:
            name = (inside / frame_name(path.stem)).as_posix()
            if path.stem in marked:
                ignored.append(path.name)
            elif name in by_frame:
                raise InputError(f"{path} and {by_frame[name].name} are one frame; keep one")
            elif _base(path.stem, _COMPANIONS) not in marked:
                by_frame[name] = path
    notes = [f"warning: {e.filename} cannot be read ({e.strerror})" for e in unreadable]
    if ignored:
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
