"""`manifest`: a CSV with a header line, or JSON lines, of frames whose files lie anywhere.

Columns or keys: image, sparse, gt, calib, camera, sparse_scale, gt_scale, name, protocol; all may
be left out or empty but one of image and sparse. Paths are relative to the manifest.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.layouts.frame import Frame
from pnpdepth_cli.io.layouts.protocols import WHOLE, find_protocol
from pnpdepth_cli.io.opening import one_line, read_bytes

_PATHS = ("image", "sparse", "gt", "calib")
_NUMBERS = {"camera": int, "sparse_scale": float, "gt_scale": float}
_KEYS = (*_PATHS, *_NUMBERS, "name", "protocol")


def matches(root: Path) -> bool:
    """True for a .csv or .jsonl file."""
    return root.is_file() and root.suffix.lower() in (".csv", ".jsonl")


def frames(root: Path) -> list[Frame]:
    """One frame a line. FileFormatError for a line without meaning, InputError for a lost file."""
    try:
        text = read_bytes(root).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{root} is not a text file; give CSV or JSON lines") from error
    rows = _csv_rows(text) if root.suffix.lower() == ".csv" else _json_rows(root, text)
    found: list[Frame] = []
    taken: set[str] = set()
    for number, row in rows:
        frame = _frame(root, number, row)
        if frame.name in taken:
            raise FileFormatError(f"{root}, line {number}: a second frame {frame.name!r}; name it")
        taken.add(frame.name)
        found.append(frame)
    return found


def _csv_rows(text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    reader = csv.DictReader(text.splitlines(), restkey="more than the header has")
    for row in reader:
        yield reader.line_num, {str(k).strip(): v for k, v in row.items()}


def _json_rows(path: Path, text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise FileFormatError(f"{path}, line {number}: {one_line(error)}") from error
        if not isinstance(row, dict):
            raise FileFormatError(f"{path}, line {number}: not a JSON object")
        yield number, row


def _frame(path: Path, number: int, row: dict[str, Any]) -> Frame:
    where = f"{path}, line {number}"
    given = {k: str(v).strip() for k, v in row.items() if v is not None and str(v).strip()}
    unknown = sorted(set(given) - set(_KEYS))
    if unknown:
        raise FileFormatError(f"{where}: {unknown[0]!r} is not one of {', '.join(_KEYS)}")
    files: dict[str, Any] = {k: path.parent / given[k] for k in _PATHS if k in given}
    for file in files.values():
        if not file.exists():
            raise InputError(f"{where}: {file}: no such file; correct the path")
    if "image" not in files and "sparse" not in files:
        raise FileFormatError(f"{where}: has neither image nor sparse; give one")
    try:
        numbers: dict[str, Any] = {k: f(given[k]) for k, f in _NUMBERS.items() if k in given}
    except ValueError as error:
        raise FileFormatError(f"{where}: {one_line(error)}") from error
    protocol = find_protocol(given["protocol"]) if "protocol" in given else WHOLE
    name = given.get("name") or (files.get("image") or files["sparse"]).stem
    return Frame(name=name, protocol=protocol, **files, **numbers)
