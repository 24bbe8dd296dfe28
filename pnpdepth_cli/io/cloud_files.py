"""Point clouds as files: PLY, and with the extra `cloud` GLB and LAZ.

PLY is written here: the library for it, plyfile, is under the GPL, and the format is a header and
an array. It is written part by part, so that a cloud of any size fits into memory.
"""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.atomic import atomic_path

_SUFFIXES = (".ply", ".glb", ".laz")
_LAZ_STEP = 1e-4  # metres between two coordinates that LAZ can tell apart

Part = tuple[NDArray[np.float32], NDArray[np.float32], "NDArray[np.uint8] | None"]
"""(N, 3) points; (N, 3) unit normals, 0 where unknown; (N, 3) colours 0…255, or None."""


def check_cloud_suffix(path: Path) -> None:
    """Raises OutputError if no format of clouds has the suffix."""
    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: a cloud is written as one of {', '.join(_SUFFIXES)}")


def write_cloud(path: Path, parts: Iterable[Part]) -> int:
    """Writes a cloud whole or not at all, in the format of the path's suffix.

    Args:
        path: The file; it is replaced.
        parts: Of the cloud, one after another. PLY alone holds the normals.

    Returns:
        The number of points.

    Raises:
        OutputError: The suffix is unknown, or the file cannot be written.
        UsageError: The format needs a package that is not installed.
    """
    check_cloud_suffix(path)
    suffix = path.suffix.lower()
    with atomic_path(path) as temporary:
        if suffix == ".ply":
            return _write_ply(temporary, iter(parts))
        points, _, colours = zip(*parts, strict=True)
        xyz = np.concatenate(points)
        rgb = None if colours[0] is None else np.concatenate(colours)
        (_write_glb if suffix == ".glb" else _write_laz)(temporary, xyz, rgb)
        return len(xyz)


def _write_ply(path: Path, parts: Iterator[Part]) -> int:
    coordinates, colours = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    count, coloured = 0, False
    with TemporaryFile(dir=path.parent) as body:
        for xyz, normals, rgb in parts:
            coloured = rgb is not None
            names = (*coordinates, *colours) if coloured else coordinates
            kinds = ["<f4"] * 6 + ["|u1"] * 3
            rows = np.empty(len(xyz), np.dtype(list(zip(names, kinds, strict=False))))
            columns = [*xyz.T, *normals.T, *(() if rgb is None else rgb.T)]
            for name, column in zip(names, columns, strict=True):
                rows[name] = column
            body.write(rows.tobytes())
            count += len(rows)
        header = _ply_header(count, coordinates, colours if coloured else ())
        body.seek(0)
        with path.open("wb") as file:
            file.write(header.encode())
            shutil.copyfileobj(body, file, 1 << 20)
    return count


def write_points(path: Path, xyz: NDArray[np.float32]) -> None:
    """Writes points (N, 3) as a PLY without normals."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(_ply_header(len(xyz), "xyz").encode())
        file.write(xyz.astype("<f4").tobytes())


def _ply_header(count: int, floats: Iterable[str], bytes_: Iterable[str] = ()) -> str:
    properties = [f"property float {name}\n" for name in floats]
    properties += [f"property uchar {name}\n" for name in bytes_]
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    return f"{header}{''.join(properties)}end_header\n"


def _write_glb(path: Path, xyz: NDArray[np.float32], rgb: NDArray[np.uint8] | None) -> None:
    trimesh = _extra("trimesh", ".glb")
    # glTF's axes are x right, y up, z backwards; a camera's are x right, y down, z forwards.
    points = trimesh.PointCloud(xyz * np.array([1, -1, -1], np.float32), colors=rgb)
    path.write_bytes(trimesh.Scene(points).export(file_type="glb"))


def _write_laz(path: Path, xyz: NDArray[np.float32], rgb: NDArray[np.uint8] | None) -> None:
    laspy = _extra("laspy", ".laz")
    header = laspy.LasHeader(point_format=2 if rgb is not None else 0, version="1.2")
    header.offsets = xyz.min(axis=0) if len(xyz) else np.zeros(3)
    header.scales = np.full(3, _LAZ_STEP)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.astype(np.float64).T
    if rgb is not None:
        las.red, las.green, las.blue = rgb.astype(np.uint16).T * 257
    with path.open("wb") as file:
        las.write(file, do_compress=True)


def _extra(package: str, suffix: str) -> Any:
    """The package, or a UsageError that names the extra it comes with."""
    try:
        return importlib.import_module(package)
    except ImportError:
        raise UsageError(
            f"{suffix} needs {package}; pip install 'pnpdepth[cloud]', or write .ply"
        ) from None
