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


def _map_file(folder: Path, frame: ExportFrame, kind: str) -> Path:
    """The file of a frame's map in COLMAP's workspace; its kind is "depth" or "normal"."""
    return folder / "stereo" / f"{kind}_maps" / f"{frame.image_name}.geometric.bin"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    """The maps of all frames, and COLMAP's list of images unless there is one already."""
    maps = [_map_file(folder, frame, kind) for frame in frames for kind in ("depth", "normal")]
    image_list = _image_list_file(folder)
    return maps if image_list.exists() else [*maps, image_list]


def _image_list_file(folder: Path) -> Path:
    """The list of the images that COLMAP fuses; its image_undistorter writes one as well."""
    return folder / "stereo" / "fusion.cfg"


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    """Writes depth and normal maps and the list of images; returns warnings for a person.

    Args:
        folder: Output folder; the folders of the files are there.
        frames: The frames.
        done: Callback after each frame.
    """
    # The maps (H, W, C). Depth is in the unit of the result, and becomes units of the COLMAP model.
    for frame in frames:
        depth = frame.valid_depth()
        depth_in_model_units = depth[..., None] / frame.unit_scale
        _write_map(_map_file(folder, frame, "normal"), depth_normals(depth, frame.camera))
        _write_map(_map_file(folder, frame, "depth"), depth_in_model_units)
        done()
    # The images that COLMAP is to fuse. A list that is there already stays.
    image_list = _image_list_file(folder)
    if not image_list.exists():
        write_text(image_list, "".join(f"{frame.image_name}\n" for frame in frames))
    return distortion_note(frames, "COLMAP's fusion")


def _write_map(path: Path, values: NDArray[np.floating]) -> None:
    """Writes a map (H, W, C) as COLMAP's dense workspace has it.

    Args:
        path: The file.
        values: (H, W, C) depth in units of the model, or normals.
    """
    height, width, channels = values.shape
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(f"{width}&{height}&{channels}&".encode())
        # One channel after the other, each row by row.
        file.write(np.ascontiguousarray(values.transpose(2, 0, 1)).astype("<f4").tobytes())


EXPORT = Export(needs_pose=False, files=_files, write=_write)
