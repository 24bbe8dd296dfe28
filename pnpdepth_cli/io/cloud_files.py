"""Point clouds as files: PLY, and with the extra `cloud` GLB and LAZ.

PLY is written here: the library for it, plyfile, is under the GPL, and the format is a header and
an array.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.atomic import atomic_path

_LAZ_STEP = 1e-4  # metres between two coordinates that LAZ can tell apart

_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


class _Cloud(NamedTuple):
    xyz: NDArray[np.float32]
    normals: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None


def write_cloud(
    path: Path,
    xyz: NDArray[np.float32],
    normals: NDArray[np.float32],
    rgb: NDArray[np.uint8] | None,
) -> None:
    """Writes a cloud whole or not at all, in the format of the path's suffix.

    Args:
        path: The file; it is replaced.
        xyz: (N, 3) points.
        normals: (N, 3) unit vectors, 0 where unknown. PLY holds them.
        rgb: (N, 3) colours 0…255. None: without colours.

    Raises:
        OutputError: The suffix is none of `CLOUD_SUFFIXES`, or the file cannot be written.
        UsageError: The format needs a package that is not installed.
    """
    write = _WRITERS.get(path.suffix.lower())
    if write is None:
        raise OutputError(f"{path}: a cloud is written as one of {', '.join(CLOUD_SUFFIXES)}")
    with atomic_path(path) as temporary:
        write(temporary, _Cloud(xyz, normals, rgb))


def _write_ply(path: Path, cloud: _Cloud) -> None:
    fields = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    if cloud.rgb is not None:
        fields += [(name, "|u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(cloud.xyz), np.dtype(fields))
    for number, name in enumerate("xyz"):
        rows[name] = cloud.xyz[:, number]
        rows[f"n{name}"] = cloud.normals[:, number]
        if cloud.rgb is not None:
            rows[("red", "green", "blue")[number]] = cloud.rgb[:, number]
    properties = "".join(f"property {_PLY_TYPES[kind]} {name}\n" for name, kind in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}"
    with path.open("wb") as file:
        file.write(f"{header}end_header\n".encode())
        file.write(rows.tobytes())


def _write_glb(path: Path, cloud: _Cloud) -> None:
    trimesh = _extra("trimesh", ".glb")
    # glTF's axes are x right, y up, z backwards; a camera's are x right, y down, z forwards.
    xyz = cloud.xyz * np.array([1, -1, -1], np.float32)
    points = trimesh.PointCloud(xyz, colors=cloud.rgb)
    path.write_bytes(trimesh.Scene(points).export(file_type="glb"))


def _write_laz(path: Path, cloud: _Cloud) -> None:
    laspy = _extra("laspy", ".laz")
    header = laspy.LasHeader(point_format=2 if cloud.rgb is not None else 0, version="1.2")
    header.offsets = cloud.xyz.min(axis=0) if len(cloud.xyz) else np.zeros(3)
    header.scales = np.full(3, _LAZ_STEP)
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.xyz.astype(np.float64).T
    if cloud.rgb is not None:
        las.red, las.green, las.blue = cloud.rgb.astype(np.uint16).T * 257
    with path.open("wb") as file:
        las.write(file, do_compress=True)


def _extra(package: str, suffix: str) -> Any:
    """The package, or a UsageError that names the extra it comes with."""
    import importlib

    try:
        return importlib.import_module(package)
    except ImportError:
        raise UsageError(
            f"{suffix} needs {package}; pip install 'pnpdepth[cloud]', or write .ply"
        ) from None


_WRITERS: dict[str, Callable[[Path, _Cloud], None]] = {
    ".ply": _write_ply,
    ".glb": _write_glb,
    ".laz": _write_laz,
}
CLOUD_SUFFIXES = tuple(_WRITERS)
