"""LiDAR scans: points of x, y, z metres in the scanner's frame, from the formats they come in.

The readers of PCD and PLY are own: plyfile reads ASCII three times slower and allocates what a
header claims, and pypcd4 takes 0.7 s to import and decompresses to the size that the file claims.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, NoPointsError
from pnpdepth_cli.io.file_bytes import damaged, one_line, read_bytes
from pnpdepth_cli.io.formats import kind_of
from pnpdepth_cli.io.formats.arrays import parse_npy

_FARTHEST_M = 1e5
_KITTI_FIELDS, _NUSCENES_FIELDS = 4, 5  # x, y, z, reflectance; nuScenes adds the laser's index
_SAMPLE = 4096
"""Rows that tell the number of fields; checking all takes twice as long as reading them."""

_NEARLY_ALL = 0.95
"""Fraction of points; read with the wrong number of fields, at most half of them look right."""

_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}
_PLY_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}
_LONGEST_HEADER = 1 << 16
_MOST_DIGITS = 18
"""Of a count; Python refuses to convert thousands of them."""

Points = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """A LiDAR scan as read from a file."""

    points: Points  # (N, 3) metres, x y z in the scanner's frame; all finite, in file order
    source: str  # what was read, for a person


def read_scan(path: Path) -> ScanFile:
    """Returns the points of a KITTI or nuScenes .bin, .npy (N, 3 or more columns), .pcd or .ply.

    Args:
        path: The file; its suffix says the format.

    Raises:
        FileFormatError: The file is damaged, ambiguous, or holds points that are no numbers.
        NoPointsError: It holds no point.
    """
    suffix = path.suffix.lower()
    if suffix not in SCAN_SUFFIXES:
        raise FileFormatError(f"{path} is not a scan; give a file of {', '.join(SCAN_SUFFIXES)}")
    data = read_bytes(path)
    kind = kind_of(data)
    if kind not in (None, "NPY"):
        raise FileFormatError(f"{path} is a {kind} file, not a scan; check what is given as scan")
    if suffix == ".bin":
        points, source = _parse_bin(path, data)
    else:
        points, source = _READERS[suffix](path, data)
    if not len(points):
        raise NoPointsError(f"{path} holds no point; give a scan with points")
    if not np.isfinite(points).all():
        bad = ~np.isfinite(points).all(axis=1)
        raise FileFormatError(
            f"{path}: {int(bad.sum()):,} of {len(points):,} points have no finite coordinates"
            f" (the first is number {int(np.argmax(bad)) + 1:,}); remove them"
        )
    if np.abs(points).max() > _FARTHEST_M:
        raise FileFormatError(
            f"{path}: a coordinate of {np.abs(points).max():.3g} m is none of a scan; its numbers"
            " are probably not stored as the format says"
        )
    return ScanFile(points=points, source=source)


def _parse_bin(path: Path, data: bytes) -> tuple[Points, str]:
    fields = _fields_of_bin(path, data)
    if len(data) % (4 * fields):
        raise FileFormatError(
            f"{path}: {len(data):,} bytes are not a multiple of {4 * fields} ({fields} float32"
            " numbers a point); it is cut short, or its points have another number of fields"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, fields)
    names = {_KITTI_FIELDS: "KITTI scan", _NUSCENES_FIELDS: "nuScenes scan"}
    source = names.get(fields, f"scan of {fields} fields a point")
    return np.ascontiguousarray(points[:, :3], np.float32), source


def _fields_of_bin(path: Path, data: bytes) -> int:
    """4 for KITTI, 5 for nuScenes, by name and size, and by content where both sizes fit."""
    if path.name.lower().endswith(".pcd.bin"):  # nuScenes' own name
        return _NUSCENES_FIELDS
    by_size = [n for n in (_KITTI_FIELDS, _NUSCENES_FIELDS) if len(data) % (4 * n) == 0]
    if by_size == [_KITTI_FIELDS]:
        return _KITTI_FIELDS
    numbers = np.frombuffer(data, "<f4", len(data) // 4)
    by_content = [n for n in by_size if _looks_like_scan(numbers.reshape(-1, n))]
    if len(by_content) == 1:
        return by_content[0]
    if _KITTI_FIELDS not in by_size:
        raise FileFormatError(
            f"{path}: {len(data):,} bytes are not a multiple of 16 (KITTI: x, y, z and reflectance"
            " as float32) nor of 20 (nuScenes); it is cut short or no such scan"
        )
    raise FileFormatError(
        f"{path} may hold 4 numbers a point (KITTI) or 5 (nuScenes); save its x, y, z as NPY (N, 3)"
    )


def _looks_like_scan(rows: NDArray[np.float32]) -> bool:
    """True if nearly all rows of (N, 4 or 5), or of a sample of them, are plausible points.

    Coordinates are not too far, reflectance is not negative, and a fifth column holds whole numbers
    0…255, the index of a laser.
    """
    rows = rows[:: -(-len(rows) // _SAMPLE)]
    with np.errstate(invalid="ignore"):
        near = (np.abs(rows[:, :3]) <= _FARTHEST_M).all(axis=1) & (rows[:, 3] >= 0)
        laser = rows[:, 4:]
        numbered = ((laser >= 0) & (laser < 256) & (laser == np.floor(laser))).all(axis=1)
    return bool(np.mean(near & numbered) >= _NEARLY_ALL)


def _parse_array(path: Path, data: bytes) -> tuple[Points, str]:
    """The first columns of (N, 3 or more) floats."""
    if kind_of(data) != "NPY":
        raise FileFormatError(f"{path} is not an NPY file; save it with numpy.save")
    array = parse_npy(path, data)
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind != "f":
        shape = "×".join(str(n) for n in array.shape)
        raise FileFormatError(
            f"{path} holds {array.dtype} of shape {shape}; a scan is float, one point a row, with"
            " x y z in the first columns"
        )
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array[:, :3], np.float32), "NPY scan"


Column = tuple[str, str, int]
"""Name, NumPy type and count of numbers of a field."""


def _parse_pcd(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z of a PCD, ASCII or binary, without beams that have no return: all three are NaN."""
    header, body = _header(path, data, "PCD", b"DATA")
    entries = {words[0].upper(): words[1:] for words in header if not words[0].startswith("#")}
    missing = [k for k in ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA") if not entries.get(k)]
    if missing:
        raise damaged(path, "PCD", f"has no {missing[0]} in its header")
    names, kinds, sizes = entries["FIELDS"], entries["TYPE"], entries["SIZE"]
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(kinds) == len(sizes) == len(counts):
        raise damaged(path, "PCD", "names another number of fields than it describes")
    columns = [
        (name, f"{_PCD_KINDS.get(kind, '?')}{size}", _whole(path, count))
        for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True)
    ]
    number, stored = _whole(path, entries["POINTS"][0]), entries["DATA"][0].lower()
    if stored not in ("ascii", "binary"):
        raise FileFormatError(
            f"{path} is a PCD with {stored} data; save it as binary or ascii"
            " (pcl_convert_pcd_ascii_binary does it)"
        )
    points = _xyz(path, "PCD", columns, number, body, "<" if stored == "binary" else None)
    returned = ~np.isnan(points).all(axis=1)
    lost = int(len(points) - np.count_nonzero(returned))
    source = f"{stored} PCD" + (f", {lost:,} beams without return" if lost else "")
    if entries.get("VIEWPOINT", []) not in ([], ["0", "0", "0", "1", "0", "0", "0"]):
        source += ", its VIEWPOINT not applied"
    return points[returned], source


def _parse_ply(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z of the vertices of a PLY, ASCII or binary."""
    header, body = _header(path, data, "PLY", b"end_header")
    if header[0] != ["ply"] or header[1][0] != "format":
        raise damaged(path, "PLY", "does not begin with ply and its format")
    elements = [i for i, words in enumerate(header) if words[0] == "element"]
    if not elements or header[elements[0]][1:2] != ["vertex"] or len(header[elements[0]]) != 3:
        raise FileFormatError(f"{path}: its first element is not vertex; save points first")
    columns: list[Column] = []
    for words in header[slice(*[*elements, len(header)][:2])]:
        if words[0] != "property":
            continue
        if len(words) != 3 or words[1] not in _PLY_KINDS:
            raise FileFormatError(
                f"{path}: property {' '.join(words[1:])!r} of a vertex is not one number; leave it"
                " out"
            )
        columns.append((words[2], _PLY_KINDS[words[1]], 1))
    stored = header[1][1] if len(header[1]) > 1 else ""
    if stored not in _PLY_ORDERS:
        raise damaged(path, "PLY", f"has the unknown format {stored!r}")
    number = _whole(path, header[elements[0]][2])
    points = _xyz(path, "PLY", columns, number, body, _PLY_ORDERS[stored])
    return points, "ascii PLY" if stored == "ascii" else "binary PLY"


def _header(path: Path, data: bytes, kind: str, last: bytes) -> tuple[list[list[str]], bytes]:
    """The words of each header line up to the one that begins with `last`, and what follows."""
    lines: list[list[str]] = []
    stream = io.BytesIO(data)
    while stream.tell() < min(len(data), _LONGEST_HEADER):
        line = stream.readline()
        words = line.decode("latin-1").split()
        if words:
            lines.append(words)
        if line.lstrip().startswith(last):
            return lines, data[stream.tell() :]
    raise damaged(path, kind, f"has no header that ends with {last.decode()}")


def _xyz(
    path: Path, kind: str, columns: list[Column], number: int, body: bytes, order: str | None
) -> Points:
    """x y z of rows of these columns, in bytes of this order, or in text where it is None."""
    names = [name.lower() for name, _, _ in columns]
    counts = [count for _, _, count in columns]
    for name in "xyz":
        if names.count(name) != 1 or counts[names.index(name)] != 1:
            listing = one_line(", ".join(names))
            raise FileFormatError(f"{path}: a {kind} without one {name} ({listing}); add it")
    wanted = [names.index(name) for name in "xyz"]
    if order is None:
        table = _table(path, kind, number, body, sum(counts))
        values = [table[:, sum(counts[:index])] for index in wanted]
    else:
        try:
            layout = np.dtype([(f"f{i}", order + t, n) for i, (_, t, n) in enumerate(columns)])
        except (TypeError, ValueError) as error:
            raise damaged(path, kind, f"describes its fields wrongly ({error})") from error
        if len(body) < number * layout.itemsize:
            fact = f"is cut short: {len(body) // layout.itemsize:,} of {number:,} points"
            raise damaged(path, kind, fact)
        rows = np.frombuffer(body, layout, count=number)
        values = [rows[f"f{index}"] for index in wanted]
    with np.errstate(over="ignore"):
        return np.column_stack(values).astype(np.float32)


def _table(path: Path, kind: str, number: int, body: bytes, width: int) -> NDArray[np.float64]:
    """The numbers (N, width) of lines of text; a PLY may continue with faces, a PCD not."""
    lines = [line for line in body.decode("latin-1").splitlines() if line.strip()]
    if len(lines) < number or (kind == "PCD" and len(lines) > number):
        raise damaged(path, kind, f"has {len(lines):,} lines for {number:,} points")
    if not number:
        return np.empty((0, width))
    try:
        table = np.loadtxt(lines[:number], np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise damaged(path, kind, f"has a line that is not made of numbers ({error})") from error
    if table.shape[1] != width:
        raise damaged(path, kind, f"has {table.shape[1]} numbers in a line instead of {width}")
    return table


def _whole(path: Path, text: str) -> int:
    if not text.isdecimal() or len(text) > _MOST_DIGITS:
        raise FileFormatError(
            f"{path}: {one_line(text)[:40]!r} in its header is no count; correct it"
        )
    return int(text)


_READERS: dict[str, Callable[[Path, bytes], tuple[Points, str]]] = {
    ".npy": _parse_array,
    ".pcd": _parse_pcd,
    ".ply": _parse_ply,
}

SCAN_SUFFIXES = (".bin", *_READERS)
"""What `read_scan` can read."""
