"""PCD and PLY: a text header that names columns, followed by rows of text or bytes.

Own readers, because plyfile reads ASCII three times slower and allocates what a header claims, and
pypcd4 takes 0.7 s to import and decompresses to the size that the file claims.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import damaged, one_line

Rows = tuple[NDArray[np.float32], str]

_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}
_PLY_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16
_MOST_DIGITS = 18
"""Of a count; Python refuses to convert thousands of them."""


@dataclass(frozen=True, kw_only=True)
class _Column:
    name: str
    kind: str
    count: int = 1


def parse_pcd(path: Path, data: bytes) -> Rows:
    """Returns (N, 3) float32 x y z of a PCD file, ASCII or binary, and what was read.

    A point whose three coordinates are NaN is a beam without return, and left out.

    Args:
        path: Named in messages.
        data: Content of the file.

    Raises:
        FileFormatError: The file is damaged, compressed, or has no x, y or z.
    """
    header, body = _header(path, data, "PCD", b"DATA")
    entries = {words[0].upper(): words[1:] for words in header if not words[0].startswith("#")}
    missing = [k for k in ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA") if not entries.get(k)]
    if missing:
        raise damaged(path, "PCD", f"has no {missing[0]} in its header")
    names = entries["FIELDS"]
    counts = entries.get("COUNT", ["1"] * len(names))
    columns = [
        _Column(name=name, kind=f"{_PCD_KINDS.get(kind, '?')}{size}", count=_whole(path, count))
        for name, kind, size, count in zip(
            names, entries["TYPE"], entries["SIZE"], counts, strict=False
        )
    ]
    if not len(columns) == len(names) == len(entries["TYPE"]) == len(entries["SIZE"]):
        raise damaged(path, "PCD", "names another number of fields than it describes")
    number, stored = _whole(path, entries["POINTS"][0]), entries["DATA"][0].lower()
    if stored == "ascii":
        points = _from_text(path, "PCD", columns, number, body)
    elif stored == "binary":
        points = _from_bytes(path, "PCD", columns, number, body, "<")
    else:
        raise FileFormatError(
            f"{path} is a PCD with {stored} data; save it as binary or ascii"
            " (pcl_convert_pcd_ascii_binary does it)"
        )
    returned = ~np.isnan(points).all(axis=1)
    lost = int(len(points) - np.count_nonzero(returned))
    source = f"{stored} PCD" + (f", {lost:,} beams without return" if lost else "")
    if entries.get("VIEWPOINT", []) not in ([], ["0", "0", "0", "1", "0", "0", "0"]):
        source += ", its VIEWPOINT not applied"
    return points[returned], source


def parse_ply(path: Path, data: bytes) -> Rows:
    """Returns (N, 3) float32 x y z of the vertices of a PLY file, and what was read.

    Args:
        path: Named in messages.
        data: Content of the file, ASCII or binary.

    Raises:
        FileFormatError: The file is damaged, or its vertices have no x, y or z.
    """
    header, body = _header(path, data, "PLY", b"end_header")
    if header[0] != ["ply"] or len(header) < 2 or header[1][0] != "format":
        raise damaged(path, "PLY", "does not begin with ply and its format")
    first = next((i for i, words in enumerate(header) if words[0] == "element"), None)
    if first is None or header[first][1:2] != ["vertex"] or len(header[first]) != 3:
        raise FileFormatError(f"{path}: its first element is not vertex; save points first")
    number = _whole(path, header[first][2])
    columns = []
    for words in header[first + 1 :]:
        if words[0] == "element":
            break
        if words[0] == "property":
            if len(words) != 3 or words[1] not in _PLY_KINDS:
                raise FileFormatError(
                    f"{path}: property {' '.join(words[1:])!r} of a vertex is not one number;"
                    " leave it out"
                )
            columns.append(_Column(name=words[2], kind=_PLY_KINDS[words[1]]))
    stored = header[1][1] if len(header[1]) > 1 else ""
    if stored == "ascii":
        return _from_text(path, "PLY", columns, number, body, exact=False), "ascii PLY"
    if stored not in _PLY_ORDERS:
        raise damaged(path, "PLY", f"has the unknown format {stored!r}")
    order = _PLY_ORDERS[stored]
    return _from_bytes(path, "PLY", columns, number, body, order), "binary PLY"


def _header(path: Path, data: bytes, kind: str, last: bytes) -> tuple[list[list[str]], bytes]:
    """The words of each header line up to the one that begins with `last`, and what follows."""
    lines: list[list[str]] = []
    position = 0
    while position < min(len(data), _LONGEST_HEADER):
        end = data.find(b"\n", position)
        line = data[position : end if end >= 0 else len(data)]
        position = end + 1 if end >= 0 else len(data)
        words = line.decode("latin-1").split()
        if words:
            lines.append(words)
        if line.lstrip().startswith(last):
            return lines, data[position:]
    raise damaged(path, kind, f"has no header that ends with {last.decode()}")


def _from_bytes(
    path: Path, kind: str, columns: list[_Column], number: int, body: bytes, order: str
) -> NDArray[np.float32]:
    wanted = _xyz_columns(path, kind, columns)
    try:
        formats = [f"{order}{column.kind}" for column in columns]
        layout = np.dtype(
            {
                "names": [f"{i}" for i in range(len(columns))],
                "formats": [
                    (f, (c.count,)) if c.count != 1 else f
                    for f, c in zip(formats, columns, strict=True)
                ],
            }
        )
    except (TypeError, ValueError) as error:
        raise damaged(path, kind, f"describes its fields wrongly ({error})") from error
    if len(body) < number * layout.itemsize:
        raise damaged(
            path, kind, f"is cut short: {len(body) // layout.itemsize:,} of {number:,} points"
        )
    rows = np.frombuffer(body, layout, count=number)
    return _float32([rows[f"{index}"] for index in wanted])


def _from_text(
    path: Path, kind: str, columns: list[_Column], number: int, body: bytes, exact: bool = True
) -> NDArray[np.float32]:
    """With `exact`, every line is a point; a PLY may continue with faces, which are not read."""
    wanted = _xyz_columns(path, kind, columns)
    width = sum(column.count for column in columns)
    lines = [line for line in body.decode("latin-1").splitlines() if line.strip()]
    if len(lines) < number or (exact and len(lines) > number):
        raise damaged(path, kind, f"has {len(lines):,} lines for {number:,} points")
    try:
        table = np.loadtxt(lines[:number], np.float64, comments=None, ndmin=2) if number else None
    except ValueError as error:
        raise damaged(path, kind, f"has a line that is not made of numbers ({error})") from error
    if table is None:
        return np.empty((0, 3), np.float32)
    if table.shape[1] != width:
        raise damaged(path, kind, f"has {table.shape[1]} numbers in a line instead of {width}")
    starts = np.cumsum([0, *(column.count for column in columns)])
    return _float32([table[:, starts[index]] for index in wanted])


def _xyz_columns(path: Path, kind: str, columns: list[_Column]) -> list[int]:
    """Which columns are x, y and z."""
    names = [column.name.lower() for column in columns]
    for name in "xyz":
        if names.count(name) != 1 or columns[names.index(name)].count != 1:
            listing = one_line(", ".join(names))
            raise FileFormatError(f"{path}: a {kind} without one {name} ({listing}); add it")
    return [names.index(name) for name in "xyz"]


def _float32(columns: list[NDArray[Any]]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        return np.column_stack(columns).astype(np.float32)


def _whole(path: Path, text: str) -> int:
    if not text.isdecimal() or len(text) > _MOST_DIGITS:
        raise FileFormatError(
            f"{path}: {one_line(text)[:40]!r} in its header is no count; correct it"
        )
    return int(text)
