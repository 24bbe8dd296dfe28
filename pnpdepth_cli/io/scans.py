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

_FIELD_COUNTS = (3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 20)
"""How many numbers a point of a .bin may have; the last are of points with scores of classes."""
_USUAL = 8  # numbers of a point, at most; more are believed only of a file of `_LEAST_ROWS`
_LEAST_ROWS = 100  # points
_BIN_SOURCES = {4: "KITTI scan", 5: "nuScenes scan"}
_EXACT_M = 1e-3  # error of a coordinate from which on 64 bits are kept
_MANY_ROUNDED = 0.25  # fraction of the coordinates with such an error
_EARTH_M = 1e8  # larger than the coordinates of any place on earth
_COLMAP_MAP = re.compile(rb"\d{1,6}&\d{1,6}&\d&")  # width, height, channels
_SMALLEST = 1e-3  # numbers nearer to 0 are of one order of magnitude
_AS_MUCH = 0.85  # of the variance that the best count explains; its divisors explain less
_LEAST_EXPLAINED = 0.03  # fraction of the variance; numbers in any order have less
_PCD_TYPES = {
    "I1": "i1", "I2": "i2", "I4": "i4", "I8": "i8",
    "U1": "u1", "U2": "u2", "U4": "u4", "U8": "u8",
    "F4": "f4", "F8": "f8",
}  # fmt: skip
"""NumPy types by TYPE and SIZE of a PCD."""
_PLY_KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
}  # fmt: skip
_PLY_KINDS |= {np.dtype(kind).name: kind for kind in _PLY_KINDS.values()}  # such as float32
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}
"""Byte orders by the format of a PLY; None for text."""
_LONGEST_HEADER = 1 << 16  # bytes of a PCD or PLY
_MOST_COMPRESSED = 100
"""Times as many bytes as compressed ones; three bytes of LZF make at most 264."""
_PCD_SIZES = struct.Struct("<II")
"""Bytes of a compressed PCD's body, compressed and not, which are in front of it."""
_BLOCK_BYTES = 1 << 20  # that are copied at once

Points = NDArray[np.float32] | NDArray[np.float64]


def read_scan(path: Path) -> tuple[Points, str]:
    """Returns the points of a .bin, a .npy of (N, 3 or more) floats, a .pcd, a .ply, or text.

    Args:
        path: The file; its suffix says the format.

    Returns:
        (N, 3) metres, x y z in the scanner's coordinates as stored, in file order; and what was
        read, for a person.

    Raises:
        InputError: The file is missing, damaged, no scan, or ambiguous.
    """
    parse = _PARSERS.get(path.suffix.lower())
    if parse is None:
        raise InputError(f"{path} is not a scan; give a file of {', '.join(_PARSERS)}")
    data = read_bytes(path)
    kind = kind_of(data)
    if kind not in (None, "NPY"):
        raise InputError(f"{path} is a {kind} file, not a scan; check what is given as scan")
    return parse(path, data)


def check_no_colmap_map(path: Path, data: bytes) -> None:
    """Raises InputError for a depth map of COLMAP's dense reconstruction, which is .bin, too.

    Args:
        path: The file, for messages.
        data: Content of the file.
    """
    if _COLMAP_MAP.match(data) is not None:
        raise InputError(
            f"{path} is a map of COLMAP's dense reconstruction; save its depth as NPY (H, W), by"
            " read_array of COLMAP's scripts"
        )


def _parse_bin(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z of a file of float32 numbers, and what was read, for a person.

    How many numbers a point has, x y z first, is found in the content.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The content is of no such points, or does not tell how many numbers they have.
    """
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
    """How many numbers a point of a .bin has, which no such file states.

    Numbers of one field, such as all z, are alike, and those of two fields are not. So the count
    is right if the position of a number in its point explains much of how numbers differ.

    Args:
        path: The file, for messages.
        data: Content of the file, float32 numbers point after point.

    Raises:
        InputError: No count explains much.
    """
    numbers = np.frombuffer(data, "<f4", len(data) // 4).astype(np.float64)
    numbers = np.where(np.isfinite(numbers), numbers, 0)
    # (3, N) what makes numbers alike: sign, order of magnitude, and whether they are whole, as the
    # index of a laser is.
    magnitude = np.log10(np.abs(numbers) + _SMALLEST)
    features = np.stack([np.sign(numbers), magnitude, numbers == np.rint(numbers)])
    # Beams without return say nothing: more zeros in a row than a point has numbers.
    most_fields = max(_FIELD_COUNTS)
    zeros_around = np.convolve(numbers == 0, np.ones(most_fields + 1), "same")[: len(numbers)]
    is_empty = np.broadcast_to(zeros_around > most_fields, features.shape)
    masked = np.ma.array(features, mask=is_empty)
    # What the position in a point explains, by the number of fields that a point would have.
    counts = [
        count for count in _FIELD_COUNTS if count <= _USUAL or len(numbers) >= _LEAST_ROWS * count
    ]
    explained = {count: _explained_variance(masked, count) for count in counts}
    most = max(explained.values())
    if most < _LEAST_EXPLAINED:
        raise InputError(
            f"{path} does not tell which of {', '.join(map(str, _FIELD_COUNTS))} numbers a point"
            " has; save its x, y, z as NPY (N, 3)"
        )
    # Multiples of the true count explain as much as it does, so the smallest is right.
    return next(count for count, fraction in explained.items() if fraction >= _AS_MUCH * most)


def _explained_variance(
    features: np.ma.MaskedArray[tuple[int, ...], np.dtype[np.float64]], count: int
) -> float:
    """The fraction of the variance of features that a number's position in its point explains.

    Args:
        features: (F, N) features of N successive numbers; those that say nothing are masked.
        count: How many numbers a point would have.

    Returns:
        Mean over the features, at most 1; 0 if a position has fewer than two numbers.
    """
    points = features.shape[1] // count
    by_position = features[:, : points * count].reshape(len(features), points, count)
    sizes = by_position.count(axis=1)
    if (sizes < 2).any():
        return 0.0
    # The variance that is left among the numbers at one position, on average.
    within = (by_position.var(axis=1, ddof=1) * sizes).sum(axis=1) / sizes.sum(axis=1)
    # NumPy masks the quotient of a feature that does not vary, so the mean leaves it out.
    return float(np.ma.filled((1 - within / features.var(axis=1)).mean(), 0))


def _parse_array(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z of an NPY file of (N, 3 or more) floats, and what was read, for a person.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The file is damaged, or holds no such floats.
    """
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
    """x y z of a PCD, ASCII, binary or compressed, and what was read, for a person.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The file is damaged, or has no x, y and z.
    """
    try:
        header, body = _split_header(data, b"DATA")
        entries = {words[0].upper(): words[1:] for words in header}
        # The fields, and how they are stored.
        names, kinds, sizes = (entries[entry] for entry in ("FIELDS", "TYPE", "SIZE"))
        counts = entries.get("COUNT", ["1"] * len(names))
        columns = [
            (name, _PCD_TYPES[kind + size], int(count))
            for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True)
        ]
        point_count = int(entries["POINTS"][0])
        storage = entries["DATA"][0].lower()
        order = {"ascii": None, "binary": "<", "binary_compressed": "<"}[storage]
        # The rows.
        if storage == "binary_compressed":
            body = _decompress_rows(columns, point_count, body)
        return _xyz(columns, point_count, body, order), f"{storage} PCD"
    except (LookupError, ValueError) as error:  # of a header or a row that is not as it should be
        raise damaged(path, "PCD", f"cannot be read ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    """What is wrong with a PCD or a PLY, for a person.

    Args:
        error: Error that its parser raised: a name that a dictionary lacks, a missing word, or
            numbers that do not fit, which its text describes.
    """
    if isinstance(error, KeyError):
        return f"its header lacks, or has an unknown, {error}"
    return "its header is incomplete" if isinstance(error, LookupError) else str(error)


def _decompress_rows(columns: list[Column], point_count: int, body: bytes) -> bytes:
    """The body that a compressed PCD would have uncompressed, point after point.

    Args:
        columns: Name, NumPy type and count of numbers of each field of a point, in their order.
        point_count: Number of points that the header claims.
        body: The bytes after the header: two sizes, then all numbers of each field, compressed.

    Raises:
        ValueError: The body is cut short or damaged, or does not fit the header.
    """
    field_bytes = [np.dtype(kind).itemsize * count for _, kind, count in columns]
    # The two sizes: of the compressed bytes, and of what they become.
    if len(body) < _PCD_SIZES.size:
        raise ValueError("it is cut short, or no compressed one")
    packed_bytes, claimed_bytes = _PCD_SIZES.unpack_from(body)
    packed = body[_PCD_SIZES.size :][:packed_bytes]
    # A point without fields, and a field of less than no numbers, are no points either.
    if (
        len(packed) < packed_bytes
        or min(field_bytes, default=-1) < 0
        or claimed_bytes != point_count * sum(field_bytes)
        or claimed_bytes > _MOST_COMPRESSED * (packed_bytes + 1)
    ):
        raise ValueError("it is cut short, or no compressed one")
    data = _decompress_lzf(packed)
    if len(data) != claimed_bytes:
        raise ValueError("it cannot be decompressed")
    # The numbers of each field, as a column of bytes, are put beside each other.
    ends = point_count * np.cumsum(field_bytes[:-1])
    fields = np.split(np.frombuffer(data, np.uint8), ends)
    columns_of_bytes = [
        field.reshape(point_count, size) for field, size in zip(fields, field_bytes, strict=True)
    ]
    return np.concatenate(columns_of_bytes, axis=1).tobytes()


def _decompress_lzf(packed: bytes) -> bytes:
    """What LZF compressed: runs of bytes as they are, and copies of what was there before.

    Raises:
        ValueError: A copy begins before the first byte.
    """
    output = bytearray()
    stream = iter(packed)
    for control in stream:
        # A control byte below 32 is followed by that many bytes, and one more, as they are.
        if control < 32:
            output += bytes(itertools.islice(stream, control + 1))
            continue
        # Any other begins a copy. Its upper 3 bits are the length, less 2; if they are all set, the
        # next byte is added. Its lower 5 bits and the next byte are the distance back, less 1.
        length = (control >> 5) + 2
        if length == 9:
            length += next(stream, 0)
        distance = ((control & 31) << 8) + next(stream, 0) + 1
        start = len(output) - distance
        if start < 0:
            raise ValueError("it cannot be decompressed")
        # A copy that is longer than the distance repeats itself.
        copied = output[start : start + length]
        output += (copied * length)[:length]
    return bytes(output)


def _parse_ply(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z of the vertices of a PLY, ASCII or binary, and what was read, for a person.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The file is damaged, has no x, y and z, or does not begin with its vertices.
    """
    try:
        header, body = _split_header(data, b"end_header")
        # The lines of the first element, from its name and count up to the next element.
        starts = [
            number for number, words in enumerate(header) if words[0] in ("element", "end_header")
        ]
        if len(starts) < 2 or len(header[starts[0]]) != 3:
            raise ValueError("its header has no element of so many points")
        if header[0] != ["ply"] or header[1][0] != "format":
            raise ValueError("its header does not begin with ply and format")
        first_line, *other_lines = header[starts[0] : starts[1]]
        _, element, point_count = first_line
        storage = header[1][1]
        if element != "vertex":
            raise ValueError("its first element is not vertex; save points first")
        # Its properties, of one number each.
        properties = [words for words in other_lines if words[0] == "property"]
        columns = [(name, _PLY_KINDS[kind], 1) for _, kind, name in properties]
        points = _xyz(columns, int(point_count), body, _PLY_ORDERS[storage])
    except (LookupError, ValueError) as error:  # of a header or a row that is not as it should be
        raise damaged(path, "PLY", f"cannot be read ({_reason(error)})") from error
    return points, "ascii PLY" if storage == "ascii" else "binary PLY"


def _split_header(data: bytes, last: bytes) -> tuple[list[list[str]], bytes]:
    """The words of each line of the header of a PCD or a PLY, and the bytes after it.

    Args:
        data: Content of the file.
        last: First word of the last line of the header.

    Raises:
        ValueError: There is no such line.
    """
    lines: list[list[str]] = []
    stream = io.BytesIO(data)
    while stream.tell() < min(len(data), _LONGEST_HEADER):
        line = stream.readline()
        words = line.decode("latin-1").split()
        if words:
            lines.append(words)
        if line.lstrip().startswith(last):
            return lines, data[stream.tell() :]
    raise ValueError(f"no header that ends with {last.decode()}")


def _xyz(columns: list[Column], point_count: int, body: bytes, order: str | None) -> Points:
    """x y z (N, 3) of the points of a PCD or a PLY.

    Args:
        columns: Name, NumPy type and count of numbers of each field of a point, in their order.
        point_count: Number of points that the header claims.
        body: The bytes after the header, which may go on after the points.
        order: Byte order, "<" or ">", of binary numbers. None: the body is text, a line a point.

    Raises:
        ValueError: There is no x, y or z, or the points are cut short.
    """
    names = [name.lower() for name, _, _ in columns]
    counts = [count for _, _, count in columns]
    for name in "xyz":
        if names.count(name) != 1 or counts[names.index(name)] != 1:
            raise ValueError(f"there is not one {name} among {', '.join(names)}")
    if not point_count:
        return np.empty((0, 3), np.float32)
    if not 0 <= point_count * sum(counts) <= len(body):  # each number has a byte at least
        raise ValueError(f"it claims {point_count:,} points in {len(body):,} bytes")
    # A row is an element of a structured array. Its fields are f0, f1, …, one for each column, as
    # names of columns may occur twice. Numbers of a text are read as float64.
    fields = []
    for index, (_, kind, count) in enumerate(columns):
        number_type = "f8" if order is None else order + kind
        fields.append((f"f{index}", number_type, (count,)))
    layout = np.dtype(fields)
    if order is None:
        rows = np.loadtxt(io.BytesIO(body), layout, comments=None, ndmin=1, max_rows=point_count)
    else:
        rows = np.frombuffer(body, layout, min(point_count, len(body) // layout.itemsize))
    if len(rows) < point_count:
        raise ValueError(f"it is cut short: {len(rows):,} of {point_count:,} points")
    # Each of x, y and z is one number, a field (N, 1).
    xyz = [rows[f"f{names.index(name)}"] for name in "xyz"]
    return _first_columns(np.hstack(xyz))


def _parse_text(path: Path, data: bytes) -> tuple[Points, str]:
    """x y z, the first numbers of lines of text, and what was read, for a person.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: A line is not made of as many numbers as the first.
    """
    rows, _ = read_rows(path, data)
    return _first_columns(rows), "text scan"


def _first_columns(rows: NDArray[np.generic]) -> Points:
    """x y z (N, 3), the first columns of rows (N, 3 or more), as float32.

    They are float64 where float32 would round many by more than a millimetre, as those of UTM.
    """
    stored = rows[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        single = np.ascontiguousarray(stored, np.float32)
        if stored.dtype != np.float64:
            return single
        double = np.asarray(stored, np.float64)
        is_on_earth = np.isfinite(double) & (np.abs(double) < _EARTH_M)
        is_rounded = is_on_earth & (np.abs(single - double) > _EXACT_M)
    if is_rounded.sum() > _MANY_ROUNDED * is_on_earth.sum():
        return np.ascontiguousarray(double)
    return single


_PARSERS: dict[str, Callable[[Path, bytes], tuple[Points, str]]] = {
    ".bin": _parse_bin,
    ".npy": _parse_array,
    ".pcd": _parse_pcd,
    ".ply": _parse_ply,
    ".csv": _parse_text,
    ".txt": _parse_text,
}
"""Functions of a path (for messages) and a content that return what `read_scan` does, by suffix."""

_PROPERTIES = (
    ("<f4", ["float x", "float y", "float z"]),
    ("<f4", ["float nx", "float ny", "float nz"]),
    ("|u1", ["uchar red", "uchar green", "uchar blue"]),
)
"""NumPy type and properties of each value of a `Part`."""

Part = tuple[Points, Points | None, NDArray[np.uint8] | None]
"""(N, 3) points; (N, 3) unit normals, 0 where unknown, or None; (N, 3) colours 0…255, or None."""


def write_cloud(path: Path, parts: Iterable[Part]) -> int:
    """Writes a point cloud as a binary PLY, whole or not at all.

    Args:
        path: The file; it is replaced.
        parts: Parts of the cloud, one after another; all have normals, or none, and so with
            colours.

    Returns:
        The number of points.

    Raises:
        OutputError: The file cannot be written.
    """
    count = 0
    _, properties = _PROPERTIES[0]  # of a cloud without parts
    with atomic_path(path) as temporary, TemporaryFile(dir=temporary.parent) as body:
        for cloud in parts:
            # The bytes of what this part of the cloud has, point after point.
            properties = []
            columns_of_bytes = []
            for values, (kind, names) in zip(cloud, _PROPERTIES, strict=True):
                if values is not None:
                    columns_of_bytes.append(np.ascontiguousarray(values, kind).view(np.uint8))
                    properties += names
            body.write(np.hstack(columns_of_bytes).tobytes())
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
            shutil.copyfileobj(body, file, _BLOCK_BYTES)
    return count
