"""`manifest`: a CSV with a header line, or JSON lines, of frames whose files lie anywhere.

Columns or keys: image, sparse, gt, calib, mask, camera, sparse_scale, gt_scale, gt_size_ok, name,
group, protocol; all may be left out or empty but one of image and sparse. Paths are relative to the
manifest. Where the mask is 0, the ground truth is unknown; with gt_size_ok, it may have another
size than the image. A frame without a name is called by its image's stem; if stems come twice, by
its path below the folder that all of the images are in. Frames of one group are of one sequence.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched
from pnpdepth_cli.io.dataset.frame_names import normalised_name, portable_name_problem
from pnpdepth_cli.io.dataset.protocols import WHOLE, find_protocol
from pnpdepth_cli.io.file_bytes import one_line, read_bytes
from pnpdepth_cli.io.layouts import Layout

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
    try:
        text = read_bytes(root).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{root} is not a text file; give CSV or JSON lines") from error
    rows = _csv_rows(root, text) if root.suffix.lower() == ".csv" else _json_rows(root, text)
    parts = [(number, _parts(root, number, row)) for number, row in rows]
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    taken: dict[str, str] = {}
    for (number, values), name in zip(parts, _names([p for _, p in parts]), strict=True):
        earlier = taken.get(name.casefold())
        if earlier is not None:
            hint = "" if earlier == name else f", which some disks take for {earlier!r}"
            raise FileFormatError(
                f"{root}, line {number}: a second frame {one_line(name)!r}{hint}; give it a name"
                " of its own"
            )
        taken[name.casefold()] = name
        masks = (values["mask"],) if "mask" in values else ()
        fields = {key: value for key, value in values.items() if key != "mask"}
        frames.append(Frame(**fields | {"name": name, "masks": masks}))
        lost = [file for file in _files(values) if not file.exists()]
        why = f"does not exist; correct line {number} of {root}"
        broken += [Unmatched(path=file, why=why) for file in lost]
    return Listing(frames=frames, broken=tuple(broken))


def _files(values: dict[str, Any]) -> list[Path]:
    return [values[key] for key in _PATHS if key in values]


def _names(parts: Sequence[dict[str, Any]]) -> list[str]:
    """A name per frame: the line's own, else the stem, else the path if stems are not unique."""
    unnamed = [_files(values)[0] for values in parts if "name" not in values]
    if len({path.stem for path in unnamed}) == len(unnamed):
        return [values.get("name") or _files(values)[0].stem for values in parts]
    folder = os.path.commonpath([path.parent.absolute() for path in unnamed])
    return [
        values.get("name")
        or _files(values)[0].absolute().relative_to(folder).with_suffix("").as_posix()
        for values in parts
    ]


def _csv_rows(path: Path, text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(text, newline=""), restkey="more than the header has")
    try:
        for row in reader:
            yield reader.line_num, {str(k).strip(): v for k, v in row.items()}
    except csv.Error as error:
        raise FileFormatError(f"{path}, line {reader.line_num}: {one_line(error)}") from error


def _json_rows(path: Path, text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(text.split("\n"), start=1):
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
    files: dict[str, Any] = {k: path.parent / values[k] for k in _PATHS if k in values}
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


def _given_name(where: str, values: dict[str, str]) -> dict[str, str]:
    if "name" not in values:
        return {}
    problem = portable_name_problem(values["name"])
    if problem is not None:
        raise FileFormatError(
            f"{where}: name {one_line(values['name'])[:60]!r} {problem}; choose another"
        )
    return {"name": normalised_name(values["name"])}


LAYOUT = Layout(matches=matches, listing=listing)
