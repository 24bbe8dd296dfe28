"""`manifest`: a CSV with a header line, of frames whose files lie anywhere.

Columns: image, sparse, sparse_mask, depth, gt, calib, mask, camera, sparse_scale, sparse_kind,
min_confidence, gt_scale, gt_kind, gt_size_ok, name, group, protocol; all may be left out or empty
but one of image and sparse. Paths are relative to the manifest. Sparse depth is used where its
sparse_mask is at least
min_confidence, else above 0. Where the mask is 0, the ground truth is unknown; with gt_size_ok, it
may have another size than the image. A frame without a name is called by its image's stem; if stems
come twice, by its path below the folder that all of the images are in. Frames of one group are of
one sequence.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

from pnpdepth_cli.dataset.frame_files import FrameFiles, Unmatched, inverse_factor
from pnpdepth_cli.dataset.layouts.layout import Layout
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.file_bytes import decode_text, one_line, read_bytes
from pnpdepth_cli.protocols import WHOLE, find_protocol

_PATHS = ("image", "sparse", "sparse_mask", "depth", "gt", "calib", "mask")
_OTHERS = (
    "camera",
    "sparse_scale",
    "sparse_kind",
    "min_confidence",
    "gt_scale",
    "gt_kind",
    "gt_size_ok",
    "name",
    "group",
)
_COLUMNS = (*_PATHS, *_OTHERS, "protocol")
_FLAGS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


def _frames(root: Path) -> list[FrameFiles | Unmatched]:
    """A frame for each line of the file; missing files are unmatched."""
    # The frame of each line.
    frames: dict[int, FrameFiles] = {}
    broken = list[Unmatched]()
    for number, row in _rows(root):
        paths = {c: _path_of(root.parent, row[c]) for c in _PATHS if c in row}
        try:
            frames[number] = _frame(row, paths)
        except (ValueError, OverflowError, UsageError) as error:
            raise InputError(f"{root}, line {number}: {one_line(error)}") from error
        for path in paths.values():
            if not path.exists():
                broken.append((path, f"does not exist; correct line {number} of {root}"))
    # No two frames may share a name, on file systems that ignore capitals either.
    named = _name_frames(list(frames.values()))
    first: dict[str, FrameFiles] = {}
    for number, frame in zip(frames, named, strict=True):
        if first.setdefault(frame.name.casefold(), frame) is not frame:
            if first[frame.name.casefold()].name != frame.name:
                raise InputError(
                    f"{root}, line {number}: a second frame {one_line(frame.name)!r}, but for"
                    " capitals; give it a name of its own"
                )
            raise InputError(
                f"{root}, line {number}: a second frame {one_line(frame.name)!r}; give it a name of"
                " its own"
            )
    return [*broken, *named]


def _path_of(folder: Path, text: str) -> Path:
    """The file of a cell; backslashes part folders where no file has them in its name."""
    path = folder / text
    return path if path.exists() or "\\" not in text else folder / text.replace("\\", "/")


def _rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """The number of each line, and its texts by column."""
    try:
        text = decode_text(read_bytes(path))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file; give CSV") from error
    if "\n" not in text:  # of old spreadsheets
        text = text.replace("\r", "\n")
    reader = csv.DictReader(io.StringIO(text, newline="\n"), restkey="more than the header has")
    try:
        header = [name.strip() for name in reader.fieldnames or ()]
        for name in filter(None, header):
            if name not in _COLUMNS:
                raise InputError(
                    f"{path}, line {reader.line_num}: column {name!r} is not one of"
                    f" {', '.join(_COLUMNS)}"
                )
            if header.count(name) > 1:
                raise InputError(
                    f"{path}, line {reader.line_num}: column {name!r} comes twice; keep one"
                )
        for row in reader:
            texts = {str(k).strip(): str(v).strip() for k, v in row.items() if v is not None}
            yield reader.line_num, {k: v for k, v in texts.items() if v}
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: {one_line(error)}") from error


def _frame(row: dict[str, str], paths: dict[str, Path]) -> FrameFiles:
    """The frame of a line; ValueError and our errors say what is wrong with it."""
    # What the line says is checked where no type does.
    if not row.keys() <= {*_COLUMNS}:
        raise ValueError("has more cells than the header; quote a comma in a cell")
    if "image" not in row and "sparse" not in row:
        raise ValueError("has neither image nor sparse; give one")
    if (flag := row.get("gt_size_ok", "no")).lower() not in _FLAGS:
        raise ValueError(f"gt_size_ok is {flag[:20]!r}, not true or false")
    for column in ("sparse_kind", "gt_kind"):
        inverse_factor(column, row.get(column))
    part = find_protocol(row["protocol"]).part if "protocol" in row else None
    # Cells that are empty leave the fields of a frame as they are without them.
    return FrameFiles(
        name=PurePosixPath(row["name"]).as_posix() if "name" in row else "",
        image=paths.get("image"),
        sparse=paths.get("sparse"),
        sparse_mask=paths.get("sparse_mask"),
        min_confidence=_number(row, "min_confidence"),
        depths=(paths["depth"],) if "depth" in paths else (),
        gt=paths.get("gt"),
        calib=paths.get("calib"),
        camera=int(row["camera"]) if "camera" in row else None,
        sparse_scale=_number(row, "sparse_scale"),
        gt_scale=_number(row, "gt_scale"),
        scales_stated=True,
        kind_of_sparse=row.get("sparse_kind"),
        kind_of_gt=row.get("gt_kind"),
        part=part or WHOLE,
        masks=(paths["mask"],) if "mask" in row else (),
        gt_other_size=_FLAGS[flag.lower()],
        group=row.get("group"),
    )


def _number(row: dict[str, str], column: str) -> float | None:
    """The number in a cell; None of an empty one."""
    return float(row[column]) if column in row else None


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
    matches=lambda root: root.is_file() and root.suffix.lower() == ".csv", frames=_frames
)
