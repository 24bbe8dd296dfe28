"""Which prediction belongs to which truth: files and folders matched by name."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.dataset.frame import DEPTHS, PICTURES
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.layouts import Frame, Source, find_layout, list_frames
from pnpdepth_cli.io.record import read_json

_POINTS = (*DEPTHS, ".csv", ".txt")
_DEPTH_MARKS = ("_depth", ".depth")
_COMPANIONS = ("_preview", "_improvement")
# KITTI's selection has the kind of file in the middle of the name.
_KITTI_KIND = re.compile(r"_sync_(image|velodyne_raw|groundtruth_depth)_")
_LISTED = 5


@dataclass(frozen=True, kw_only=True)
class FramePair:
    """One frame to score. prediction: None where there is none. truth: a frame that has `gt`.

    sparse: the network's sparse input, from the user (sparse_asked), from the run's record or from
    the data set. sampled: so many points of the truth itself were the input, as the record says.
    image: the picture, if the record or the data set names it.
    """

    name: str
    prediction: Path | None
    truth: Frame
    sparse: Path | None = None
    sparse_asked: bool = False
    sampled: int = 0
    image: Source | None = None
    mask: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """All frames of the truth in its order, and what a person should be told."""

    frames: tuple[FramePair, ...]
    notes: tuple[str, ...]
    single: bool


def pair_frames(
    prediction: Path, truth: Path, *, sparse: Path | None = None, mask: Path | None = None
) -> Pairs:
    """The frames of two files, or of two folders by name; all may be of any depth format.

    The truth can also be a data set of a known layout, or a manifest. sparse, mask: a file, or a
    folder with the same names. UsageError for a file and a folder, InputError where nothing fits.
    """
    for path in (prediction, truth, *(p for p in (sparse, mask) if p)):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; check the path")
    layout = _layout_of(truth)
    if layout is None and prediction.is_dir() != truth.is_dir():
        folder, file = (prediction, truth) if prediction.is_dir() else (truth, prediction)
        raise UsageError(f"{folder} is a folder but {file} a file; give two files or two folders")
    if prediction.is_file():
        if layout is not None:
            raise UsageError(f"{truth} is a data set but {prediction} one file; give a folder")
        name = frame_name(prediction.stem)
        frame = Frame(name=name, gt=truth)
        return _pairs([frame], {name: prediction}, sparse, mask, notes=[], single=True)
    predictions, notes = depth_files(prediction)
    if layout is None:
        truths, more = depth_files(truth)
        frames = [Frame(name=name, gt=path) for name, path in truths.items()]
        notes += more
    else:
        frames = [frame for frame in list_frames(truth, layout)[1].frames if frame.gt is not None]
        notes.append(f"truth: layout {layout}; frames with ground truth: {len(frames):,}")
        if not frames:
            raise InputError(f"{truth} looks like {layout!r}, and no frame in it has ground truth")
    return _pairs(frames, predictions, sparse, mask, notes=notes, single=False)


def frame_name(stem: str) -> str:
    """The frame that a file of this stem belongs to: ours end in _depth, KITTI's say their kind."""
    name = _KITTI_KIND.sub("_sync_", stem)
    mark = next((mark for mark in _DEPTH_MARKS if name.endswith(mark)), "")
    return name.removesuffix(mark) or name


def depth_files(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """The depth files of a folder and of those in it by frame, sorted, and what to tell of them.

    A frame in a folder of its own has the folder in its name. InputError if there is none.
    """
    found, notes = _files(folder, DEPTHS)
    if not found:
        raise InputError(f"{folder} holds no depth file ({' '.join(DEPTHS)}); check the path")
    return found, notes


def some_names(names: Iterable[str]) -> str:
    """A few of the names on one line, and how many more there are."""
    listed = list(names)
    text = ", ".join(one_line(name) for name in listed[:_LISTED])
    more = len(listed) - _LISTED
    return f"{text} and {more:,} more" if more > 0 else text


def _layout_of(truth: Path) -> str | None:
    """The layout that the truth is a data set of; None for files and folders of files."""
    try:
        return find_layout(truth)
    except (InputError, OSError):
        return None


def _files(folder: Path, suffixes: Sequence[str]) -> tuple[dict[str, Path], list[str]]:
    unreadable: list[OSError] = []
    found: dict[str, Path] = {}
    aside: list[str] = []
    for top, folders, files in os.walk(folder, onerror=unreadable.append):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        paths = [Path(top, name) for name in sorted(files) if not name.startswith(".")]
        depths = [p for p in paths if p.suffix.lower() in suffixes and p.is_file()]
        marked = {_base(p.stem, _DEPTH_MARKS) for p in depths} - {None}
        inside = Path(top).relative_to(folder)
        for path in depths:
            name = (inside / frame_name(path.stem)).as_posix()
            if path.stem in marked:
                aside.append(path.name)
            elif name in found:
                raise InputError(f"{path} and {found[name].name} are one frame; keep one")
            elif _base(path.stem, _COMPANIONS) not in marked:
                found[name] = path
    notes = [f"warning: {e.filename} cannot be read ({e.strerror})" for e in unreadable]
    if aside:
        notes.append(f"{folder}: left aside, as there is a _depth of each: {some_names(aside)}")
    return dict(sorted(found.items())), notes


def _base(stem: str, marks: Sequence[str]) -> str | None:
    """What the stem says before one of the marks at its end, None without one."""
    return next((stem.removesuffix(m) for m in marks if stem.endswith(m) and stem != m), None)


def _pairs(
    frames: list[Frame],
    predictions: dict[str, Path],
    sparse: Path | None,
    mask: Path | None,
    *,
    notes: list[str],
    single: bool,
) -> Pairs:
    names = {frame.name for frame in frames}
    if names.isdisjoint(predictions):
        raise InputError(
            f"no prediction has the name of a truth: predictions are {some_names(predictions)};"
            f" truths are {some_names(sorted(names))}"
        )
    extra = sorted(set(predictions) - names)
    if extra:
        notes.append(
            f"warning: {len(extra):,} of {len(predictions):,} predictions have no truth and are"
            f" not scored: {some_names(extra)}"
        )
    points = _by_frame(sparse, _POINTS, names)
    masks = _by_frame(mask, (*DEPTHS, *PICTURES), names)
    return Pairs(
        frames=tuple(
            _pair(f, predictions.get(f.name), points.get(f.name), masks.get(f.name)) for f in frames
        ),
        notes=tuple(notes),
        single=single,
    )


def _by_frame(place: Path | None, suffixes: Sequence[str], names: Iterable[str]) -> dict[str, Path]:
    """The file for each frame: one for all, or the folder's own for each."""
    if place is None:
        return {}
    return _files(place, suffixes)[0] if place.is_dir() else dict.fromkeys(names, place)


def _pair(
    frame: Frame, prediction: Path | None, sparse: Path | None, mask: Path | None
) -> FramePair:
    record = _record_of(prediction)
    return FramePair(
        name=frame.name,
        prediction=prediction,
        truth=frame,
        sparse=sparse or _input(record, "sparse") or _depth_file(frame.sparse),
        sparse_asked=sparse is not None,
        sampled=_sampled(record),
        image=_input(record, "image") or frame.image,
        mask=mask,
    )


def _record_of(prediction: Path | None) -> dict[str, Any]:
    """What a refinement recorded beside the depth that it wrote; nothing where that is not so."""
    if prediction is None:
        return {}
    name = _base(prediction.stem, _DEPTH_MARKS) or prediction.stem
    record = prediction.with_name(f"{name}.json")
    try:
        return read_json(record) if record.is_file() else {}
    except PnpDepthError:
        return {}


def _input(record: dict[str, Any], part: str) -> Path | None:
    """The image, or the sparse depth file, that was refined with, if it still exists.

    A scan is left out: which of its points the network saw is not in the file.
    """
    entry = _dict(_dict(record.get("inputs")).get(part))
    path = entry.get("path")
    if not isinstance(path, str) or "calibration" in entry or not Path(path).is_file():
        return None
    return Path(path)


def _sampled(record: dict[str, Any]) -> int:
    """How many points of the truth were taken as sparse depth."""
    if "sampled_from" not in _dict(_dict(record.get("inputs")).get("sparse")):
        return 0
    used = _dict(record.get("points")).get("used")
    return used if isinstance(used, int) else 0


def _dict(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _depth_file(path: Path | None) -> Path | None:
    return path if path is not None and path.suffix.lower() in DEPTHS else None
