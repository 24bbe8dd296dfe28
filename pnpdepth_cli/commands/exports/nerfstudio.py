"""`nerfstudio`: transforms.json with poses, intrinsics and depth as 16-bit PNG in millimetres.

The data conventions are Nerfstudio's. Camera axes are x right, y up, z backwards. Principal points
count from the image's corner, so pixel centres are at .5. A depth is PNG code × 0.001 in the unit
of the poses, that of the results. Instant-NGP reads the same file; it takes that factor from
`integer_depth_scale`. Splatting begins with the points of start.ply, in the coordinates of the
poses.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pnpdepth_cli.commands.exports import Export, ExportFrame
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.io.formats import LARGEST_CODE
from pnpdepth_cli.io.scans import write_cloud

_CODES_PER_UNIT = 1000.0
_START = "start.ply"
_LENSES = {
    "radial-tangential": ("OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4")),
    "fisheye": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
"""Nerfstudio's model of each lens, and the names of its coefficients."""


def _depth_image(frame: ExportFrame) -> str:
    return f"depths/{frame.stem}.png"


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    names = [*map(_depth_image, frames), _START, "transforms.json"]
    return [folder / name for name in names]


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    # The program takes lenses of one kind.
    lenses = sorted({frame.camera.lens for frame in frames})
    if len(lenses) > 1:
        fact = f"the cameras have lenses of several kinds ({', '.join(lenses)})"
        raise InputError(f"{fact}, but Nerfstudio takes one; undistort the images first")
    # Depth, points and image of each frame.
    clipped, entries, start = 0, [], []
    for frame in frames:
        entries.append(_entry(folder, frame))
        start.append(frame.start_points(len(frames)))
        depth = frame.valid_depth()
        fits = np.rint(depth * _CODES_PER_UNIT) <= LARGEST_CODE
        clipped += int((~fits).sum())
        write_depth(folder / _depth_image(frame), np.where(fits, depth, 0), scale=_CODES_PER_UNIT)
        done()
    write_cloud(folder / _START, start)
    # Cameras and poses.
    content = {
        "camera_model": _LENSES[lenses[0]][0],
        "enable_depth_loading": True,
        "integer_depth_scale": 1 / _CODES_PER_UNIT,
        "ply_file_path": _START,
        "frames": entries,
    }
    write_json(folder / "transforms.json", content)
    if not clipped:
        return []
    limit = f"{LARGEST_CODE / _CODES_PER_UNIT:.4g} {frames[0].result.record.unit}"
    return [f"depth: {clipped:,} pixels beyond {limit}, the largest of 16 bits, are unknown"]


def _entry(folder: Path, frame: ExportFrame) -> dict[str, object]:
    """The frame's entry in transforms.json."""
    # The coefficients of the lens, if the program has all of them.
    camera, pose = frame.camera, frame.pose
    assert pose is not None
    _, names = _LENSES[camera.lens]
    values = dict(zip(names, camera.distortion, strict=False))
    if any(camera.distortion[len(names) :]):
        fact = f"{camera.lens} with {len(camera.distortion)} coefficients"
        raise InputError(f"{frame.image}: Nerfstudio knows no lens {fact}; undistort images first")
    image = os.path.relpath(frame.image_path.resolve(), folder.resolve())
    # The pose, with Nerfstudio's axes: y up, z backwards.
    matrix = np.eye(4)
    matrix[:3] = pose
    matrix[:3, 1:3] *= -1
    # Principal points count from the image's corner.
    intrinsics = camera.intrinsics
    return {
        "file_path": Path(image).as_posix(),
        "depth_file_path": _depth_image(frame),
        "depth_path": _depth_image(frame),
        "transform_matrix": matrix.tolist(),
        "w": frame.size[1],
        "h": frame.size[0],
        "fl_x": intrinsics[0, 0],
        "fl_y": intrinsics[1, 1],
        "cx": intrinsics[0, 2] + 0.5,
        "cy": intrinsics[1, 2] + 0.5,
        **{name: values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2")},
    }


EXPORT = Export(
    needs_pose=True, files=_files, write=_write, in_model_units=False, copies_images=True
)
