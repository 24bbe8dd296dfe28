"""Point clouds in files: scans of LiDARs in the formats they come in, and PLY as it is written.

The readers of PCD and PLY are own: plyfile, which is under the GPL, reads ASCII three times slower
and allocates what a header claims; pypcd4 takes 0.7 s to import and decompresses to the size that
the file claims.
"""

from __future__ import annotations

import io
import itertools
import re
import shutil
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.file_bytes import damaged, read_bytes, read_rows
from pnpdepth_cli.io.formats import kind_of, parse_npy

_FIELD_COUNTS = (3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 20)  # the last are of painted points
_USUAL = 8  # fields a point, at most
_LEAST_ROWS = 100  # points that a file must have to be recognised as one of more fields
_BIN_SOURCES = {4: "KITTI scan", 5: "nuScenes scan"}
_EXACT_M = 1e-3  # error of coordinates that counts
_EARTH_M = 1e8  # larger than the coordinates of any place on earth
_COLMAP_MAP = re.compile(rb"\d{1,6}&\d{1,6}&\d&")  # width, height, channels
_SMALLEST = 1e-3  # numbers near 0 are alike
_AS_MUCH = 0.85  # of the variance that the best count explains; its divisors explain less
_LEAST_EXPLAINED = 0.03  # of the variance; numbers in any order have less
_PCD_TYPES = {k + n: k.lower() + n for k in "IUF" for n in "1248" if k + n not in ("F1", "F2")}
"""NumPy types by TYPE and SIZE of a PCD."""
_PLY_KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
}  # fmt: skip
_PLY_KINDS |= {np.dtype(kind).name: kind for kind in _PLY_KINDS.values()}  # such as float32
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}
_LONGEST_HEADER = 1 << 16
_MOST_COMPRESSED = 100
"""Times as many bytes as compressed ones; three bytes of LZF make at most 264."""

Points = NDArray[np.float32] | NDArray[np.float64]


def read_scan(path: Path) -> tuple[Points, str]:
    """Returns the points of a .bin, a .npy of (N, 3 or more) floats, a .pcd, a .ply, or text.

    Args:
        path: The file; its suffix says the format.

    Returns:
        (N, 3) metres, x y z in the scanner's coordinates as stored, in file order; and what was
        read, for a person.

    Raises:
        InputError: The file is damaged or ambiguous.
    """
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(f"{path} is not a scan; give a file of {', '.join(_READERS)}")
    data = read_bytes(path)
    kind = kind_of(data)
    if kind not in (None, "NPY"):
        raise InputError(f"{path} is a {kind} file, not a scan; check what is given as scan")
    return read(path, data)


def check_no_colmap_map(path: Path, data: bytes) -> None:
    """Raises InputError for a depth map of COLMAP's dense reconstruction, which is .bin, too."""
    if _COLMAP_MAP.match(data) is not None:
        raise InputError(
            f"{path} is a map of COLMAP's dense reconstruction; save its depth as NPY (H, W), by"
            " read_array of COLMAP's scripts"
        )


def _parse_bin(path: Path, data: bytes) -> tuple[Points, str]:
    """The first columns of float32 numbers, of which a point has as many as the content tells."""
    check_no_colmap_map(path, data)
    fields = _fields_of_bin(path, data)
    if len(data) % (4 * fields):
        raise InputError(
            f"{path}: {len(data):,} bytes are no multiple of {fields} float32 numbers a point; it"
            " is cut short, or points have other fields: save its x, y, z as NPY (N, 3)"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, fields)
    return _first_columns(points), _BIN_SOURCES.get(fields, f"scan of {fields} fields a point")


def _fields_of_bin(path: Path, data: bytes) -> int:
    """How many numbers a point has: those of one field are alike, those of two are not."""
    numbers = np.frombuffer(data, "<f4", len(data) // 4).astype(np.float64)
    numbers = np.where(np.isfinite(numbers), numbers, 0)
    # Alike by sign, order of magnitude, and whether it is a whole number, such as a laser's index.
    size = np.log10(np.abs(numbers) + _SMALLEST)
    features = np.stack([np.sign(numbers), size, numbers == np.rint(numbers)])
    # Beams without return say nothing: more zeros in a row than a point has numbers.
    most_fields = max(_FIELD_COUNTS)
    zeros = np.convolve(numbers == 0, np.ones(most_fields + 1), "same")[: len(numbers)]
    masked = np.ma.array(features, mask=np.broadcast_to(zeros > most_fields, features.shape))
    # What the position in a point explains of these, by how many numbers a point would have.
    counts = [n for n in _FIELD_COUNTS if n <= _USUAL or len(numbers) >= _LEAST_ROWS * n]
    explained = {count: _explained_variance(masked, count) for count in counts}
    most = max(explained.values())
    if most < _LEAST_EXPLAINED:
        raise InputError(
            f"{path} does not tell which of {', '.join(map(str, _FIELD_COUNTS))} numbers a point"
            " has; save its x, y, z as NPY (N, 3)"
        )
    # Multiples of the true count explain as much, so the first one is it.
    return next(n for n, fraction in explained.items() if fraction >= _AS_MUCH * most)


def _explained_variance(
    features: np.ma.MaskedArray[tuple[int, ...], np.dtype[np.float64]], count: int
) -> float:
    """Mean fraction 0…1 of the variance of features (F, N) that N modulo `count` explains."""
    rows = features.shape[1] // count
    fields = features[:, : rows * count].reshape(len(features), rows, count)
    number = fields.count(axis=1)
    if (number < 2).any():
        return 0.0
    within = (fields.var(axis=1, ddof=1) * number).sum(axis=1) / number.sum(axis=1)
    # a feature that does not vary is masked
    return float(np.ma.filled((1 - within / features.var(axis=1)).mean(), 0))


def _parse_array(path: Path, data: bytes) -> tuple[Points, str]:
    """The first columns of (N, 3 or more) floats."""
    if kind_of(data) != "NPY":
        raise InputError(f"{path} is not an NPY file; save it with numpy.save")
    array = parse_npy(path, data)
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind != "f":
        raise InputError(
            f"{path} holds {array.dtype} of shape {array.shape}; a scan is (N, 3 or more) floats,"
            " x y z first"
        )
    return _first_columns(array), "NPY scan"


Column = tuple[str, str, int]
"""Name, NumPy type and count of numbers of a field."""


def _parse_pcd(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z of a PCD, ASCII, binary or compressed."""
    try:
        header, body = _header(data, b"DATA")
        entries = {words[0].upper(): words[1:] for words in header}
        # The fields, and how they are stored.
        names, kinds, sizes = (entries[entry] for entry in ("FIELDS", "TYPE", "SIZE"))
        fields = zip(names, kinds, sizes, entries.get("COUNT", ["1"] * len(names)), strict=True)
        columns = [(name, _PCD_TYPES[kind + size], int(n)) for name, kind, size, n in fields]
        number = int(entries["POINTS"][0])
        stored = entries["DATA"][0].lower()
        order = {"ascii": None, "binary": "<", "binary_compressed": "<"}[stored]
        # The rows.
        if stored == "binary_compressed":
            body = _decompress_rows(columns, number, body)
        return _xyz(columns, number, body, order), f"{stored} PCD"
    except (LookupError, ValueError) as error:
        raise damaged(path, "PCD", f"cannot be read ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    """What is wrong with a file, for a person."""
    if isinstance(error, KeyError):
        return f"its header lacks, or has an unknown, {error}"
    return "its header is incomplete" if isinstance(error, LookupError) else str(error)


def _decompress_rows(columns: list[Column], number: int, body: bytes) -> bytes:
    """The rows of a compressed PCD: two sizes, then all numbers of each field, compressed."""
    sizes = [np.dtype(kind).itemsize * count for _, kind, count in columns]
    packed, claimed = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, -1)
    is_whole = claimed == number * sum(sizes) and packed <= len(body) - 8
    if not is_whole or min(sizes, default=-1) < 0 or claimed > _MOST_COMPRESSED * (packed + 1):
        raise ValueError("it is cut short, or no compressed one")
    data = _lzf(body[8 : 8 + packed])
    if len(data) != claimed:
        raise ValueError("it cannot be decompressed")
    # Field after field, put beside each other.
    fields = np.split(np.frombuffer(data, np.uint8), number * np.cumsum(sizes[:-1]))
    columns_of_bytes = [
        field.reshape(number, size) for field, size in zip(fields, sizes, strict=True)
    ]
    return np.concatenate(columns_of_bytes, axis=1).tobytes()


def _lzf(packed: bytes) -> bytes:
    """Decompresses LZF: literals, and copies of what is already there."""
    out = bytearray()
    rest = iter(packed)
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
            raise ValueError("it cannot be decompressed")
        copied = out[start : start + length]  # shorter where a copy repeats itself
        out += (copied * length)[:length]
    return bytes(out)


def _parse_ply(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z of the vertices of a PLY, ASCII or binary."""
    try:
        header, body = _header(data, b"end_header")
        marks = [i for i, words in enumerate(header) if words[0] in ("element", "end_header")]
        if len(marks) < 2 or len(header[marks[0]]) != 3:
            raise ValueError("its header has no element of so many points")
        if header[0] != ["ply"] or header[1][0] != "format":
            raise ValueError("its header does not begin with ply and format")
        _, element, number = header[marks[0]]
        stored = header[1][1]
        if element != "vertex":
            raise ValueError("its first element is not vertex; save points first")
        # The properties of the first element, up to the next mark.
        of_vertex = header[marks[0] : marks[1]]
        properties = [words for words in of_vertex if words[0] == "property"]
        columns = [(name, _PLY_KINDS[kind], 1) for _, kind, name in properties]
        points = _xyz(columns, int(number), body, _PLY_ORDERS[stored])
    except (LookupError, ValueError) as error:
        raise damaged(path, "PLY", f"cannot be read ({_reason(error)})") from error
    return points, "ascii PLY" if stored == "ascii" else "binary PLY"


def _header(data: bytes, last: bytes) -> tuple[list[list[str]], bytes]:
    """The words of each header line up to the one that begins with `last`, and what follows."""
    lines: list[list[str]] = []
    stream = io.BytesIO(data)
    while stream.tell() < min(len(data), _LONGEST_HEADER):
        line = stream.readline()
        if words := line.decode("latin-1").split():
            lines.append(words)
        if line.lstrip().startswith(last):
            return lines, data[stream.tell() :]
    raise ValueError(f"no header that ends with {last.decode()}")


def _xyz(columns: list[Column], number: int, body: bytes, order: str | None) -> Points:
    """x y z of rows of these columns, in bytes of this order, or in text where it is None."""
    names = [name.lower() for name, _, _ in columns]
    counts = [count for _, _, count in columns]
    for name in "xyz":
        if names.count(name) != 1 or counts[names.index(name)] != 1:
            raise ValueError(f"there is not one {name} among {', '.join(names)}")
    if not number:
        return np.empty((0, 3), np.float32)
    if not 0 <= number * sum(counts) <= len(body):  # each number has a byte at least
        raise ValueError(f"it claims {number:,} points in {len(body):,} bytes")
    fields = [(f"f{i}", order + t if order else "f8", (n,)) for i, (_, t, n) in enumerate(columns)]
    layout = np.dtype(fields)
    if order is None:  # a PLY may continue with faces
        rows = np.loadtxt(io.BytesIO(body), layout, comments=None, ndmin=1, max_rows=number)
    else:
        rows = np.frombuffer(body, layout, min(number, len(body) // layout.itemsize))
    if len(rows) < number:
        raise ValueError(f"it is cut short: {len(rows):,} of {number:,} points")
    return _first_columns(np.hstack([rows[f"f{names.index(name)}"] for name in "xyz"]))


def _parse_text(path: Path, data: bytes) -> tuple[Points, str]:
    """The first numbers of lines of text."""
    return _first_columns(read_rows(path, data)[0]), "text scan"


def _first_columns(rows: NDArray[np.generic]) -> Points:
    """x y z; in 64 bits where 32 would round them by more than a millimetre, as those of UTM."""
    stored = rows[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        single = np.ascontiguousarray(stored, np.float32)
        if stored.dtype != np.float64:
            return single
        xyz = np.asarray(stored, np.float64)
        known = np.isfinite(xyz) & (np.abs(xyz) < _EARTH_M)
        rounded = known & (np.abs(single - xyz) > _EXACT_M)
    return np.ascontiguousarray(xyz) if rounded.sum() > known.sum() / 4 else single


_READERS: dict[str, Callable[[Path, bytes], tuple[Points, str]]] = {
    ".bin": _parse_bin,
    ".npy": _parse_array,
    ".pcd": _parse_pcd,
    ".ply": _parse_ply,
    ".csv": _parse_text,
    ".txt": _parse_text,
}

_PROPERTIES = (
    ("<f4", ["float x", "float y", "float z"]),
    ("<f4", ["float nx", "float ny", "float nz"]),
    ("|u1", ["uchar red", "uchar green", "uchar blue"]),
)
"""NumPy type and properties of each value of a `Part`."""

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
    count = 0
    _, properties = _PROPERTIES[0]  # of a cloud without parts
    with atomic_path(path) as temporary, TemporaryFile(dir=temporary.parent) as body:
        for cloud in parts:
            # The values that this cloud has, point after point.
            properties = []
            columns = []
            for values, (kind, names) in zip(cloud, _PROPERTIES, strict=True):
                if values is not None:
                    columns.append(np.ascontiguousarray(values, kind).view(np.uint8))
                    properties += names
            body.write(np.hstack(columns).tobytes())
            count += len(cloud[0])
        # The header has the number of points, which is known last.
        header = [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {count}",
            *(f"property {name}" for name in properties),
            "end_header\n",
        ]
        body.seek(0)
        with temporary.open("wb") as file:
            file.write("\n".join(header).encode())
            shutil.copyfileobj(body, file, 1 << 20)
    return count
