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

# The columns of a list.
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
_TRUTH_VALUES = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


def _frames_of_list(path: Path) -> list[FrameFiles | Unmatched]:
    """A frame for each line of a list, in its order; files that do not exist come before them.

    Raises:
        InputError: A line is no frame, or two frames have one name.
    """
    # The frame of each line.
    frames: dict[int, FrameFiles] = {}  # by the number of the line
    missing = list[Unmatched]()
    for number, cells in _lines_of(path):
        files = {
            column: _file_of(path.parent, cells[column]) for column in _PATHS if column in cells
        }
        try:
            frames[number] = _frame_of(cells, files)
        except (ValueError, UsageError) as error:  # also of float() and int()
            raise InputError(f"{path}, line {number}: {one_line(error)}") from error
        for file in files.values():
            if not file.exists():
                missing.append((file, f"does not exist; correct line {number} of {path}"))
    # No two frames may share a name, on file systems that ignore capitals either.
    named = _name_frames(list(frames.values()))
    names: dict[str, str] = {}  # by the same without capitals
    for number, frame in zip(frames, named, strict=True):
        folded = frame.name.casefold()
        if folded in names:
            if names[folded] != frame.name:
                raise InputError(
                    f"{path}, line {number}: a second frame {one_line(frame.name)!r}, but for"
                    " capitals; give it a name of its own"
                )
            raise InputError(
                f"{path}, line {number}: a second frame {one_line(frame.name)!r}; give it a name of"
                " its own"
            )
        names[folded] = frame.name
    return [*missing, *named]


def _file_of(folder: Path, text: str) -> Path:
    """The file that a cell names, in the folder of the list.

    A backslash separates folders, as on Windows, unless a file has it in its name.
    """
    file = folder / text
    if "\\" in text and not file.exists():
        return folder / text.replace("\\", "/")
    return file


def _lines_of(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yields the number of each line of a list, and its cells that are not empty, by column.

    Raises:
        InputError: The file is no CSV, or its header has another column, or one twice.
    """
    try:
        text = decode_text(read_bytes(path))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file; give CSV") from error
    if "\n" not in text:  # of old spreadsheets
        text = text.replace("\r", "\n")
    # The header, then the lines.
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
            cells = {
                str(column).strip(): str(text).strip()
                for column, text in row.items()
                if text is not None  # of a line with fewer cells than the header
            }
            yield reader.line_num, {column: text for column, text in cells.items() if text}
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: {one_line(error)}") from error


def _frame_of(cells: dict[str, str], files: dict[str, Path]) -> FrameFiles:
    """The frame of a line.

    Args:
        cells: The line's cells that are not empty, by column.
        files: The files that they name, by column.

    Raises:
        ValueError: A cell is no number or truth value, or the line lacks one or has too many.
        UsageError: There is no such kind of depth, or no such protocol.
    """
    # What the line says is checked where no type does.
    if not cells.keys() <= {*_COLUMNS}:
        raise ValueError("has more cells than the header; quote a comma in a cell")
    if "image" not in cells and "sparse" not in cells:
        raise ValueError("has neither image nor sparse; give one")
    size_ok = cells.get("gt_size_ok", "no")
    if size_ok.lower() not in _TRUTH_VALUES:
        raise ValueError(f"gt_size_ok is {size_ok[:20]!r}, not true or false")
    for column in ("sparse_kind", "gt_kind"):
        inverse_factor(column, cells.get(column))
    part = find_protocol(cells["protocol"]).part if "protocol" in cells else None
    # Cells that are empty leave the fields of a frame as they are without them.
    return FrameFiles(
        name=PurePosixPath(cells["name"]).as_posix() if "name" in cells else "",
        image=files.get("image"),
        sparse=files.get("sparse"),
        sparse_mask=files.get("sparse_mask"),
        min_confidence=_number(cells, "min_confidence"),
        depths=(files["depth"],) if "depth" in files else (),
        gt=files.get("gt"),
        calib=files.get("calib"),
        camera=int(cells["camera"]) if "camera" in cells else None,
        sparse_scale=_number(cells, "sparse_scale"),
        gt_scale=_number(cells, "gt_scale"),
        scales_stated=True,
        kind_of_sparse=cells.get("sparse_kind"),
        kind_of_gt=cells.get("gt_kind"),
        part=part or WHOLE,
        masks=(files["mask"],) if "mask" in cells else (),
        gt_other_size=_TRUTH_VALUES[size_ok.lower()],
        group=cells.get("group"),
    )


def _number(cells: dict[str, str], column: str) -> float | None:
    """The number in the cell of a column. None: the cell is empty."""
    return float(cells[column]) if column in cells else None


def _name_frames(frames: list[FrameFiles]) -> list[FrameFiles]:
    """The frames, with a name for each that has none: the stem of its image, or of its depth.

    If two have one stem, all are named by the path below the folder that they have in common.
    """
    nameless = [frame.image or frame.sparse for frame in frames if not frame.name]
    files = [file for file in nameless if isinstance(file, Path)]
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        folder = os.path.commonpath([file.parent.absolute() for file in files])
        below = [file.absolute().relative_to(folder) for file in files]
        names = [file.with_suffix("").as_posix() for file in below]
    remaining = iter(names)
    return [frame if frame.name else replace(frame, name=next(remaining)) for frame in frames]


def _is_list(root: Path) -> bool:
    """Whether a path is that of a CSV file."""
    return root.is_file() and root.suffix.lower() == ".csv"


MANIFEST = Layout(matches=_is_list, frames=_frames_of_list)
