"""Point clouds as PLY files.

They are written here: the library for it, plyfile, is under the GPL, and the format is a header and
an array. It is written part by part, so that a cloud of any size fits into memory.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.atomic import atomic_path

Part = tuple[NDArray[np.float32], NDArray[np.float32], "NDArray[np.uint8] | None"]
"""(N, 3) points; (N, 3) unit normals, 0 where unknown; (N, 3) colours 0…255, or None."""


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
    coordinates, colours = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    count, coloured = 0, False
    with atomic_path(path) as temporary, TemporaryFile(dir=temporary.parent) as body:
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
        with temporary.open("wb") as file:
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
