"""LiDAR scans: points of x, y, z metres in the scanner's frame, from the formats they come in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, NoPointsError
from pnpdepth_cli.io.file_bytes import read_bytes
from pnpdepth_cli.io.formats import kind_of
from pnpdepth_cli.io.formats.npy import parse_npy
from pnpdepth_cli.io.formats.npz import parse_npz
from pnpdepth_cli.io.point_files import parse_pcd, parse_ply

_FARTHEST_M = 1e5
_KITTI_FIELDS = 4
"""x, y, z and reflectance."""

_NUSCENES_FIELDS = 5
"""x, y, z, intensity and the index of the laser, a whole number."""

_SAMPLE = 4096
"""Rows that tell the number of fields; checking all takes twice as long as reading them."""

_NEARLY_ALL = 0.95
"""Fraction of points; read with the wrong number of fields, at most half of them look right."""


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """A LiDAR scan as read from a file."""

    points: NDArray[np.float32]
    """(N, 3) metres, x y z in the scanner's frame; all finite, in file order."""

    source: str
    """What was read, for a person."""


def read_scan(path: Path, point_fields: int | None = None) -> ScanFile:
    """Returns the points of a KITTI or nuScenes .bin, .npy (N, 3 or more columns), .pcd or .ply.

    Also of an .npz whose array `data` is as in an .npy, which is how DDAD stores scans.

    Args:
        path: The file; its suffix says the format.
        point_fields: Float32 numbers of a point in a .bin; None: recognised from name and content.

    Raises:
        FileFormatError: The file is damaged, ambiguous, or holds points that are no numbers.
        NoPointsError: It holds no point.
    """
    suffix = path.suffix.lower()
    if suffix not in SCAN_SUFFIXES:
        raise FileFormatError(f"{path} is not a scan; give a file of {', '.join(SCAN_SUFFIXES)}")
    data = read_bytes(path)
    kind = kind_of(data)
    if kind not in (None, "NPY") and (kind, suffix) != ("NPZ", ".npz"):
        raise FileFormatError(f"{path} is a {kind} file, not a scan; check what is given as scan")
    if suffix == ".bin":
        points, source = _parse_bin(path, data, point_fields)
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


def _parse_bin(
    path: Path, data: bytes, point_fields: int | None
) -> tuple[NDArray[np.float32], str]:
    fields = point_fields or _fields_of_bin(path, data)
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
        f"{path} may hold 4 numbers a point (KITTI) or 5 (nuScenes); say which with"
        " --scan point-fields"
    )


def _looks_like_scan(rows: NDArray[np.float32]) -> bool:
    """True if nearly all rows of (N, 4 or 5), or of a sample of them, are plausible points.

    Coordinates are not too far, reflectance is not negative, and a fifth column holds whole numbers
    0…255, the index of a laser.
    """
    rows = rows[:: -(-len(rows) // _SAMPLE) or 1]
    with np.errstate(invalid="ignore"):
        near = (np.abs(rows[:, :3]) <= _FARTHEST_M).all(axis=1) & (rows[:, 3] >= 0)
        laser = rows[:, 4:]
        numbered = ((laser >= 0) & (laser < 256) & (laser == np.floor(laser))).all(axis=1)
    return bool(np.mean(near & numbered) >= _NEARLY_ALL)


def _parse_npy(path: Path, data: bytes) -> tuple[NDArray[np.float32], str]:
    if kind_of(data) != "NPY":
        raise FileFormatError(f"{path} is not an NPY file; save it with numpy.save")
    return _points_of(path, parse_npy(path, data)), "NPY scan"


def _parse_npz(path: Path, data: bytes) -> tuple[NDArray[np.float32], str]:
    return _points_of(path, parse_npz(path, data, "data")[1]), "DDAD scan"


def _points_of(path: Path, array: NDArray[Any]) -> NDArray[np.float32]:
    """The first columns of (N, 3 or more) floats."""
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind != "f":
        shape = "×".join(str(n) for n in array.shape)
        raise FileFormatError(
            f"{path} holds {array.dtype} of shape {shape}; a scan is float, one point a row, with"
            " x y z in the first columns"
        )
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array[:, :3], np.float32)


_READERS: dict[str, Callable[[Path, bytes], tuple[NDArray[np.float32], str]]] = {
    ".npy": _parse_npy,
    ".npz": _parse_npz,
    ".pcd": parse_pcd,
    ".ply": parse_ply,
}

SCAN_SUFFIXES = (".bin", *_READERS)
"""What `read_scan` can read."""
