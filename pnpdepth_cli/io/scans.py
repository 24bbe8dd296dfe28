"""LiDAR scans: points of x, y, z metres in the scanner's frame, from the formats they come in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, NoPointsError
from pnpdepth_cli.io.file_bytes import read_bytes
from pnpdepth_cli.io.file_kind import kind_of
from pnpdepth_cli.io.formats.npy import parse_npy
from pnpdepth_cli.io.point_files import parse_pcd, parse_ply

_KITTI_BYTES = 16
"""x, y, z and reflectance of one point in KITTI's .bin, float32 each."""

_FARTHEST_M = 1e5


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """points: (N, 3) float32 metres, x y z in the scanner's frame; all finite, in file order.

    source describes the file for a person.
    """

    points: NDArray[np.float32]
    source: str


def read_scan(path: Path) -> ScanFile:
    """The points of a KITTI .bin, .npy (N, 3 or more columns), .pcd or .ply file.

    Raises FileFormatError for a damaged file and for points that are no numbers, NoPointsError
    for a scan without any.
    """
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise FileFormatError(f"{path} is not a scan; give a file of {', '.join(_READERS)}")
    data = read_bytes(path)
    kind = kind_of(data)
    if kind not in (None, "NPY"):
        raise FileFormatError(f"{path} is a {kind} file, not a scan; check what is given as scan")
    points, source = _READERS[suffix](path, data)
    if not len(points):
        raise NoPointsError(f"{path} holds no point; give a scan with points")
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise FileFormatError(
            f"{path}: {int(bad.sum()):,} of {len(points):,} points have no finite coordinates"
            f" (the first is number {int(np.argmax(bad)) + 1:,}); remove them"
        )
    if np.abs(points).max() > _FARTHEST_M:
        raise FileFormatError(
            f"{path}: a coordinate of {np.abs(points).max():.3g} m is none of a scan; its numbers"
            " are probably stored in another way than the format says"
        )
    return ScanFile(points=points, source=source)


def _parse_bin(path: Path, data: bytes) -> tuple[NDArray[np.float32], str]:
    if len(data) % _KITTI_BYTES:
        raise FileFormatError(
            f"{path}: {len(data):,} bytes are not a multiple of {_KITTI_BYTES} (x, y, z and"
            " reflectance as float32); it is cut short or no KITTI scan"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    return np.ascontiguousarray(points[:, :3], np.float32), "KITTI scan"


def _parse_npy(path: Path, data: bytes) -> tuple[NDArray[np.float32], str]:
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


_READERS: dict[str, Callable[[Path, bytes], tuple[NDArray[np.float32], str]]] = {
    ".bin": _parse_bin,
    ".npy": _parse_npy,
    ".pcd": parse_pcd,
    ".ply": parse_ply,
}

SCAN_SUFFIXES = tuple(_READERS)
"""What `read_scan` can read."""
