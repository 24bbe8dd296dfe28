"""`manifest`: a CSV with a header line, or JSON lines, of frames whose files lie anywhere.

Columns or keys: image, sparse, sparse_mask, gt, calib, mask, camera, sparse_scale, min_confidence,
gt_scale, gt_size_ok, name, group, protocol; all may be left out or empty but one of image and
sparse. Paths are relative to the manifest. Sparse depth is used where its sparse_mask is at least
min_confidence, else above 0. Where the mask is 0, the ground truth is unknown; with gt_size_ok, it
may have another size than the image. A frame without a name is called by its image's stem; if stems
come twice, by its path below the folder that all of the images are in. Frames of one group are of
one sequence.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from pnpdepth_cli.dataset.frame_files import FrameFiles, Unmatched
from pnpdepth_cli.dataset.layouts.layout import Layout
from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.protocols import WHOLE, find_protocol

_PATHS = ("image", "sparse", "sparse_mask", "gt", "calib", "mask")
_FLAGS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


def _flag(text: str) -> bool:
    if text.lower() not in _FLAGS:
        raise ValueError(f"gt_size_ok is {text[:20]!r}, not true or false")
    return _FLAGS[text.lower()]


_VALUES: dict[str, Callable[[str], Any]] = {
    "camera": int,
    "sparse_scale": float,
    "min_confidence": float,
    "gt_scale": float,
    "gt_size_ok": _flag,
    "name": lambda text: PurePosixPath(text).as_posix(),
    "group": str,
    "protocol": lambda text: find_protocol(text).part or WHOLE,
}
"""How a column's text is read, by column. ValueError and our errors say what is wrong with it."""


def _frames(root: Path) -> list[FrameFiles | Unmatched]:
    """A frame for each line of the file; missing files are unmatched."""
    try:
        text = read_bytes(root).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{root} is not a text file; give CSV or JSON lines") from error
    # The frame of each line.
    rows = _csv_rows if root.suffix.lower() == ".csv" else _json_rows
    frames: dict[int, FrameFiles] = {}
    broken = []
    for number, row in rows(root, text):
        files, values = _parts(root.parent, f"{root}, line {number}", row)
        for path in files.values():
            if not path.exists():
                why = f"does not exist; correct line {number} of {root}"
                broken.append(Unmatched(path=path, why=why))
        masks = (files.pop("mask"),) if "mask" in files else ()
        values["gt_other_size"] = values.pop("gt_size_ok", False)
        values["part"] = values.pop("protocol", WHOLE)
        frames[number] = FrameFiles(**{"name": "", "masks": masks, **files, **values})
    # No two frames may share a name, on file systems that ignore capitals either.
    named = _name_frames(list(frames.values()))
    first: dict[str, FrameFiles] = {}
    for number, frame in zip(frames, named, strict=True):
        if first.setdefault(frame.name.casefold(), frame) is not frame:
            raise FileFormatError(
                f"{root}, line {number}: a second frame {one_line(frame.name)!r}, but for capitals;"
                " give it a name of its own"
            )
    return [*broken, *named]


def _csv_rows(path: Path, text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(text, newline="\n"), restkey="more than the header has")
    try:
        for row in reader:
            yield reader.line_num, {str(k).strip(): v for k, v in row.items()}
    except csv.Error as error:
        raise FileFormatError(f"{path}, line {reader.line_num}: {one_line(error)}") from error


def _json_rows(path: Path, text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(io.StringIO(text, newline="\n"), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise FileFormatError(f"{path}, line {number}: {one_line(error)}") from error
        if not isinstance(row, dict):
            raise FileFormatError(f"{path}, line {number}: not a JSON object")
        yield number, row


def _parts(folder: Path, where: str, row: dict[str, Any]) -> tuple[dict[str, Path], dict[str, Any]]:
    """The files and the other values of a row, by column."""
    texts = {k: str(v).strip() for k, v in row.items() if v is not None and str(v).strip()}
    unknown = sorted(set(texts) - {*_PATHS, *_VALUES})
    if unknown:
        commas = "; columns are parted by commas" if ";" in unknown[0] else ""
        keys = ", ".join((*_PATHS, *_VALUES))
        raise FileFormatError(f"{where}: column {unknown[0]!r} is not one of {keys}{commas}")
    if "image" not in texts and "sparse" not in texts:
        raise FileFormatError(f"{where}: has neither image nor sparse; give one")
    try:
        files = {key: folder / texts[key] for key in _PATHS if key in texts}
        values = {key: value(texts[key]) for key, value in _VALUES.items() if key in texts}
    except (ValueError, OverflowError, UsageError) as error:
        raise FileFormatError(f"{where}: {one_line(error)}") from error
    return files, values


def _name_frames(frames: list[FrameFiles]) -> list[FrameFiles]:
    """The frames, all with names: the stem, or the path if stems are not unique."""
    paths = [frame.image or frame.sparse for frame in frames if not frame.name]
    files = [path for path in paths if isinstance(path, Path)]
    names = [path.stem for path in files]
    if len(set(names)) < len(names):
        folder = os.path.commonpath([path.parent.absolute() for path in files])
        below = (path.absolute().relative_to(folder) for path in files)
        names = [path.with_suffix("").as_posix() for path in below]
    given = iter(names)
    return [frame if frame.name else replace(frame, name=next(given)) for frame in frames]


MANIFEST = Layout(
    matches=lambda root: root.is_file() and root.suffix.lower() in (".csv", ".jsonl"),
    frames=_frames,
)
