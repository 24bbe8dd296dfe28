"""Point clouds in files: scans of LiDARs in the formats they come in, and PLY as it is written.

The readers of PCD and PLY are own: plyfile, which is under the GPL, reads ASCII three times slower
and allocates what a header claims; pypcd4 takes 0.7 s to import and decompresses to the size that
the file claims.
"""

from __future__ import annotations

import io
import itertools
import shutil
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.file_bytes import damaged, one_line, read_bytes, read_rows
from pnpdepth_cli.io.formats import kind_of
from pnpdepth_cli.io.formats.array_files import parse_npy

_FIELD_COUNTS = (3, 4, 5, 6, 7, 8)
_BIN_SOURCES = {4: "KITTI scan", 5: "nuScenes scan"}
_SMALLEST = 1e-3  # numbers near 0 are alike
_AS_MUCH = 0.85  # of the variance that the best count explains; its divisors explain less
_LEAST_EXPLAINED = 0.03  # of the variance; numbers in any order have less
_PCD_TYPES = {k + n: k.lower() + n for k in "IUF" for n in "1248" if k + n not in ("F1", "F2")}
"""NumPy types by TYPE and SIZE of a PCD."""
_PLY_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}
_LONGEST_HEADER = 1 << 16
_MOST_COMPRESSED = 100
"""Times as many bytes as compressed ones; three bytes of LZF make at most 264."""

_MOST_DIGITS = 18
"""Most digits of a count; Python refuses to convert thousands of them."""

Points = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """A LiDAR scan as read from a file."""

    points: Points  # (N, 3) metres, x y z in the scanner's coordinates as stored, in file order
    source: str  # what was read, for a person


def read_scan(path: Path) -> ScanFile:
    """Returns the points of a .bin, a .npy of (N, 3 or more) floats, a .pcd, a .ply, or text.

    Args:
        path: The file; its suffix says the format.

    Raises:
        FileFormatError: The file is damaged or ambiguous.
    """
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise FileFormatError(f"{path} is not a scan; give a file of {', '.join(_READERS)}")
    data = read_bytes(path)
    kind = kind_of(data)
    if kind not in (None, "NPY"):
        raise FileFormatError(f"{path} is a {kind} file, not a scan; check what is given as scan")
    points, source = read(path, data)
    return ScanFile(points=points, source=source)


def _parse_bin(path: Path, data: bytes) -> tuple[Points, str]:
    fields = _fields_of_bin(path, data)
    if len(data) % (4 * fields):
        fact = f"{len(data):,} bytes are no multiple of {fields} float32 numbers a point"
        raise FileFormatError(f"{path}: {fact}; it is cut short, or points have other fields")
    points = np.frombuffer(data, "<f4").reshape(-1, fields)
    return _first_columns(points), _BIN_SOURCES.get(fields, f"scan of {fields} fields a point")


def _fields_of_bin(path: Path, data: bytes) -> int:
    """How many numbers a point has: those of one field are alike, those of two are not."""
    numbers = np.frombuffer(data, "<f4", len(data) // 4).astype(np.float64)
    numbers = np.where(np.isfinite(numbers), numbers, 0)
    # by sign, order of magnitude, and whether it is a whole number, such as the index of a laser
    size = np.log10(np.abs(numbers) + _SMALLEST)
    features = np.stack([np.sign(numbers), size, numbers == np.rint(numbers)])
    # beams without return say nothing: more zeros in a row than a point has numbers
    zeros = np.convolve(numbers == 0, np.ones(max(_FIELD_COUNTS) + 1), "same")[: len(numbers)]
    counted = zeros <= max(_FIELD_COUNTS)
    explained = {count: _explained_variance(features, counted, count) for count in _FIELD_COUNTS}
    most = max(explained.values())  # which multiples of the true count reach, too
    if most < _LEAST_EXPLAINED:
        fact = f"which of {', '.join(map(str, _FIELD_COUNTS))} numbers a point has"
        raise FileFormatError(f"{path} does not tell {fact}; save its x, y, z as NPY (N, 3)")
    return next(n for n, fraction in explained.items() if fraction >= _AS_MUCH * most)


def _explained_variance(
    features: NDArray[np.float64], counted: NDArray[np.bool_], count: int
) -> float:
    """Mean fraction 0…1 of the variance of features (F, N) that N modulo `count` explains."""
    rows = features.shape[1] // count
    fields = features[:, : rows * count].reshape(len(features), rows, count)
    weight = counted[: rows * count].reshape(rows, count).astype(np.float64)
    number = weight.sum(axis=0)
    if (number < 2).any():
        return 0.0
    mean = (fields * weight).sum(axis=1) / number
    within = ((fields - mean[:, None]) ** 2 * weight).sum(axis=1) / (number - 1)
    total = features[:, counted].var(axis=1)
    varies = total > 0
    fractions = 1 - (within * number).sum(axis=1)[varies] / number.sum() / total[varies]
    return float(fractions.mean()) if varies.any() else 0.0


def _parse_array(path: Path, data: bytes) -> tuple[Points, str]:
    """The first columns of (N, 3 or more) floats."""
    if kind_of(data) != "NPY":
        raise FileFormatError(f"{path} is not an NPY file; save it with numpy.save")
    array = parse_npy(path, data)
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind != "f":
        fact = f"holds {array.dtype} of shape {array.shape}"
        raise FileFormatError(f"{path} {fact}; a scan is (N, 3 or more) floats, x y z first")
    return _first_columns(array), "NPY scan"


Column = tuple[str, str, int]
"""Name, NumPy type and count of numbers of a field."""


def _parse_pcd(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z of a PCD, ASCII, binary or compressed."""
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
        (name, _PCD_TYPES.get(kind + size, f"?{size}"), _whole(path, count))
        for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True)
    ]
    number, stored = _whole(path, entries["POINTS"][0]), entries["DATA"][0].lower()
    if stored not in ("ascii", "binary", "binary_compressed"):
        raise FileFormatError(f"{path} is a PCD with {stored} data; save it as binary or ascii")
    if stored == "binary_compressed":
        body = _decompress_rows(path, columns, number, body)
    points = _xyz(path, "PCD", columns, number, body, None if stored == "ascii" else "<")
    return points, f"{stored} PCD"


def _decompress_rows(path: Path, columns: list[Column], number: int, body: bytes) -> bytes:
    """The rows of a compressed PCD: two sizes, then all numbers of each field, compressed."""
    sizes = [np.dtype(kind).itemsize * count for _, kind, count in columns if "?" not in kind]
    packed, claimed = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, 0)
    whole = len(sizes) == len(columns) and claimed == number * sum(sizes)
    if not whole or packed > len(body) - 8 or claimed > _MOST_COMPRESSED * (packed + 1):
        raise damaged(path, "PCD", "is cut short, or no compressed one")
    data = _lzf(body[8 : 8 + packed])
    if data is None or len(data) != claimed:
        raise damaged(path, "PCD", "cannot be decompressed")
    ends = np.cumsum([0, *sizes]) * number
    fields = [
        np.frombuffer(data, np.uint8, number * size, ends[index]).reshape(number, size)
        for index, size in enumerate(sizes)
    ]
    return np.concatenate(fields, axis=1).tobytes()


def _lzf(packed: bytes) -> bytes | None:
    """Decompresses LZF: literals, and copies of what is already there; None for other bytes."""
    out, rest = bytearray(), iter(packed)
    for control in rest:
        # A byte below 32 is followed by that many literals and one.
        if control < 32:
            out += bytes(itertools.islice(rest, control + 1))
            continue
        # Another has the length of a copy, less 2, in 3 bits (7: the next byte is added), and 13
        # bits of the distance back, less 1, in the rest and the next byte.
        length = (control >> 5) + 2
        if length == 9:
            length += next(rest, 0)
        start = len(out) - ((control & 31) << 8) - next(rest, 0) - 1
        if start < 0:
            return None
        copied = out[start : start + length]  # shorter where a copy repeats itself
        out += (copied * length)[:length]
    return bytes(out)


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
            raise FileFormatError(f"{path}: {' '.join(words)!r} of a vertex is not one number")
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
    return _first_columns(np.column_stack(values))


def _table(path: Path, kind: str, number: int, body: bytes, width: int) -> NDArray[np.float64]:
    """The numbers (N, width) of the first lines of text; a PLY may continue with faces."""
    if not number:
        return np.empty((0, width))
    most = min(number, len(body) // (2 * width) + 1)  # for which memory is taken
    try:
        table = np.loadtxt(io.BytesIO(body), comments=None, ndmin=2, max_rows=most)
    except ValueError as error:
        raise damaged(path, kind, f"has a line that is not made of numbers ({error})") from error
    if table.shape != (number, width):
        rows, columns = table.shape
        fact = f"has {rows:,} lines of {columns} numbers instead of {number:,} of {width}"
        raise damaged(path, kind, fact)
    return table


def _whole(path: Path, text: str) -> int:
    if not text.isdecimal() or len(text) > _MOST_DIGITS:
        raise FileFormatError(f"{path}: {one_line(text)[:40]!r} in its header is no count")
    return int(text)


def _parse_text(path: Path, data: bytes) -> tuple[Points, str]:
    """The first numbers of lines of text."""
    return _first_columns(read_rows(path, data)[0]), "text scan"


def _first_columns(rows: NDArray[np.generic]) -> Points:
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(rows[:, :3], np.float32)


_READERS: dict[str, Callable[[Path, bytes], tuple[Points, str]]] = {
    ".bin": _parse_bin,
    ".npy": _parse_array,
    ".pcd": _parse_pcd,
    ".ply": _parse_ply,
    ".csv": _parse_text,
    ".txt": _parse_text,
}

_PROPERTIES = {
    "points": ("<f4", ["float x", "float y", "float z"]),
    "normals": ("<f4", ["float nx", "float ny", "float nz"]),
    "colours": ("|u1", ["uchar red", "uchar green", "uchar blue"]),
}
"""NumPy type and properties of what a PLY has of each point."""

Part = tuple[Points, Points | None, NDArray[np.uint8] | None]
"""(N, 3) points; (N, 3) unit normals, 0 where unknown, or None; (N, 3) colours 0…255, or None."""


def write_cloud(path: Path, parts: Iterable[Part]) -> int:
    """Writes a cloud whole or not at all.

    Args:
        path: The file; it is replaced.
        parts: Parts of the cloud, one after another.

    Returns:
        The number of points.

    Raises:
        OutputError: The file cannot be written.
    """
    count, properties = 0, _PROPERTIES["points"][1]
    with atomic_path(path) as temporary, TemporaryFile(dir=temporary.parent) as body:
        for part in parts:
            columns = {
                name: values
                for name, values in zip(_PROPERTIES, part, strict=True)
                if values is not None
            }
            rows = np.empty(len(part[0]), [(name, _PROPERTIES[name][0], 3) for name in columns])
            for name, values in columns.items():
                rows[name] = values
            body.write(rows.tobytes())
            count += len(rows)
            properties = [each for name in columns for each in _PROPERTIES[name][1]]
        # The header has the number of points, which is known last.
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
        header += [*(f"property {each}" for each in properties), "end_header\n"]
        body.seek(0)
        with temporary.open("wb") as file:
            file.write("\n".join(header).encode())
            shutil.copyfileobj(body, file, 1 << 20)
    return count
