"""`manifest`: a CSV with a header line, or JSON lines, of frames whose files lie anywhere.

Columns or keys: image, sparse, gt, calib, mask, camera, sparse_scale, gt_scale, gt_size_ok, name,
group, protocol; all may be left out or empty but one of image and sparse. Paths are relative to the
manifest, or addresses of files in a store (`choices.STORES`). Where the mask is 0, the ground truth
is unknown; with gt_size_ok, it may have another size than the image. A frame without a name is
called by its image's stem; if stems come twice, by its path below the folder that all of the images
are in. Frames of one group are of one sequence.
"""

from __future__ import annotations

import csv
import json
import os
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched
from pnpdepth_cli.io.dataset.frame_names import normalised_name, portable_name_problem
from pnpdepth_cli.io.dataset.protocols import WHOLE, find_protocol
from pnpdepth_cli.io.file_bytes import cannot_read, check_size, one_line
from pnpdepth_cli.io.layouts import Layout
from pnpdepth_cli.io.remote.address import RemotePath, joined
from pnpdepth_cli.io.remote.store import local_files

_PATHS = ("image", "sparse", "gt", "calib", "mask")
_NUMBERS = {"camera": int, "sparse_scale": float, "gt_scale": float}
_FLAGS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
_KEYS = (*_PATHS, *_NUMBERS, "gt_size_ok", "name", "group", "protocol")


def matches(root: Path) -> bool:
    """Returns whether this is a .csv or .jsonl file."""
    return root.is_file() and root.suffix.lower() in (".csv", ".jsonl")


def listing(root: Path) -> Listing:
    """Returns a frame for each line of the file; missing files are listed as broken.

    Raises:
        FileFormatError: A line is invalid, or two frames would share the files of their results.
    """
    frames, lines = list[Frame](), array("q")
    broken: list[Unmatched] = []
    with local_files([root]) as local, _text_of(root, local.get(root, root)) as file:
        rows = _csv_rows(root, file) if root.suffix.lower() == ".csv" else _json_rows(root, file)
        for number, row in rows:
            values = _parts(root, number, row)
            masks = (values["mask"],) if "mask" in values else ()
            fields = {key: value for key, value in values.items() if key != "mask"}
            frames.append(Frame(**{"name": "", **fields, "masks": masks}))
            lines.append(number)
            lost = [file for file in _files(values) if _is_missing(file)]
            why = f"does not exist; correct line {number} of {root}"
            broken += [Unmatched(path=file, why=why) for file in lost]
    _name(frames)
    _check_names(root, frames, lines)
    return Listing(frames=frames, broken=tuple(broken))


@contextmanager
def _text_of(root: Path, copy: Path) -> Iterator[TextIO]:
    """Yields the list's file, open; it is not read as a whole, as it may have millions of lines.

    Args:
        root: Named in messages.
        copy: What is read.
    """
    check_size(copy)
    try:
        with copy.open(encoding="utf-8-sig", newline="\n") as file:
            while file.read(1 << 20):  # all of it is text
                pass
            file.seek(0)
            yield file
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{root} is not a text file; give CSV or JSON lines") from error
    except OSError as error:
        raise cannot_read(root, error) from error


def _check_names(root: Path, frames: Sequence[Frame], lines: Sequence[int]) -> None:
    """Raises FileFormatError if two frames would share the files of their results."""
    hashes: set[int] = set()
    for count, frame in enumerate(frames):
        key = hash(frame.name.casefold())
        if key in hashes:
            _check_earlier(root, frames, lines, count)
        hashes.add(key)


def _check_earlier(root: Path, frames: Sequence[Frame], lines: Sequence[int], count: int) -> None:
    *earlier, name = (frame.name for frame in frames[: count + 1])
    for other in earlier:
        if other.casefold() == name.casefold():
            hint = "" if other == name else f", which some disks take for {other!r}"
            raise FileFormatError(
                f"{root}, line {lines[count]}: a second frame {one_line(name)!r}{hint}; give it a"
                " name of its own"
            )


def _files(values: dict[str, Any]) -> list[Path]:
    return [values[key] for key in _PATHS if key in values]


def _is_missing(file: Path) -> bool:
    """Whether the file is not there; a store is asked only when the frame is read."""
    return not isinstance(file, RemotePath) and not file.exists()


def _name(frames: list[Frame]) -> None:
    """Names those without a name: by the stem, or by the path if stems are not unique."""
    unnamed = [number for number, frame in enumerate(frames) if not frame.name]
    paths = [_first_file(frames[number]) for number in unnamed]
    if len({path.stem for path in paths}) == len(paths):
        names = [path.stem for path in paths]
    else:
        folder = os.path.commonpath([path.parent.absolute() for path in paths])
        below = (path.absolute().relative_to(folder) for path in paths)
        names = [path.with_suffix("").as_posix() for path in below]
    for number, name in zip(unnamed, names, strict=True):
        frames[number] = replace(frames[number], name=name)


def _first_file(frame: Frame) -> Path:
    file = frame.image or frame.sparse
    assert isinstance(file, Path)
    return file


def _csv_rows(path: Path, file: TextIO) -> Iterator[tuple[int, dict[str, Any]]]:
    reader = csv.DictReader(file, restkey="more than the header has")
    try:
        for row in reader:
            yield reader.line_num, {str(k).strip(): v for k, v in row.items()}
    except csv.Error as error:
        raise FileFormatError(f"{path}, line {reader.line_num}: {one_line(error)}") from error


def _json_rows(path: Path, file: TextIO) -> Iterator[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(file, start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise FileFormatError(f"{path}, line {number}: {one_line(error)}") from error
        if not isinstance(row, dict):
            raise FileFormatError(f"{path}, line {number}: not a JSON object")
        yield number, row


def _parts(path: Path, number: int, row: dict[str, Any]) -> dict[str, Any]:
    """The fields of a `Frame` that a row gives."""
    where = f"{path}, line {number}"
    values = {k: str(v).strip() for k, v in row.items() if v is not None and str(v).strip()}
    unknown = sorted(set(values) - set(_KEYS))
    if unknown:
        commas = "; columns are parted by commas" if ";" in unknown[0] else ""
        raise FileFormatError(
            f"{where}: column {unknown[0]!r} is not one of {', '.join(_KEYS)}{commas}"
        )
    files = _paths(path.parent, where, values)
    nul = next((k for k, v in values.items() if "\0" in v), None)
    if nul is not None:
        raise FileFormatError(f"{where}: {nul} holds a NUL character; correct it")
    if "image" not in files and "sparse" not in files:
        raise FileFormatError(f"{where}: has neither image nor sparse; give one")
    try:
        numbers: dict[str, Any] = {k: f(values[k]) for k, f in _NUMBERS.items() if k in values}
    except (ValueError, OverflowError) as error:
        raise FileFormatError(f"{where}: {one_line(error)}") from error
    protocol = find_protocol(values["protocol"]) if "protocol" in values else WHOLE
    group = {"group": values["group"]} if "group" in values else {}
    if values.get("gt_size_ok", "0").lower() not in _FLAGS:
        raise FileFormatError(
            f"{where}: gt_size_ok is {values['gt_size_ok'][:20]!r}, not true or false"
        )
    other_size = _FLAGS[values.get("gt_size_ok", "0").lower()]
    return {
        "protocol": protocol,
        **_given_name(where, values),
        **group,
        **files,
        **numbers,
        "gt_other_size": other_size,
    }


def _paths(folder: Path, where: str, values: dict[str, str]) -> dict[str, Any]:
    try:
        return {key: joined(folder, values[key]) for key in _PATHS if key in values}
    except UsageError as error:
        raise FileFormatError(f"{where}: {error}") from error


def _given_name(where: str, values: dict[str, str]) -> dict[str, str]:
    if "name" not in values:
        return {}
    problem = portable_name_problem(values["name"])
    if problem is not None:
        raise FileFormatError(
            f"{where}: name {one_line(values['name'])[:60]!r} {problem}; choose another"
        )
    return {"name": normalised_name(values["name"])}


LAYOUT: Layout = Layout(matches=matches, listing=listing)
