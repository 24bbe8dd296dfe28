"""`colmap`: depth and normal maps of COLMAP's dense workspace, for its stereo fusion.

A map is the text "width&height&channels&" and float32 little-endian values, x fastest, then y, then
channel (COLMAP's documentation of dense maps, and its read_write_dense.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.exports import Export, ExportFrame, distortion_note
from pnpdepth_cli.commands.shared.tables import write_text
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.sensors.point_cloud import depth_normals


def _map(folder: Path, frame: ExportFrame, kind: str) -> Path:
    return folder / "stereo" / f"{kind}_maps" / f"{frame.image_name}.geometric.bin"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    maps = [_map(folder, frame, kind) for frame in frames for kind in ("depth", "normal")]
    listed = folder / "stereo" / "fusion.cfg"  # image_undistorter may have written it already
    return maps if listed.exists() else [*maps, listed]


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    for frame in frames:
        depth = frame.valid_depth()
        _write_map(_map(folder, frame, "normal"), depth_normals(depth, frame.camera))
        _write_map(_map(folder, frame, "depth"), depth[..., None] / frame.unit_scale)
        done()
    for listed in _files(folder, frames)[2 * len(frames) :]:
        write_text(listed, "".join(f"{frame.image_name}\n" for frame in frames))
    return distortion_note(frames, "COLMAP's fusion")


def _write_map(path: Path, values: NDArray[np.floating]) -> None:
    """Writes an (H, W, C) map."""
    height, width, channels = values.shape
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(f"{width}&{height}&{channels}&".encode())
        file.write(np.ascontiguousarray(values.transpose(2, 0, 1)).astype("<f4").tobytes())


EXPORT = Export(needs_pose=False, files=_files, write=_write)
